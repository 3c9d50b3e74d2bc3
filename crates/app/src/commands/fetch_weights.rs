//! `snapsnap fetch-weights`: published weights, checked byte by byte.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, ValueEnum};
use sha2::{Digest, Sha256};
use snapsnap_base::file;
use snapsnap_eval::lpips;
use ureq::Agent;
use ureq::http::StatusCode;

use crate::failure::Failure;
use crate::pictures::make_folder;
use crate::progress::Progress;
use crate::say;

/// Attempts in a row that bring nothing, after which it ends.
const ATTEMPTS: u32 = 4;
/// Longest time for the first attempt, and for any: what it brought is kept and the next one, twice as long, goes on from there.
const ATTEMPT: [Duration; 2] = [Duration::from_secs(60), Duration::from_secs(20 * 60)];
/// Longest silence before an answer begins.
const SILENCE: Duration = Duration::from_secs(60);
/// Bytes read at a time.
const CHUNK: usize = 1 << 16;

#[derive(Args)]
pub struct Arguments {
    /// Names to fetch [default: all].
    #[arg(value_enum)]
    what: Vec<Name>,
    /// A folder with the files, or a mirror's address below which they lie, instead of where they were published.
    #[arg(long, value_name = "DIR|URL")]
    from: Option<String>,
    /// Folder to put them into.
    #[arg(short, long, value_name = "DIR", default_value = "weights")]
    output: PathBuf,
    /// Only show what there is to fetch.
    #[arg(long)]
    list: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Name {
    /// DUSt3R, for `import-weights`: what the paper's training begins with.
    Dust3r,
    /// The network of LPIPS.
    Alexnet,
    /// The learned layers of LPIPS.
    Lpips,
}

/// A published file.
struct Item {
    name: Name,
    /// Here and on mirrors.
    file: &'static str,
    url: &'static str,
    bytes: u64,
    sha256: &'static str,
    licence: &'static str,
}

/// Sizes and sums: of the LPIPS file as the `lpips` package on PyPI holds it; of the other two as several projects that pin them
/// report them (the first eight digits of AlexNet's are in its name).
const ITEMS: [Item; 3] = [
    Item {
        name: Name::Dust3r,
        file: "DUSt3R_ViTLarge_BaseDecoder_512_dpt.safetensors",
        url: "https://huggingface.co/naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt/resolve/\
              61c57447d7b0adc8a1a30b2b0adec7a8935aa2a3/model.safetensors",
        bytes: 2_284_790_056,
        sha256: "7c300a89534113436bde52732d3151212bcbd90f0aa3c8d1496f86d84bfe4b42",
        licence: "CC BY-NC-SA 4.0 (no commercial use), and the terms of the data that it was trained on",
    },
    Item {
        name: Name::Alexnet,
        file: lpips::PUBLISHED[0],
        url: "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
        bytes: 244_408_911,
        sha256: "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
        licence: "BSD-3-Clause (torchvision); trained on ImageNet",
    },
    Item {
        name: Name::Lpips,
        file: lpips::PUBLISHED[1],
        url: "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/alex.pth",
        bytes: 6_009,
        sha256: "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
        licence: "BSD-2-Clause",
    },
];

/// Where a file comes from.
enum Origin {
    Folder(PathBuf),
    Address(String),
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let wanted: Vec<&Item> = ITEMS
        .iter()
        .filter(|item| arguments.what.is_empty() || arguments.what.contains(&item.name))
        .collect();
    for item in &wanted {
        say::out(&format!("{}\n  {}", item.file, origin(arguments, item).describe()));
        say::out(&format!("  {} bytes, SHA-256 {}\n  licence: {}", item.bytes, item.sha256, item.licence));
    }
    if arguments.list {
        return Ok(());
    }
    if let Origin::Folder(folder) = origin(arguments, wanted[0])
        && !folder.is_dir()
    {
        return Err(Failure::Input(format!(
            "--from {}: is neither a folder nor an address",
            folder.display()
        )));
    }
    make_folder(&arguments.output)?;
    for item in wanted {
        fetch(item, &origin(arguments, item), &arguments.output, quiet)?;
    }
    Ok(())
}

fn origin(arguments: &Arguments, item: &Item) -> Origin {
    match &arguments.from {
        None => Origin::Address(item.url.into()),
        Some(from) if from.starts_with("http://") || from.starts_with("https://") => {
            Origin::Address(format!("{}/{}", from.trim_end_matches('/'), item.file))
        }
        Some(from) => Origin::Folder(from.into()),
    }
}

impl Origin {
    fn describe(&self) -> String {
        match self {
            Self::Folder(folder) => folder.display().to_string(),
            Self::Address(address) => address.clone(),
        }
    }
}

fn fetch(item: &Item, origin: &Origin, folder: &Path, quiet: bool) -> Result<(), Failure> {
    let path = folder.join(item.file);
    let failed = |e: &io::Error| Failure::cannot_write(&path, e);
    if path.symlink_metadata().is_ok() {
        let unreadable = |e| Failure::Input(format!("{}: is there, and cannot be read: {e}", path.display()));
        let mut there = file::open(&path).map_err(unreadable)?;
        let is_sound = there.metadata().is_ok_and(|m| m.len() == item.bytes)
            && sum_of(&mut there).map_err(|e| failed(&e))? == item.sha256;
        if is_sound {
            say::out(&format!("{}: is there, and sound", path.display()));
            return Ok(());
        }
        let message = "is there, but is not the published file; move it away to fetch it";
        return Err(Failure::Input(format!("{}: {message}", path.display())));
    }
    let address = match origin {
        Origin::Folder(from) => return copy(item, &from.join(item.file), &path, quiet),
        Origin::Address(address) => address,
    };
    let part = folder.join(format!("{}.part", item.file));
    // A file of another kind with that name is left alone.
    if part.symlink_metadata().is_ok_and(|there| !there.is_file() || is_shared(&there)) {
        let message = "is no unfinished download: a link, or no regular file; move it away";
        return Err(Failure::Input(format!("{}: {message}", part.display())));
    }
    let file = OpenOptions::new().create(true).truncate(false).read(true).write(true).open(&part);
    let mut file = file.map_err(|e| failed(&e))?;
    if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) {
        return Err(Failure::Input(format!("{}: is being fetched by another process", part.display())));
    }
    let progress = Progress::bytes(quiet);
    download(address, &mut file, item, &progress, &part)?;
    drop(progress);
    file.seek(SeekFrom::Start(0)).map_err(|e| failed(&e))?;
    let (found, length) =
        (sum_of(&mut file).map_err(|e| failed(&e))?, file.metadata().map_or(0, |m| m.len()));
    if found != item.sha256 || length != item.bytes {
        // Nothing of it can be trusted, so nothing is gone on from.
        let _ = fs::remove_file(&part);
        return Err(Failure::Input(other(&origin.describe(), item, length, &found)));
    }
    file.sync_all().map_err(|e| failed(&e))?;
    fs::rename(&part, &path).map_err(|e| failed(&e))?;
    say::out(&format!("{}: fetched, and sound", path.display()));
    Ok(())
}

