//! The page of `view` and `studio` (crates/app/viewer), and the refusals and answers of both servers.

use std::collections::HashMap;
use std::io;
use std::net::{Ipv4Addr, TcpListener};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use base64::prelude::{BASE64_STANDARD, Engine};
use clap::Args;
use http::StatusCode;
use snapsnap_base::FileError;

use crate::failure::Failure;
use crate::guests::Guests;
use crate::server::{Answer, Body, Content, Refusal, Request, serve};
use crate::{interrupt, say};

/// Options of a page.
#[derive(Args)]
pub struct PageArguments {
    /// Port [default: a free one].
    #[arg(long)]
    port: Option<u16>,
    /// Also serve the local network: a QR code leads a telephone to the page. Each address is good for one device.
    /// Nothing is encrypted.
    #[arg(long)]
    lan: bool,
    /// Start the browser.
    #[arg(long)]
    open: bool,
}

/// Content security policy without any other host.
const POLICY: &str = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; \
                      connect-src 'self' blob: data:; img-src 'self' blob: data:; style-src 'self'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

/// Files of the page: path, type and content.
const FILES: [(&str, &str, &[u8]); 3] = [
    ("/viewer.js", "text/javascript; charset=utf-8", include_bytes!("../../../assets/viewer/viewer.js")),
    ("/viewer.css", "text/css; charset=utf-8", include_bytes!("../../../assets/viewer/viewer.css")),
    ("/LICENSES.md", "text/markdown; charset=utf-8", include_bytes!("../../../assets/viewer/LICENSES.md")),
];
const INDEX: &str = include_str!("../viewer/index.html");
/// The part of [`INDEX`] that tells the page's script which command serves it.
const VIEW: &str = "<html lang=\"en\" class=\"view\">";
/// The parts of [`INDEX`] that lead to its script and its style.
const SCRIPT: &str = "<script type=\"module\" src=\"./viewer.js\"></script>";
const STYLE: &str = "<link rel=\"stylesheet\" href=\"./viewer.css\" />";

/// One HTML file that shows an SPZ without a server.
pub fn alone(name: &str, spz: &[u8]) -> String {
    let [script, style] = [FILES[0].2, FILES[1].2].map(String::from_utf8_lossy);
    // A script ends at this tag, also within a text of its own.
    let script = script.replace("</script", "<\\/script");
    let name = name.replace('&', "&amp;").replace('"', "&quot;").replace('<', "&lt;");
    let scene = BASE64_STANDARD.encode(spz);
    let scene = format!("<script id=\"scene\" type=\"text/plain\" data-name=\"{name}\">{scene}</script>");
    // The script comes last: it may contain the other texts.
    INDEX
        .replace("</body>", &format!("{scene}</body>"))
        .replace(STYLE, &format!("<style>{style}</style>"))
        .replace(SCRIPT, &format!("<script type=\"module\">{script}</script>"))
}

/// Serves the page of a command, `view` or `studio`, until the program ends. `shows` is its content in words; `rest`
/// answers requests for other paths, or refuses them with an answer.
pub fn show(
    command: &str,
    arguments: &PageArguments,
    shows: &str,
    rest: &(dyn Fn(&Request, &mut Body) -> Result<Answer, Answer> + Sync),
) -> Result<(), Failure> {
    let wanted = arguments.port.unwrap_or(0);
    let own = if arguments.lan { Ipv4Addr::UNSPECIFIED } else { Ipv4Addr::LOCALHOST };
    let cannot = |e: io::Error| Failure::Input(format!("--port {wanted}: cannot listen on {own}: {e}"));
    let listener = TcpListener::bind((own, wanted)).map_err(cannot)?;
    let port = listener.local_addr().map_err(cannot)?.port();
    let guests = arguments.lan.then(|| Guests::new(port)).transpose()?;
    let url = format!("http://127.0.0.1:{port}/");
    interrupt::end_well();
    // The address is printed with --quiet as well.
    say::out(&url);
    say::note(&format!("{shows}; Ctrl-C ends it"));
    guests.iter().for_each(Guests::invite);
    if arguments.open
        && let Err(e) = open::that_detached(&url)
    {
        say::err(&format!("warning: --open: no browser could be started ({e}); open {url} by hand"));
    }
    serve(&listener, &|request, body| {
        let answer = refused(request, port, guests.as_ref()).or_else(|| {
            let guests = guests.as_ref().filter(|_| request.is_near);
            match guests.filter(|_| request.path == "/invitation" && is_read(request)) {
                Some(guests) => Some(guests.invitation()),
                None => file(&format!("{command}{}", guests.map_or("", |_| " inviting")), request),
            }
        });
        answer.unwrap_or_else(|| rest(request, body).unwrap_or_else(|refused| refused))
    })
}

