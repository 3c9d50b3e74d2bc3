//! `snapsnap fetch-weights`: downloads published weights and checks their SHA-256.

use std::fs::{self, File, TryLockError};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, ValueEnum};
use snapsnap_base::{FileError, file};
use snapsnap_eval::lpips;
use ureq::Agent;
use ureq::http::StatusCode;

use crate::failure::{Failure, bail};
use crate::output::make_folder;
use crate::progress::Progress;
use crate::say;
use crate::weights::sha256;

/// Attempts in a row without new bytes after which the download fails.
const ATTEMPTS: u32 = 4;
/// Time limits of the first and of the longest attempt. The limit doubles after an attempt that brought new bytes.
const ATTEMPT: [Duration; 2] = [Duration::from_secs(60), Duration::from_secs(20 * 60)];
/// Time limit of the connection, and of the wait for a response.
const SILENCE: Duration = Duration::from_secs(60);
/// Bytes read at a time.
const CHUNK: usize = 1 << 16;

#[derive(Args)]
pub struct Arguments {
    /// Names to fetch [default: all].
    #[arg(value_enum)]
    what: Vec<Name>,
    /// A folder with the files, or the address of a mirror, instead of the published addresses.
    #[arg(long, value_name = "DIR|URL")]
    from: Option<String>,
    /// Folder of the downloaded files.
    #[arg(short, long, value_name = "DIR", default_value = "weights")]
    output: PathBuf,
    /// Only list the files.
    #[arg(long)]
    list: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Name {
    /// DUSt3R, for `import-weights`: the initial weights of the paper's training.
    Dust3r,
    /// The network of LPIPS.
    Alexnet,
    /// The learned layers of LPIPS.
    Lpips,
}

/// A published file.
struct Item {
    name: Name,
    /// File name, also on mirrors.
    file: &'static str,
    url: &'static str,
    bytes: u64,
    sha256: &'static str,
    licence: &'static str,
}

/// Size and sum of the LPIPS file are from the `lpips` package on PyPI, the others from several projects that pin
/// them. AlexNet's name contains the first eight digits of its sum.
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

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let wanted: Vec<(&Item, String)> = ITEMS
        .iter()
        .filter(|item| arguments.what.is_empty() || arguments.what.contains(&item.name))
        .map(|item| (item, origin(arguments, item)))
        .collect();
    let lines = wanted.iter().map(|(Item { file, bytes, sha256, licence, .. }, origin)| {
        format!("{file}\n  {origin}\n  {bytes} bytes, SHA-256 {sha256}\n  licence: {licence}")
    });
    say::lines(&lines.collect::<Vec<_>>().join("\n"))?;
    if arguments.list {
        return Ok(());
    }
    if let Some(from) = &arguments.from
        && !is_address(from)
        && !Path::new(from).is_dir()
    {
        bail!("--from {from}: is neither a folder nor an address");
    }
    make_folder(&arguments.output)?;
    for (item, origin) in &wanted {
        let path = arguments.output.join(item.file);
        let outcome = if path.symlink_metadata().is_ok() {
            check_existing(item, &path)?;
            "is there"
        } else {
            if is_address(origin) {
                download(item, origin, &path)?;
            } else {
                copy(item, Path::new(origin), &path)?;
            }
            "fetched"
        };
        say::out(&format!("{}: {outcome}, and sound", path.display()));
    }
    Ok(())
}

/// The folder or the URL that a file comes from.
fn origin(arguments: &Arguments, item: &Item) -> String {
    match &arguments.from {
        None => item.url.into(),
        Some(from) if is_address(from) => format!("{}/{}", from.trim_end_matches('/'), item.file),
        Some(from) => from.clone(),
    }
}

fn is_address(origin: &str) -> bool {
    origin.starts_with("http://") || origin.starts_with("https://")
}

/// Refuses an existing file that is not the published one.
fn check_existing(item: &Item, path: &Path) -> Result<(), Failure> {
    let unreadable = |e| Failure::file(path, format!("is there, and cannot be read: {e}"));
    let mut file = file::open(path).map_err(unreadable)?;
    if file.metadata().is_ok_and(|m| m.len() == item.bytes)
        && sha256(&mut file).map_err(unreadable)? == item.sha256
    {
        return Ok(());
    }
    Err(Failure::file(path, "is there, but is not the published file; move it away to fetch it"))
}

/// Copies a file from a folder, whole or not at all.
fn copy(item: &Item, folder: &Path, path: &Path) -> Result<(), Failure> {
    let from = folder.join(item.file);
    let mut source = file::open(&from).map_err(FileError::read(&from))?;
    let progress = Progress::bytes();
    let written = file::write_whole(path, |out| {
        take(&mut source, out, 0, item, &progress)?;
        out.flush()?;
        check_sum(item, &from.display().to_string(), out.get_mut())
    });
    written.map_err(|e| match e {
        Broken::Write(e) => Failure::cannot_write(path, &e),
        Broken::Source(message) => Failure::file(&from, format!("cannot read: {message}")),
        Broken::Refused(message) => Failure::Input(message),
    })
}

