//! `snapsnap view`: a page (crates/app/viewer) that shows Gaussians.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::time::SystemTime;

use clap::Args;
use http::StatusCode;
use snapsnap_base::FileError;

use super::convert::{drawable, read};
use crate::downloads::{self, Download};
use crate::failure::Failure;
use crate::page::{self, PageArguments, text};
use crate::server::{Answer, Content, Request};

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians: PLY, SPZ or GLB.
    input: PathBuf,
    #[command(flatten)]
    page: PageArguments,
}

/// The served contents by extension. All clients share them. By length and time of its file each shows whether the file
/// was replaced.
type Made = Mutex<HashMap<&'static str, ((u64, Option<SystemTime>), Content)>>;

/// The contents that are made at once, and those that take long.
static MADE: [LazyLock<Made>; 2] = [LazyLock::new(Mutex::default), LazyLock::new(Mutex::default)];

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let input = arguments.input.as_path();
    // Refuses unsuitable files before the browser starts.
    read(input)?;
    let shows = format!("shows {}", input.display());
    page::show("view", &arguments.page, &shows, &|request, _| respond(request, input))
}

fn respond(request: &Request, input: &Path) -> Result<Answer, Answer> {
    if !page::is_read(request) {
        return Err(text(StatusCode::METHOD_NOT_ALLOWED, "GET and HEAD only"));
    }
    if request.path == "/progress" {
        return Ok(page::progress(request));
    }
    let file = Download::named(request.path.trim_start_matches('/'));
    let file = file.ok_or_else(|| text(StatusCode::NOT_FOUND, "no such page"))?;
    if request.method == "HEAD" {
        drawable(input)?;
    }
    let name = input.file_stem().unwrap_or_default().to_string_lossy();
    downloads::answer(request, &name, file, |step| shared(input, file, step))
}

/// The current file's content of this kind, made once.
fn shared(
    input: &Path,
    (extension, download): (&'static str, Download),
    step: &dyn Fn(&str),
) -> Result<Content, Answer> {
    let there = fs::metadata(input).map_err(FileError::read(input))?;
    let stamp = (there.len(), there.modified().ok());
    // One request at a time, since each needs memory for the whole file. Long work goes on beside the others.
    let made = &MADE[usize::from(download.is_long())];
    let mut made = made.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, content)) = made.get(extension).filter(|(of, _)| *of == stamp) {
        return Ok(content.clone());
    }
    made.remove(extension);
    let content: Content = Arc::new(download.make(&drawable(input)?.0, step)?);
    made.insert(extension, (stamp, content.clone()));
    Ok(content)
}