/// Refuses requests of anybody but this server's own page, on this machine or on a device that has joined, and lets
/// devices join.
fn refused(request: &Request, port: u16, guests: Option<&Guests>) -> Option<Answer> {
    // Other names may belong to a page of another host whose name resolves to this machine.
    let is_own = |host: &str| {
        let host = host.to_ascii_lowercase();
        // Browsers omit port 80.
        let name = host.strip_suffix(&format!(":{port}")).or((port == 80).then_some(host.as_str()));
        name.is_some_and(|name| match guests {
            Some(guests) if guests.is_host(name) => true,
            _ => request.is_near && ["127.0.0.1", "localhost"].contains(&name),
        })
    };
    if !request.header("host").is_some_and(is_own) {
        return Some(text(StatusCode::FORBIDDEN, "only for http://127.0.0.1"));
    }
    if let Some(guests) = guests.filter(|_| !request.is_near) {
        let joined = guests.joined(request);
        if joined.is_some() {
            return joined;
        }
        if !guests.knows(request) {
            let message = "open the address that the program and its page on the computer show";
            return Some(text(StatusCode::FORBIDDEN, message));
        }
    }
    // A page of another site may lead here, but may not start any work.
    let is_own_origin = |origin: &str| origin.strip_prefix("http://").is_some_and(is_own);
    // By this header a browser names the requesting page's relation to the server.
    let is_own_page = request.header("origin").is_none_or(is_own_origin)
        && request.header("sec-fetch-site").is_none_or(|site| ["same-origin", "none"].contains(&site));
    (!is_own_page && request.path != "/")
        .then(|| text(StatusCode::FORBIDDEN, "only for this server's own page"))
}

/// A file of the page, whose HTML has these classes.
fn file(classes: &str, request: &Request) -> Option<Answer> {
    if !is_read(request) {
        return None;
    }
    if request.path == "/" {
        let index = INDEX.replace(VIEW, &VIEW.replace("view", classes));
        return Some(answer("text/html; charset=utf-8", Arc::new(index)));
    }
    let (_, kind, content) = FILES.iter().find(|(name, ..)| *name == request.path)?;
    Some(answer(kind, Arc::new(*content)))
}

/// Whether the request only reads.
pub fn is_read(request: &Request) -> bool {
    ["GET", "HEAD"].contains(&request.method.as_str())
}

/// The answer that is a message.
pub fn text(status: StatusCode, message: &str) -> Answer {
    let content = Arc::new(say::printable(message).into_bytes());
    Answer { status, ..answer("text/plain; charset=utf-8", content) }
}

/// The answer that asks the page to try again later.
pub fn busy() -> Answer {
    text(StatusCode::SERVICE_UNAVAILABLE, "the server is busy with earlier requests; try again in a minute")
}

pub fn answer(kind: &str, content: Content) -> Answer {
    let headers = vec![
        ("Content-Type", kind.to_owned()),
        ("Content-Security-Policy", POLICY.to_owned()),
        ("X-Content-Type-Options", "nosniff".to_owned()),
        // Another program may use the port later.
        ("Cache-Control", "no-store".to_owned()),
    ];
    Answer { status: StatusCode::OK, headers, content }
}

/// The answer that is a file of this name.
pub fn download(name: &str, content: Content) -> Answer {
    let name = percent_encoded(name);
    let mut answer = answer("application/octet-stream", content);
    let disposition = format!("attachment; filename*=UTF-8''{name}");
    answer.headers.extend([("Content-Disposition", disposition), ("X-Name", name)]);
    answer
}

/// The text with percent codes for all bytes but unreserved characters (RFC 3986).
fn percent_encoded(text: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte);
    text.bytes()
        .map(|byte| if plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") })
        .collect()
}

/// The current step of each job that a page waits for.
static STEPS: LazyLock<Mutex<HashMap<String, String>>> = LazyLock::new(Mutex::default);

fn steps<T>(change: impl FnOnce(&mut HashMap<String, String>) -> T) -> T {
    change(&mut STEPS.lock().unwrap_or_else(PoisonError::into_inner))
}

/// The page's name for its work.
fn job(request: &Request) -> &str {
    request.header("x-job").unwrap_or_default()
}

/// Work that a page waits for. `/progress` tells its steps.
pub struct Job(String);

impl Job {
    /// The work of a request, under the page's name for it.
    pub fn of(request: &Request) -> Self {
        Self(job(request).to_owned())
    }

    /// Tells the step that begins.
    pub fn step(&self, name: &str) {
        steps(|steps| steps.insert(self.0.clone(), name.to_owned()));
    }
}

impl Drop for Job {
    fn drop(&mut self) {
        steps(|steps| steps.remove(&self.0));
    }
}

/// The step of the job that the request names; nothing if there is none.
pub fn progress(request: &Request) -> Answer {
    text(StatusCode::OK, &steps(|steps| steps.get(job(request)).cloned()).unwrap_or_default())
}

impl From<Refusal> for Answer {
    fn from((status, message): Refusal) -> Self {
        text(status, message)
    }
}

impl From<Failure> for Answer {
    fn from(failure: Failure) -> Self {
        let status = match failure {
            Failure::Input(_) => StatusCode::UNPROCESSABLE_ENTITY,
            Failure::Write(_) | Failure::Internal(_) => StatusCode::INTERNAL_SERVER_ERROR,
        };
        text(status, &failure.to_string())
    }
}

impl From<FileError> for Answer {
    fn from(e: FileError) -> Self {
        Failure::from(e).into()
    }
}
