//! `snapsnap view`: a local web page (crates/app/viewer) that shows Gaussians.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::net::{Ipv4Addr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, PoisonError, TryLockError, Weak};
use std::time::SystemTime;

use burn::tensor::Device;
use clap::Args;
use snapsnap_base::FileError;
use snapsnap_mesh::export::{self, Kind as MeshKind};
use snapsnap_mesh::fuse::fuse;
use snapsnap_splat::scene::{Kind, Stored};
use ureq::http::StatusCode;

use super::convert::finite;
use super::mesh;
use crate::failure::Failure;
use crate::server::{Answer, Content, Request, serve};
use crate::{interrupt, say};

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians: PLY, SPZ or GLB.
    input: PathBuf,
    /// Port on 127.0.0.1 [default: a free one].
    #[arg(long)]
    port: Option<u16>,
    /// Start the browser.
    #[arg(long)]
    open: bool,
}

/// Largest number of former contents that slow clients may still be reading.
const FORMER: usize = 2;
/// Content security policy without any other host.
const POLICY: &str = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; \
                      connect-src 'self' blob: data:; img-src 'self' blob: data:; style-src 'self'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

/// A file of the page: its path, type and content.
type PageFile = (&'static str, &'static str, &'static [u8]);

const PAGE: [PageFile; 4] = [
    ("/", "text/html; charset=utf-8", include_bytes!("../../viewer/index.html")),
    ("/viewer.js", "text/javascript; charset=utf-8", include_bytes!("../../../../assets/viewer/viewer.js")),
    ("/viewer.css", "text/css; charset=utf-8", include_bytes!("../../../../assets/viewer/viewer.css")),
    ("/LICENSES.md", "text/markdown; charset=utf-8", include_bytes!("../../../../assets/viewer/LICENSES.md")),
];

/// Length and time of a file, by which a replaced file is noticed.
type Stamp = (u64, Option<SystemTime>);

/// The served contents, one of each path, which all clients share.
#[derive(Default)]
struct Made {
    current: HashMap<&'static str, (Stamp, Arc<Vec<u8>>)>,
    /// Contents of replaced files.
    former: Vec<Weak<Vec<u8>>>,
}

static MADE: LazyLock<Mutex<Made>> = LazyLock::new(Mutex::default);
/// Locked while a mesh is made. A mesh takes all cores and a gigabyte.
static MESH: Mutex<()> = Mutex::new(());
/// The step of the mesh that is being made.
static STAGE: Mutex<String> = Mutex::new(String::new());

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let input = arguments.input.as_path();
    // Refuses unsuitable files before the browser starts.
    finite(input)?;
    let wanted = arguments.port.unwrap_or(0);
    let cannot = |e: io::Error| Failure::Input(format!("--port {wanted}: cannot listen on 127.0.0.1: {e}"));
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, wanted)).map_err(cannot)?;
    let port = listener.local_addr().map_err(cannot)?.port();
    let url = format!("http://127.0.0.1:{port}/");
    interrupt::end_well();
    // The address is printed with --quiet as well.
    say::out(&url);
    say::note(&format!("shows {}; Ctrl-C ends it", input.display()));
    if arguments.open
        && let Err(e) = open::that_detached(&url)
    {
        say::err(&format!("warning: --open: no browser could be started ({e}); open {url} by hand"));
    }
    serve(&listener, &|request| respond(request, input, port))
}