/// Takes a file from a folder, whole or not at all.
fn copy(item: &Item, from: &Path, path: &Path, quiet: bool) -> Result<(), Failure> {
    let mut source =
        file::open(from).map_err(|e| Failure::Input(format!("{}: cannot read: {e}", from.display())))?;
    let progress = Progress::bytes(quiet);
    // The checksum is that of the written bytes, even if the source changes meanwhile.
    let written = file::write_whole(path, |out| {
        let mut out = Summed { out, hasher: Sha256::new() };
        let length = take(&mut source, &mut out, 0, item, &progress)?;
        let found = hexadecimal(out.hasher);
        match found == item.sha256 && length == item.bytes {
            true => Ok(()),
            false => Err(io::Error::new(
                io::ErrorKind::InvalidData,
                other(&from.display().to_string(), item, length, &found),
            )),
        }
    });
    written.map_err(|e: io::Error| match e.kind() {
        io::ErrorKind::InvalidData => Failure::Input(e.to_string()),
        _ => Failure::cannot_write(path, &e),
    })?;
    drop(progress);
    say::out(&format!("{}: fetched, and sound", path.display()));
    Ok(())
}

fn other(origin: &str, item: &Item, length: u64, found: &str) -> String {
    format!("{origin}: what came is not {}: {length} bytes with SHA-256 {found}; nothing was kept", item.file)
}

/// Sums what it writes.
struct Summed<'a, W> {
    out: &'a mut W,
    hasher: Sha256,
}

impl<W: Write> Write for Summed<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.out.write(bytes)?;
        self.hasher.update(&bytes[..n]);
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// Whether a file has another name as well.
#[cfg(unix)]
fn is_shared(file: &fs::Metadata) -> bool {
    std::os::unix::fs::MetadataExt::nlink(file) > 1
}

#[cfg(not(unix))]
fn is_shared(_: &fs::Metadata) -> bool {
    false
}

/// SHA-256 of the rest of a file, in hexadecimal digits.
fn sum_of(file: &mut File) -> io::Result<String> {
    let mut hasher = Sha256::new();
    let mut chunk = vec![0; CHUNK];
    loop {
        match file.read(&mut chunk)? {
            0 => break,
            n => hasher.update(&chunk[..n]),
        }
    }
    Ok(hexadecimal(hasher))
}

