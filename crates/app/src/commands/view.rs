//! `snapsnap view`: a page (crates/app/viewer) that shows Gaussians.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, PoisonError, TryLockError, Weak};
use std::time::SystemTime;

use clap::Args;
use snapsnap_base::FileError;
use ureq::http::StatusCode;

use super::convert::finite;
use crate::downloads::Download;
use crate::failure::Failure;
use crate::page::{self, Job, PageArguments, busy, text};
use crate::server::{Answer, Request};

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians: PLY, SPZ or GLB.
    input: PathBuf,
    #[command(flatten)]
    page: PageArguments,
}

/// Largest number of former contents that slow clients may still be reading.
const FORMER: usize = 2;

/// Length and time of a file, by which a replaced file is noticed.
type Stamp = (u64, Option<SystemTime>);

/// The served contents, one of each extension, which all clients share.
#[derive(Default)]
struct Made {
    current: HashMap<&'static str, (Stamp, Arc<Vec<u8>>)>,
    /// Contents of replaced files.
    former: Vec<Weak<Vec<u8>>>,
}

static MADE: LazyLock<Mutex<Made>> = LazyLock::new(Mutex::default);
/// Locked while a mesh or an animation is made, which takes all cores.
static LONG: Mutex<()> = Mutex::new(());

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let input = arguments.input.as_path();
    // Refuses unsuitable files before the browser starts.
    finite(input)?;
    let shows = format!("shows {}", input.display());
    page::show(page::Kind::View, &arguments.page, &shows, &|request, _| respond(request, input))
}

fn respond(request: &Request, input: &Path) -> Answer {
    if !page::is_read(request) {
        return text(StatusCode::METHOD_NOT_ALLOWED, "GET and HEAD only");
    }
    if request.path == "/progress" {
        return page::progress(request);
    }
    let Some((extension, download)) = Download::named(request.path.trim_start_matches('/')) else {
        return text(StatusCode::NOT_FOUND, "no such page");
    };
    let job = Job::of(request);
    let make = || download.make(&finite(input)?.0, &|step| job.step(step));
    let made = if !download.is_long() {
        shared(input, extension, false, make)
    } else if request.method == "HEAD" {
        finite(input).map(|_| Some(Arc::default()))
    } else {
        match LONG.try_lock() {
            Err(TryLockError::WouldBlock) => Ok(None),
            _one => shared(input, extension, true, make),
        }
    };
    match made {
        Ok(None) => busy(),
        Ok(Some(content)) => {
            let name = input.with_extension(extension);
            page::download(&name.file_name().unwrap_or_default().to_string_lossy(), content)
        }
        Err(e) => text(StatusCode::UNPROCESSABLE_ENTITY, &e.to_string()),
    }
}

/// The current file's content of this kind, made once. `None` while clients still read too many former contents.
fn shared(
    input: &Path,
    extension: &'static str,
    is_long: bool,
    make: impl FnOnce() -> Result<Vec<u8>, Failure>,
) -> Result<Option<Arc<Vec<u8>>>, Failure> {
    let there = fs::metadata(input).map_err(FileError::read(input))?;
    let stamp = (there.len(), there.modified().ok());
    // One request at a time, since each needs memory for the whole file. Long work goes on beside the others.
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, content)) = made.current.get(extension).filter(|(of, _)| *of == stamp) {
        return Ok(Some(content.clone()));
    }
    let former = made.current.remove(extension).map(|(_, content)| Arc::downgrade(&content));
    made.former.extend(former);
    made.former.retain(|content| content.strong_count() > 0);
    if made.former.len() > FORMER {
        return Ok(None);
    }
    let content = if is_long {
        drop(made);
        let content = Arc::new(make()?);
        made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
        content
    } else {
        Arc::new(make()?)
    };
    made.current.insert(extension, (stamp, content.clone()));
    Ok(Some(content))
}
