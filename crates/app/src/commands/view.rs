//! `snapsnap view`: a page on this machine that shows Gaussians. It is made of crates/app/viewer.

use std::io::Cursor;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, TryLockError};
use std::thread;

use burn::tensor::Device;
use clap::Args;
use snapsnap_mesh::export;
use snapsnap_mesh::fuse::{Options, fuse};
use snapsnap_splat::scene::{Kind, Stored};
use tiny_http::{Header, Method, Request, Response, Server, StatusCode};

use crate::failure::Failure;
use crate::{interrupt, say};

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians, PLY or SPZ.
    input: PathBuf,
    /// Port on 127.0.0.1 [default: a free one].
    #[arg(long)]
    port: Option<u16>,
    /// Start the browser.
    #[arg(long)]
    open: bool,
}

/// Requests that are answered at once; making a mesh takes seconds, and the page must not wait for it.
const THREADS: usize = 4;
/// Held by whoever makes a mesh: one at a time, each takes all cores and a gigabyte.
static MESH: Mutex<()> = Mutex::new(());
/// Nothing from elsewhere, and nothing to elsewhere.
const POLICY: &str = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; \
                      connect-src 'self' blob: data:; img-src 'self' blob: data:; style-src 'self'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

/// A file of the page: its path, type and content.
type PageFile = (&'static str, &'static str, &'static [u8]);

const PAGE: [PageFile; 4] = [
    ("/", "text/html; charset=utf-8", include_bytes!("../../../../assets/viewer/index.html")),
    ("/viewer.js", "text/javascript; charset=utf-8", include_bytes!("../../../../assets/viewer/viewer.js")),
    ("/viewer.css", "text/css; charset=utf-8", include_bytes!("../../../../assets/viewer/viewer.css")),
    ("/LICENSES.md", "text/markdown; charset=utf-8", include_bytes!("../../../../assets/viewer/LICENSES.md")),
];

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    // What cannot be shown is refused here and not in the browser.
    Stored::read(&arguments.input)?;
    let wanted = arguments.port.unwrap_or(0);
    let server = Server::http((Ipv4Addr::LOCALHOST, wanted))
        .map_err(|e| Failure::Input(format!("--port {wanted}: cannot listen on 127.0.0.1: {e}")))?;
    let port = server.server_addr().to_ip().map_or(wanted, |address| address.port());
    let url = format!("http://127.0.0.1:{port}/");
    interrupt::end_well();
    // Whoever asked for silence still has to know where it is.
    say::out(&url);
    if !quiet {
        say::err(&format!("shows {}; Ctrl-C ends it", arguments.input.display()));
    }
    if arguments.open
        && let Err(e) = open::that_detached(&url)
    {
        say::err(&format!("warning: --open: no browser could be started ({e}); open {url} by hand"));
    }
    thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                // A connection that breaks is the browser's business.
                while let Ok(request) = server.recv() {
                    answer(request, &arguments.input, port);
                }
                // Nothing comes any more: the next one hears of it, too.
                server.unblock();
            });
        }
    });
    Err(Failure::Internal(format!("{url}: the server has ended")))
}

fn answer(request: Request, input: &Path, port: u16) {
    let response = respond(&request, input, port);
    let _ = request.respond(response);
}

fn respond(request: &Request, input: &Path, port: u16) -> Response<Cursor<Vec<u8>>> {
    // A page elsewhere whose name was pointed at 127.0.0.1 may not read the file.
    let host = request.headers().iter().find(|header| header.field.equiv("Host"));
    let host = host.map(|header| header.value.as_str());
    let is_ours = |host: &str| {
        // Browsers leave out the usual port.
        let name = host.strip_suffix(&format!(":{port}")).or((port == 80).then_some(host));
        name.is_some_and(|name| ["127.0.0.1", "localhost"].contains(&name))
    };
    if !host.is_some_and(is_ours) {
        return text(403, "only for http://127.0.0.1");
    }
    if !matches!(request.method(), Method::Get | Method::Head) {
        return text(405, "GET and HEAD only");
    }
    let path = request.url().split(['?', '#']).next().unwrap_or_default();
    if let Some((_, kind, content)) = PAGE.iter().find(|(name, ..)| *name == path) {
        return response(200, kind, content.to_vec());
    }
    let made = match path {
        "/scene.ply" => bytes(input, Kind::Ply),
        "/scene.spz" => bytes(input, Kind::Spz),
        "/scene.glb" if *request.method() == Method::Head => Ok(Vec::new()),
        "/scene.glb" => match MESH.try_lock() {
            Err(TryLockError::WouldBlock) => return text(503, "a mesh is being made; try again in a minute"),
            _one => mesh(input),
        },
        _ => return text(404, "no such page"),
    };
    let extension = &path["/scene".len()..];
    match made {
        Ok(content) => {
            let stem = input.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
            let name = percent_encoded(&format!("{stem}{extension}"));
            response(200, "application/octet-stream", content)
                .with_header(header("Content-Disposition", &format!("attachment; filename*=UTF-8''{name}")))
                .with_header(header("X-Name", &name))
        }
        Err(e) => text(422, &e.to_string()),
    }
}

/// The file as it is now, without what is not finite: whatever kind it is, the page gets the kind it knows.
fn bytes(input: &Path, kind: Kind) -> Result<Vec<u8>, Failure> {
    let mut stored = Stored::read(input)?;
    stored.drop_not_finite();
    Ok(stored.to_bytes(kind)?)
}

/// A mesh as `snapsnap mesh` makes it.
fn mesh(input: &Path) -> Result<Vec<u8>, Failure> {
    let fused = fuse(&Stored::read(input)?.load(&Device::flex()), Options::default(), &|_| {})?;
    export::glb_bytes(&fused.mesh).map_err(|e| Failure::Internal(e.to_string()))
}

fn text(status: u16, message: &str) -> Response<Cursor<Vec<u8>>> {
    response(status, "text/plain; charset=utf-8", say::printable(message).into_bytes())
}

fn response(status: u16, kind: &str, content: Vec<u8>) -> Response<Cursor<Vec<u8>>> {
    Response::from_data(content)
        .with_status_code(StatusCode(status))
        .with_header(header("Content-Type", kind))
        .with_header(header("Content-Security-Policy", POLICY))
        .with_header(header("X-Content-Type-Options", "nosniff"))
        // The next program on this port may serve another person.
        .with_header(header("Cache-Control", "no-store"))
}

fn header(name: &str, value: &str) -> Header {
    Header::from_bytes(name, value).expect("ASCII")
}

/// For a header: everything but letters, digits and the like as the bytes of its UTF-8.
fn percent_encoded(text: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte);
    text.bytes()
        .map(|byte| if plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") })
        .collect()
}
