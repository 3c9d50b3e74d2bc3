//! A small web server for a few clients, with one request per connection. The time of a connection and the memory of
//! all uploads are bounded. All connections share one copy of a file.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use http::StatusCode;

/// Largest number of simultaneous connections. Further ones are closed.
const CONNECTIONS: usize = 64;
/// Largest size of a request line with headers, in bytes.
const LONGEST: usize = 16 << 10;
/// Largest number of headers.
const HEADERS: usize = 64;
/// Time limit of a request.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time limit of an answer or an upload.
const LONGEST_ANSWER: Duration = Duration::from_secs(600);
/// Time that every answer and upload may take, and bytes per second that are required beyond this time. A client
/// behind an SSH tunnel is faster.
const ALLOWANCE: Duration = Duration::from_secs(10);
const SLOWEST: u64 = 512 << 10;
/// Bytes of one write or read.
const PART: usize = 256 << 10;
/// Largest number of bytes of all uploads that are in memory.
const MOST_HELD: u64 = 600 << 20;

/// Bytes of all uploads that are in memory.
static HELD: AtomicU64 = AtomicU64::new(0);

pub struct Request {
    /// The path, without query and fragment.
    pub path: String,
    /// The method, for example GET.
    pub method: String,
    /// Whether it comes from this machine.
    pub is_near: bool,
    /// Names in lower case, and values.
    headers: Vec<(String, String)>,
}

impl Request {
    /// The value of the first header with this name, in lower case.
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(other, _)| other == name).map(|(_, value)| value.as_str())
    }
}

/// Bytes of an answer.
pub type Bytes = dyn AsRef<[u8]> + Send + Sync;
/// Content of an answer.
pub type Content = Arc<Bytes>;

pub struct Answer {
    pub status: StatusCode,
    pub headers: Vec<(&'static str, String)>,
    pub content: Content,
}

/// Status and message of a refused request.
pub type Refusal = (StatusCode, &'static str);

/// The body of a request, which is read on demand.
pub struct Body<'a> {
    stream: &'a mut TcpStream,
    /// Bytes that arrived with the headers.
    begun: Vec<u8>,
    length: Option<u64>,
}

const SLOW: Refusal = (StatusCode::REQUEST_TIMEOUT, "the upload is too slow");

impl Body<'_> {
    /// Whether the client still waits for the answer.
    pub fn is_awaited(&self) -> bool {
        let _ = self.stream.set_nonblocking(true);
        let seen = self.stream.peek(&mut [0]);
        let _ = self.stream.set_nonblocking(false);
        seen.map_or_else(|e| e.kind() == io::ErrorKind::WouldBlock, |count| count > 0)
    }

    /// Reads the body. Refuses a body of more than `most` bytes or beyond [`MOST_HELD`], and a slow client. Memory
    /// grows with the bytes that arrive, not with the announced length.
    pub fn read(&mut self, most: u64) -> Result<Upload, Refusal> {
        let length = self.length.ok_or((StatusCode::LENGTH_REQUIRED, "the request has no Content-Length"))?;
        if length > most {
            return Err((StatusCode::PAYLOAD_TOO_LARGE, "the file is too large"));
        }
        let mut upload = Upload(Vec::new());
        let begun = std::mem::take(&mut self.begun);
        upload.append(&begun[..begun.len().min(length as usize)])?;
        let start = Instant::now();
        let mut part = vec![0; PART];
        while (upload.0.len() as u64) < length {
            let left = time_left(start, upload.0.len() as u64);
            self.stream.set_read_timeout(Some(left)).map_err(|_| SLOW)?;
            let wanted = (length - upload.0.len() as u64).min(PART as u64) as usize;
            match self.stream.read(&mut part[..wanted]) {
                Ok(n) if n > 0 => upload.append(&part[..n])?,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) if [io::ErrorKind::WouldBlock, io::ErrorKind::TimedOut].contains(&e.kind()) => {
                    return Err(SLOW);
                }
                _ => return Err((StatusCode::BAD_REQUEST, "the upload was cut short")),
            }
        }
        Ok(upload)
    }
}

/// An uploaded body in memory.
pub struct Upload(Vec<u8>);

impl Upload {
    fn append(&mut self, bytes: &[u8]) -> Result<(), Refusal> {
        let held = HELD.fetch_add(bytes.len() as u64, Ordering::Relaxed) + bytes.len() as u64;
        if held > MOST_HELD {
            HELD.fetch_sub(bytes.len() as u64, Ordering::Relaxed);
            return Err((
                StatusCode::SERVICE_UNAVAILABLE,
                "the server holds too many uploads; try again in a minute",
            ));
        }
        self.0.extend(bytes);
        Ok(())
    }
}

