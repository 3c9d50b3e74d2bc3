//! A small web server for this machine alone: GET and HEAD, one request a connection. Whatever a client sends or leaves out, it
//! costs a bounded time and memory.

use std::borrow::Cow;
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// Most connections at once; more are closed.
const CONNECTIONS: usize = 64;
/// Longest request line with headers, bytes.
const LONGEST: usize = 16 << 10;
/// Most headers.
const HEADERS: usize = 64;
/// A request must be there after so long.
const PATIENCE: Duration = Duration::from_secs(10);
/// A client that takes nothing for so long is gone.
const STALLED: Duration = Duration::from_secs(20);

/// A request.
pub struct Request {
    /// The path, without what follows `?` or `#`.
    pub path: String,
    /// The one `Host` header.
    pub host: Option<String>,
    /// GET, or whatever else it is.
    pub method: String,
}

/// An answer.
pub struct Answer {
    pub status: u16,
    pub headers: Vec<(&'static str, String)>,
    pub content: Cow<'static, [u8]>,
}

/// Answers requests for ever.
pub fn serve(listener: &TcpListener, answer: &(dyn Fn(&Request) -> Answer + Sync)) -> ! {
    let open = AtomicUsize::new(0);
    thread::scope(|scope| {
        loop {
            let Ok((stream, _)) = listener.accept() else {
                // A client that is gone already, or no file descriptor left: both pass.
                thread::sleep(Duration::from_millis(50));
                continue;
            };
            let open = &open;
            if open.fetch_add(1, Ordering::Relaxed) >= CONNECTIONS {
                open.fetch_sub(1, Ordering::Relaxed);
                continue;
            }
            let connection = move || {
                // A connection that breaks is the client's business.
                let _ = converse(stream, answer);
                open.fetch_sub(1, Ordering::Relaxed);
            };
            if thread::Builder::new().spawn_scoped(scope, connection).is_err() {
                open.fetch_sub(1, Ordering::Relaxed);
            }
        }
    })
}

fn converse(mut stream: TcpStream, answer: &dyn Fn(&Request) -> Answer) -> io::Result<()> {
    stream.set_write_timeout(Some(STALLED))?;
    let (is_head, answered) = match request(&mut stream)? {
        Ok(request) => (request.method == "HEAD", answer(&request)),
        Err((status, why)) => (false, Answer { status, headers: Vec::new(), content: why.as_bytes().into() }),
    };
    let Answer { status, headers, content } = answered;
    let mut head = format!("HTTP/1.1 {status} {}\r\nConnection: close\r\n", reason(status));
    head += &format!("Content-Length: {}\r\n", content.len());
    headers.iter().for_each(|(name, value)| head += &format!("{name}: {value}\r\n"));
    head += "\r\n";
    stream.write_all(head.as_bytes())?;
    if !is_head {
        stream.write_all(&content)?;
    }
    drop(content);
    // The rest of the request is read for a moment: after an immediate close, the client might lose the answer.
    stream.shutdown(Shutdown::Write)?;
    stream.set_read_timeout(Some(Duration::from_millis(500)))?;
    let end = Instant::now() + Duration::from_secs(2);
    let mut rest = [0; 4096];
    while Instant::now() < end && stream.read(&mut rest)? > 0 {}
    Ok(())
}

/// Reads a request's head, or says with which status it is refused.
fn request(stream: &mut TcpStream) -> io::Result<Result<Request, (u16, &'static str)>> {
    let end = Instant::now() + PATIENCE;
    let mut bytes = Vec::new();
    let mut part = [0; 2048];
    loop {
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        stream.set_read_timeout(Some(left))?;
        let n = stream.read(&mut part)?;
        if n == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        bytes.extend(&part[..n]);
        let mut headers = [httparse::EMPTY_HEADER; HEADERS];
        let mut parsed = httparse::Request::new(&mut headers);
        match parsed.parse(&bytes) {
            Ok(httparse::Status::Complete(_)) => return Ok(understood(&parsed)),
            Ok(httparse::Status::Partial) if bytes.len() < LONGEST => {}
            Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => {
                return Ok(Err((431, "too long a request")));
            }
            Err(_) => return Ok(Err((400, "no HTTP request"))),
        }
    }
}

fn understood(parsed: &httparse::Request) -> Result<Request, (u16, &'static str)> {
    let mut hosts = parsed.headers.iter().filter(|header| header.name.eq_ignore_ascii_case("host"));
    let host = hosts.next().map(|header| String::from_utf8_lossy(header.value).into_owned());
    if hosts.next().is_some() {
        return Err((400, "two Host headers"));
    }
    let target = parsed.path.unwrap_or_default();
    // As proxies are asked.
    let path =
        target.strip_prefix("http://").map_or(target, |rest| rest.find('/').map_or("/", |at| &rest[at..]));
    let path = path.split(['?', '#']).next().unwrap_or_default().to_owned();
    Ok(Request { path, host, method: parsed.method.unwrap_or_default().to_owned() })
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        400 => "Bad Request",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        422 => "Unprocessable Content",
        431 => "Request Header Fields Too Large",
        503 => "Service Unavailable",
        _ => "",
    }
}