fn respond(request: &Request, input: &Path, port: u16) -> Answer {
    // Other names may belong to a page of another host whose name resolves to 127.0.0.1.
    let is_local = |host: &String| {
        let host = host.to_ascii_lowercase();
        // Browsers omit port 80.
        let name = host.strip_suffix(&format!(":{port}")).or((port == 80).then_some(host.as_str()));
        name.is_some_and(|name| ["127.0.0.1", "localhost"].contains(&name))
    };
    if !request.host.as_ref().is_some_and(is_local) {
        return text(StatusCode::FORBIDDEN, "only for http://127.0.0.1");
    }
    // A page of another site may lead here, but may not start any work.
    let is_own_origin =
        |origin: &String| origin.strip_prefix("http://").is_some_and(|host| is_local(&host.to_owned()));
    let is_own_page = request.origin.as_ref().is_none_or(is_own_origin)
        && request.fetch_site.as_deref().is_none_or(|site| ["same-origin", "none"].contains(&site));
    if !is_own_page && request.path != "/" {
        return text(StatusCode::FORBIDDEN, "only for this server's own page");
    }
    let is_head = request.method == "HEAD";
    if request.method != "GET" && !is_head {
        return text(StatusCode::METHOD_NOT_ALLOWED, "GET and HEAD only");
    }
    let path = request.path.as_str();
    if let Some((_, kind, content)) = PAGE.iter().find(|(name, ..)| *name == path) {
        return answer(StatusCode::OK, kind, Arc::new(*content));
    }
    let made = match path {
        "/scene.ply" => shared(input, "ply", || Ok(finite(input)?.0.to_bytes(Kind::Ply)?)),
        "/scene.spz" => shared(input, "spz", || Ok(finite(input)?.0.to_bytes(Kind::Spz)?)),
        "/progress" => {
            return text(StatusCode::OK, &STAGE.lock().unwrap_or_else(PoisonError::into_inner));
        }
        "/scene.glb" if is_head => finite(input).map(|_| Some(Arc::default())),
        "/scene.glb" => match MESH.try_lock() {
            Err(TryLockError::WouldBlock) => Ok(None),
            _one => shared(input, "glb", || made_mesh(input)),
        },
        _ => return text(StatusCode::NOT_FOUND, "no such page"),
    };
    match made {
        Ok(None) => {
            let message = "the server is busy with earlier requests; try again in a minute";
            text(StatusCode::SERVICE_UNAVAILABLE, message)
        }
        Ok(Some(content)) => {
            let extension = path.trim_start_matches("/scene.");
            let name = input.with_extension(extension);
            let name = percent_encoded(&name.file_name().unwrap_or_default().to_string_lossy());
            let mut answer = answer(StatusCode::OK, "application/octet-stream", content);
            let disposition = format!("attachment; filename*=UTF-8''{name}");
            answer.headers.extend([("Content-Disposition", disposition), ("X-Name", name)]);
            answer
        }
        Err(e) => text(StatusCode::UNPROCESSABLE_ENTITY, &e.to_string()),
    }
}

/// The content of this kind for the current file, made once. `None` while slow clients are still reading too many former ones.
fn shared(
    input: &Path,
    kind: &'static str,
    make: impl FnOnce() -> Result<Vec<u8>, Failure>,
) -> Result<Option<Arc<Vec<u8>>>, Failure> {
    let there = fs::metadata(input).map_err(FileError::read(input))?;
    let stamp = (there.len(), there.modified().ok());
    // One request at a time, since each needs memory for the whole file. A mesh is made beside the others.
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, content)) = made.current.get(kind).filter(|(of, _)| *of == stamp) {
        return Ok(Some(content.clone()));
    }
    let former = made.current.remove(kind).map(|(_, content)| Arc::downgrade(&content));
    made.former.extend(former);
    made.former.retain(|content| content.strong_count() > 0);
    if made.former.len() > FORMER {
        return Ok(None);
    }
    let content = match kind {
        "glb" => {
            drop(made);
            let content = Arc::new(make()?);
            made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
            content
        }
        _ => Arc::new(make()?),
    };
    made.current.insert(kind, (stamp, content.clone()));
    Ok(Some(content))
}

/// The mesh that `snapsnap mesh` makes.
fn made_mesh(input: &Path) -> Result<Vec<u8>, Failure> {
    let stage = |name: &str| name.clone_into(&mut STAGE.lock().unwrap_or_else(PoisonError::into_inner));
    let fused = fuse(&Stored::read(input)?.load(&Device::flex()), mesh::options(MeshKind::Glb), &stage);
    stage("");
    let fused = fused?;
    export::glb_bytes(&fused.mesh, fused.offset).map_err(|e| Failure::Internal(e.to_string()))
}

fn text(status: StatusCode, message: &str) -> Answer {
    answer(status, "text/plain; charset=utf-8", Arc::new(say::printable(message).into_bytes()))
}

fn answer(status: StatusCode, kind: &str, content: Content) -> Answer {
    let headers = vec![
        ("Content-Type", kind.to_owned()),
        ("Content-Security-Policy", POLICY.to_owned()),
        ("X-Content-Type-Options", "nosniff".to_owned()),
        // Another program may use the port later.
        ("Cache-Control", "no-store".to_owned()),
    ];
    Answer { status, headers, content }
}

/// The text with percent codes for all bytes but unreserved characters (RFC 3986).
fn percent_encoded(text: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte);
    text.bytes()
        .map(|byte| if plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") })
        .collect()
}