impl AsRef<[u8]> for Upload {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

impl Drop for Upload {
    fn drop(&mut self) {
        HELD.fetch_sub(self.0.len() as u64, Ordering::Relaxed);
    }
}

/// Answers requests until the program ends.
pub fn serve(listener: &TcpListener, answer: &(dyn Fn(&Request, &mut Body) -> Answer + Sync)) -> ! {
    let open = AtomicUsize::new(0);
    thread::scope(|scope| {
        loop {
            let Ok((stream, _)) = listener.accept() else {
                // The client has left, or no file descriptor is free. Both are temporary.
                thread::sleep(Duration::from_millis(50));
                continue;
            };
            let open = &open;
            if open.fetch_add(1, Ordering::Relaxed) >= CONNECTIONS {
                open.fetch_sub(1, Ordering::Relaxed);
                continue;
            }
            let connection = move || {
                // Errors of a connection, and panics of the work for it, concern only its client.
                let _ = catch_unwind(AssertUnwindSafe(|| converse(stream, answer)));
                open.fetch_sub(1, Ordering::Relaxed);
            };
            if thread::Builder::new().spawn_scoped(scope, connection).is_err() {
                open.fetch_sub(1, Ordering::Relaxed);
            }
        }
    })
}

fn converse(mut stream: TcpStream, answer: &dyn Fn(&Request, &mut Body) -> Answer) -> io::Result<()> {
    let (is_head, answered) = match request(&mut stream)? {
        Ok((request, begun)) => {
            let length = request.header("content-length").and_then(|length| length.trim().parse().ok());
            let mut body = Body { stream: &mut stream, begun, length };
            (request.method == "HEAD", answer(&request, &mut body))
        }
        Err((status, why)) => (false, Answer { status, headers: Vec::new(), content: Arc::new(why) }),
    };
    let Answer { status, headers, content } = answered;
    let content: &[u8] = (*content).as_ref();
    let length = content.len();
    let mut head = format!("HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: {length}\r\n");
    headers.iter().for_each(|(name, value)| head += &format!("{name}: {value}\r\n"));
    head += "\r\n";
    let start = Instant::now();
    send(&mut stream, head.as_bytes(), start, 0)?;
    if !is_head {
        for (i, part) in content.chunks(PART).enumerate() {
            send(&mut stream, part, start, (i * PART) as u64)?;
        }
    }
    // After an immediate close the client might lose the answer. Hence the rest of the request is read first.
    stream.shutdown(Shutdown::Write)?;
    stream.set_read_timeout(Some(Duration::from_millis(500)))?;
    let end = Instant::now() + Duration::from_secs(2);
    let mut rest = vec![0; PART];
    while Instant::now() < end && stream.read(&mut rest)? > 0 {}
    Ok(())
}

/// Sends a part of an answer that began at `start`, after `sent` other bytes. Slow clients are dropped.
fn send(stream: &mut TcpStream, mut part: &[u8], start: Instant, mut sent: u64) -> io::Result<()> {
    while !part.is_empty() {
        stream.set_write_timeout(Some(time_left(start, sent)))?;
        match stream.write(part) {
            Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
            Ok(n) => {
                part = &part[n..];
                sent += n as u64;
            }
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(())
}

/// The time that is left to a client who began at `start` and has read or written `bytes` bytes. A socket refuses a
/// timeout of 0.
fn time_left(start: Instant, bytes: u64) -> Duration {
    let end = (ALLOWANCE + Duration::from_secs(bytes / SLOWEST)).min(LONGEST_ANSWER);
    end.saturating_sub(start.elapsed())
}

/// Reads a request line and its headers, and the part of the body that arrives with them.
fn request(stream: &mut TcpStream) -> io::Result<Result<(Request, Vec<u8>), Refusal>> {
    let end = Instant::now() + PATIENCE;
    let mut bytes = Vec::new();
    let mut part = [0; 2048];
    loop {
        stream.set_read_timeout(Some(end.saturating_duration_since(Instant::now())))?;
        let n = stream.read(&mut part)?;
        if n == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        bytes.extend(&part[..n]);
        let mut headers = [httparse::EMPTY_HEADER; HEADERS];
        let mut parsed = httparse::Request::new(&mut headers);
        match parsed.parse(&bytes) {
            Ok(httparse::Status::Complete(head)) => {
                let is_near = stream.peer_addr()?.ip().to_canonical().is_loopback();
                return Ok(checked(&parsed, is_near).map(|request| (request, bytes[head..].to_vec())));
            }
            Ok(httparse::Status::Partial) if bytes.len() < LONGEST => {}
            Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => {
                return Ok(Err((StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE, "too long a request")));
            }
            Err(_) => return Ok(Err((StatusCode::BAD_REQUEST, "no HTTP request"))),
        }
    }
}

fn checked(parsed: &httparse::Request, is_near: bool) -> Result<Request, Refusal> {
    let texts = parsed
        .headers
        .iter()
        .map(|header| (header.name.to_ascii_lowercase(), String::from_utf8_lossy(header.value).into_owned()));
    let headers: Vec<(String, String)> = texts.collect();
    if headers.iter().filter(|(name, _)| name == "host").count() > 1 {
        return Err((StatusCode::BAD_REQUEST, "two Host headers"));
    }
    let target = parsed.path.unwrap_or_default();
    // Requests to proxies contain the whole address.
    let path =
        target.strip_prefix("http://").map_or(target, |rest| rest.find('/').map_or("/", |at| &rest[at..]));
    let path = path.split(['?', '#']).next().unwrap_or_default().to_owned();
    Ok(Request { path, method: parsed.method.unwrap_or_default().to_owned(), is_near, headers })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clients_that_leave_are_noticed() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let client = TcpStream::connect(listener.local_addr().expect("bound")).expect("connects");
        let (mut stream, _) = listener.accept().expect("a client");
        let body = Body { stream: &mut stream, begun: Vec::new(), length: None };
        assert!(body.is_awaited());
        drop(client);
        let end = Instant::now() + PATIENCE;
        while body.is_awaited() {
            assert!(Instant::now() < end, "a client that left is still awaited");
            thread::sleep(Duration::from_millis(5));
        }
    }
}
