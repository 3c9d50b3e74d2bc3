//! `snapsnap view` and `snapsnap studio` as servers.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};

use crate::snapsnap;

/// A server process, which is killed when this is dropped.
pub struct Server {
    process: Child,
    /// Port on 127.0.0.1.
    pub port: u16,
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Server {
    /// Serves a file of Gaussians on a free port.
    pub fn new(file: &Path) -> Self {
        let mut command = snapsnap();
        command.arg("view").arg(file).stderr(Stdio::null());
        Self::started(command)
    }

    /// A studio on a free port, with canvases of `resolution`² pixels.
    pub fn studio(resolution: u32) -> Self {
        let mut command = snapsnap();
        command.args(["studio", "--device", "cpu", "--set", &format!("network.resolution={resolution}")]);
        command.stderr(Stdio::null());
        Self::started(command)
    }

    /// A studio for the local network, and what it says before the first address for a device.
    pub fn studio_in_lan(resolution: u32) -> (Self, BufReader<ChildStderr>) {
        let mut command = snapsnap();
        command.args(["studio", "--lan", "--device", "cpu", "--set"]);
        command.arg(format!("network.resolution={resolution}")).stderr(Stdio::piped());
        let mut server = Self::started(command);
        let said = server.process.stderr.take().expect("piped");
        (server, BufReader::new(said))
    }

    fn started(mut command: Command) -> Self {
        command.stdout(Stdio::piped());
        let mut process = command.spawn().expect("started");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("an address");
        let port = line.trim().strip_prefix("http://127.0.0.1:").and_then(|rest| rest.strip_suffix('/'));
        let port = port.and_then(|port| port.parse().ok()).unwrap_or_else(|| panic!("{line}"));
        Self { process, port }
    }

    /// Memory of the process in bytes.
    #[cfg(target_os = "linux")]
    pub fn memory(&self) -> u64 {
        self.status("VmRSS:")
    }

    /// Address space of the process in bytes: memory that it asked for, used or not.
    #[cfg(target_os = "linux")]
    pub fn address_space(&self) -> u64 {
        self.status("VmSize:")
    }

    #[cfg(target_os = "linux")]
    fn status(&self, key: &str) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id())).expect("running");
        let line = status.lines().find_map(|line| line.strip_prefix(key)).expect("a line");
        line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number") << 10
    }

    /// Status, headers in lower case, and content.
    pub fn ask(&self, request: &str, host: Option<&str>) -> (u16, String, Vec<u8>) {
        let own = format!("127.0.0.1:{}", self.port);
        let host = host.unwrap_or(&own);
        self.answer(format!("{request} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").as_bytes())
    }

    /// As [`Self::ask`], with a body and further headers, each with its line's end.
    pub fn post(&self, path: &str, headers: &str, body: &[u8]) -> (u16, String, Vec<u8>) {
        let length = body.len();
        let head = format!("Host: 127.0.0.1:{}\r\nContent-Length: {length}\r\n{headers}\r\n", self.port);
        self.answer(&[format!("POST {path} HTTP/1.1\r\n{head}").as_bytes(), body].concat())
    }

    fn answer(&self, request: &[u8]) -> (u16, String, Vec<u8>) {
        self.answer_at("127.0.0.1", request)
    }

    /// The answer to a request's bytes at an address of this machine.
    pub fn answer_at(&self, address: &str, request: &[u8]) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect((address, self.port)).expect("connected");
        // The server may close the connection before it has read a refused body.
        let _ = stream.write_all(request);
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("answered");
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("headers");
        let headers = String::from_utf8_lossy(&answer[..end]).to_ascii_lowercase();
        let status = headers.split(' ').nth(1).and_then(|status| status.parse().ok()).expect("a status");
        (status, headers, answer[end + 4..].to_vec())
    }
}