/// Downloads a file into `FILE.part`, which is renamed once its sum is right.
fn download(item: &Item, address: &str, path: &Path) -> Result<(), Failure> {
    let part = path.with_file_name(format!("{}.part", item.file));
    // A file of another kind with that name is left alone.
    if part.symlink_metadata().is_ok_and(|there| !there.is_file() || is_shared(&there)) {
        let message = "is no unfinished download, but a link or a special file: move it away";
        return Err(Failure::file(&part, message));
    }
    let cannot_write = |e: io::Error| Failure::cannot_write(&part, &e);
    let file = File::options().create(true).truncate(false).read(true).write(true).open(&part);
    let mut file = file.map_err(cannot_write)?;
    if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) {
        return Err(Failure::file(&part, "is being fetched by another process"));
    }
    let filled = fill(&mut file, item, address, &Progress::bytes());
    // A later attempt continues from what has arrived.
    if filled.is_err() && file.metadata().is_ok_and(|there| there.len() == 0) {
        let _ = fs::remove_file(&part);
    }
    filled.map_err(|broken| match broken {
        Broken::Write(e) => cannot_write(e),
        Broken::Source(message) | Broken::Refused(message) => {
            Failure::Internal(format!("{address}: {message}"))
        }
    })?;
    match check_sum(item, address, &mut file) {
        Ok(()) => {}
        Err(Broken::Write(e)) => return Err(cannot_write(e)),
        Err(Broken::Source(message) | Broken::Refused(message)) => {
            // A later attempt must not continue from wrong bytes.
            let _ = fs::remove_file(&part);
            return Err(Failure::Input(message));
        }
    }
    file::rename(&part, path).map_err(|e| Failure::cannot_write(path, &e))
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

/// Why bytes of a file could not be fetched.
enum Broken {
    /// The source broke off. Another attempt may succeed.
    Source(String),
    /// Every attempt will fail.
    Refused(String),
    /// The file cannot be written.
    Write(io::Error),
}

impl From<io::Error> for Broken {
    fn from(e: io::Error) -> Self {
        Self::Write(e)
    }
}

/// Checks the size and the sum of a written file.
fn check_sum(item: &Item, origin: &str, file: &mut File) -> Result<(), Broken> {
    file.rewind()?;
    let (found, length) = (sha256(file)?, file.metadata()?.len());
    if found == item.sha256 && length == item.bytes {
        return Ok(());
    }
    Err(Broken::Refused(format!(
        "{origin}: the content is not that of {}: {length} bytes with SHA-256 {found}; nothing was kept",
        item.file
    )))
}

/// Copies until the source ends or there is one byte too many. `at` bytes are there already.
fn take(
    source: &mut dyn Read,
    file: &mut dyn Write,
    mut at: u64,
    item: &Item,
    progress: &Progress,
) -> Result<(), Broken> {
    let mut chunk = vec![0; CHUNK];
    while at <= item.bytes {
        let most = CHUNK.min((item.bytes + 1 - at) as usize);
        let n = source.read(&mut chunk[..most]).map_err(|e| Broken::Source(e.to_string()))?;
        if n == 0 {
            break;
        }
        file.write_all(&chunk[..n])?;
        at += n as u64;
        progress.advance(at, item.bytes);
    }
    Ok(())
}

/// Downloads the rest of an unfinished file, in several attempts if connections break.
fn fill(file: &mut File, item: &Item, address: &str, progress: &Progress) -> Result<(), Broken> {
    // Progress is counted from the largest length so far. Servers that restart the download make none.
    let (mut fruitless, mut most, mut time) = (0, 0, ATTEMPT[0]);
    loop {
        let before = file.seek(SeekFrom::End(0))?;
        if before == item.bytes {
            return Ok(());
        }
        if before > item.bytes {
            file.set_len(0)?;
            continue;
        }
        most = most.max(before);
        let why = match attempt(time, address, file, before, item, progress) {
            Ok(()) => "the connection ended early".to_owned(),
            Err(Broken::Source(message)) => message,
            Err(broken) => return Err(broken),
        };
        let after = file.metadata()?.len();
        if after >= item.bytes {
            return Ok(());
        }
        (fruitless, time) =
            if after > most { (0, ATTEMPT[1].min(2 * time)) } else { (fruitless + 1, ATTEMPT[0]) };
        if fruitless == ATTEMPTS {
            let kept =
                format!("{after} of {} bytes are kept; the next attempt continues from there", item.bytes);
            return Err(Broken::Source(format!("{why}; {kept}")));
        }
        std::thread::sleep(Duration::from_millis(200 << fruitless));
    }
}

/// Requests the bytes from `from` on and appends them to the file.
fn attempt(
    time: Duration,
    address: &str,
    file: &mut File,
    from: u64,
    item: &Item,
    progress: &Progress,
) -> Result<(), Broken> {
    let config = Agent::config_builder()
        .timeout_connect(Some(SILENCE))
        .timeout_recv_response(Some(SILENCE))
        .timeout_recv_body(Some(time))
        .http_status_as_error(false);
    let mut request = Agent::from(config.build()).get(address);
    if from > 0 {
        request = request.header("Range", format!("bytes={from}-"));
    }
    let mut answer = request.call().map_err(|e| Broken::Source(e.to_string()))?;
    let status = answer.status();
    let range = answer.headers().get("content-range").and_then(|range| range.to_str().ok());
    let continues = range.is_some_and(|range| range.starts_with(&format!("bytes {from}-")));
    let from = match status {
        StatusCode::PARTIAL_CONTENT if continues => from,
        // The server does not support ranges and sends the whole file.
        StatusCode::OK => 0,
        StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE => {
            file.set_len(0)?;
            return Err(Broken::Source(format!("the server answers with another range than {from}-")));
        }
        _ if status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS => {
            return Err(Broken::Source(format!("the server answers {status}")));
        }
        _ => return Err(Broken::Refused(format!("the server answers {status}"))),
    };
    file.set_len(from)?;
    file.seek(SeekFrom::Start(from))?;
    let mut body = answer.body_mut().with_config().limit(u64::MAX).reader();
    take(&mut body, file, from, item, progress)
}