fn hexadecimal(hasher: Sha256) -> String {
    hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Copies until the source ends or there is one byte too many; returns how many bytes there are then.
fn take(
    source: &mut dyn Read,
    file: &mut dyn Write,
    from: u64,
    item: &Item,
    progress: &Progress,
) -> io::Result<u64> {
    let mut at = from;
    let mut chunk = vec![0; CHUNK];
    while at <= item.bytes {
        let most = CHUNK.min((item.bytes + 1 - at) as usize);
        let n = source.read(&mut chunk[..most])?;
        if n == 0 {
            break;
        }
        file.write_all(&chunk[..n])?;
        at += n as u64;
        progress.advance(at, item.bytes);
    }
    Ok(at)
}

/// Fills the file from where it ends; an attempt that breaks off is followed by another that goes on.
fn download(
    address: &str,
    file: &mut File,
    item: &Item,
    progress: &Progress,
    part: &Path,
) -> Result<(), Failure> {
    let agent = |time: Duration| -> Agent {
        let config = Agent::config_builder()
            .timeout_connect(Some(SILENCE))
            .timeout_recv_response(Some(SILENCE))
            .timeout_recv_body(Some(time))
            .http_status_as_error(false);
        config.build().into()
    };
    let cannot_write = |e: io::Error| Failure::cannot_write(part, &e);
    // The most that there ever was: a server that makes us begin again brings nothing.
    let (mut fruitless, mut most, mut time) = (0, 0, ATTEMPT[0]);
    loop {
        let before = file.seek(SeekFrom::End(0)).map_err(cannot_write)?;
        if before == item.bytes {
            return Ok(());
        }
        if before > item.bytes {
            file.set_len(0).map_err(cannot_write)?;
            continue;
        }
        most = most.max(before);
        let why = match attempt(&agent(time), address, file, before, item, progress) {
            Ok(()) => "the connection ended early".to_owned(),
            Err(Broken::Refused(message)) => {
                return Err(Failure::Internal(format!("{address}: {message}")));
            }
            Err(Broken::Write(e)) => return Err(cannot_write(e)),
            Err(Broken::Connection(message)) => message,
        };
        let after = file.metadata().map_err(cannot_write)?.len();
        if after >= item.bytes {
            return Ok(());
        }
        (fruitless, time) =
            if after > most { (0, ATTEMPT[1].min(2 * time)) } else { (fruitless + 1, ATTEMPT[0]) };
        if fruitless == ATTEMPTS {
            if after == 0 {
                let _ = fs::remove_file(part);
            }
            let kept = format!("{after} of {} bytes are kept and gone on from next time", item.bytes);
            return Err(Failure::Internal(format!("{address}: {why}; {kept}")));
        }
        std::thread::sleep(Duration::from_millis(200 << fruitless));
    }
}

/// Why an attempt ended.
enum Broken {
    /// Another attempt may bring more.
    Connection(String),
    /// No other attempt will.
    Refused(String),
    /// The disk.
    Write(io::Error),
}

fn attempt(
    agent: &Agent,
    address: &str,
    file: &mut File,
    from: u64,
    item: &Item,
    progress: &Progress,
) -> Result<(), Broken> {
    let mut request = agent.get(address);
    if from > 0 {
        request = request.header("Range", format!("bytes={from}-"));
    }
    let mut answer = request.call().map_err(|e| Broken::Connection(e.to_string()))?;
    let status = answer.status();
    let start = answer.headers().get("content-range").and_then(|range| range.to_str().ok());
    let goes_on = status == StatusCode::PARTIAL_CONTENT
        && start.is_some_and(|range| range.starts_with(&format!("bytes {from}-")));
    let from = match status {
        StatusCode::PARTIAL_CONTENT if goes_on => from,
        // The server knows no ranges: from the beginning.
        StatusCode::OK => 0,
        StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE => {
            file.set_len(0).map_err(Broken::Write)?;
            return Err(Broken::Connection(format!("the server answers with another range than {from}-")));
        }
        _ if status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS => {
            return Err(Broken::Connection(format!("the server answers {status}")));
        }
        _ => return Err(Broken::Refused(format!("the server answers {status}"))),
    };
    file.set_len(from).map_err(Broken::Write)?;
    file.seek(SeekFrom::Start(from)).map_err(Broken::Write)?;
    let mut body = answer.body_mut().with_config().limit(u64::MAX).reader();
    let mut source = Source { body: &mut body, broken: None };
    let taken = take(&mut source, file, from, item, progress);
    match (taken, source.broken) {
        (_, Some(why)) => Err(Broken::Connection(why)),
        (Err(e), None) => Err(Broken::Write(e)),
        (Ok(_), None) => Ok(()),
    }
}

/// A body whose errors are told from those of the disk.
struct Source<'a> {
    body: &'a mut dyn Read,
    broken: Option<String>,
}

impl Read for Source<'_> {
    fn read(&mut self, chunk: &mut [u8]) -> io::Result<usize> {
        self.body.read(chunk).or_else(|e| {
            self.broken = Some(e.to_string());
            Ok(0)
        })
    }
}
