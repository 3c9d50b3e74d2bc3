//! `snapsnap fetch-weights`: downloads published weights and checks their SHA-256.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use clap::Args;
use snapsnap_base::{FileError, file};
use snapsnap_eval::lpips;

use crate::failure::{Failure, bail};
use crate::output::make_folder;
use crate::say;
use crate::weights::sha256;

/// Attempts in a row without new bytes after which the download fails.
const ATTEMPTS: u32 = 4;
/// Exit codes of curl: the server does not send parts of files; the file is longer than the published one.
const NO_RANGES: i32 = 33;
const TOO_LONG: i32 = 63;
/// An answer of the server that says no.
const REFUSED: i32 = 22;

#[derive(Args)]
pub struct Arguments {
    /// Names to fetch: dust3r, the initial weights of the paper's training, for `import-weights`; alexnet and lpips, the
    /// network and the learned layers of LPIPS [default: all].
    #[arg(value_parser = ITEMS.map(|item| item.name))]
    what: Vec<String>,
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

/// A published file.
struct Item {
    name: &'static str,
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
        name: "dust3r",
        file: "DUSt3R_ViTLarge_BaseDecoder_512_dpt.safetensors",
        url: "https://huggingface.co/naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt/resolve/\
              61c57447d7b0adc8a1a30b2b0adec7a8935aa2a3/model.safetensors",
        bytes: 2_284_790_056,
        sha256: "7c300a89534113436bde52732d3151212bcbd90f0aa3c8d1496f86d84bfe4b42",
        licence: "CC BY-NC-SA 4.0 (no commercial use), and the terms of the data that it was trained on",
    },
    Item {
        name: "alexnet",
        file: lpips::PUBLISHED[0],
        url: "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
        bytes: 244_408_911,
        sha256: "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
        licence: "BSD-3-Clause (torchvision); trained on ImageNet",
    },
    Item {
        name: "lpips",
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
        .filter(|item| arguments.what.is_empty() || arguments.what.iter().any(|name| name == item.name))
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
        let is_there = path.symlink_metadata().is_ok();
        match is_address(origin) {
            _ if is_there => check_existing(item, &path),
            true => download(item, origin, &path),
            false => copy(item, Path::new(origin), &path),
        }?;
        let outcome = if is_there { "is there" } else { "fetched" };
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
    let source = file::open(&from).map_err(FileError::read(&from))?;
    let written = file::write_whole(path, |out| {
        // One byte too many shows that the file is another.
        io::copy(&mut source.take(item.bytes + 1), out)?;
        out.flush()?;
        check_sum(item, &from.display().to_string(), out.get_mut())
    });
    written.map_err(|e| broken(path, e))
}

/// Downloads a file into `FILE.part`, which is renamed once its sum is right.
fn download(item: &Item, address: &str, path: &Path) -> Result<(), Failure> {
    let part = path.with_file_name(format!("{}.part", item.file));
    // A file of another kind with that name is left alone.
    if part.symlink_metadata().is_ok_and(|there| !there.is_file()) {
        let message = "is no unfinished download, but a link or a special file: move it away";
        return Err(Failure::file(&part, message));
    }
    let file = File::options().create(true).truncate(false).read(true).write(true).open(&part);
    let mut file = file.map_err(FileError::write(&part))?;
    if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) {
        return Err(Failure::file(&part, "is being fetched by another process"));
    }
    let filled = fill(&mut file, &part, item, address);
    // A later run continues from what has arrived.
    if filled.is_err() && file.metadata().is_ok_and(|there| there.len() == 0) {
        let _ = fs::remove_file(&part);
    }
    filled?;
    check_sum(item, address, &mut file).map_err(|e| {
        // A later run must not continue from wrong bytes.
        let _ = fs::remove_file(&part);
        broken(&part, e)
    })?;
    Ok(file::rename(&part, path).map_err(FileError::write(path))?)
}

/// Why a file was not written.
fn broken(path: &Path, e: io::Error) -> Failure {
    match e.kind() {
        ErrorKind::InvalidData => Failure::Input(e.to_string()),
        _ => FileError::write(path)(e).into(),
    }
}

/// Checks the size and the sum of a written file. The wrong content is [`ErrorKind::InvalidData`].
fn check_sum(item: &Item, origin: &str, file: &mut File) -> io::Result<()> {
    file.rewind()?;
    let (found, length) = (sha256(file)?, file.metadata()?.len());
    if found == item.sha256 && length == item.bytes {
        return Ok(());
    }
    let message = format!(
        "{origin}: the content is not that of {}: {length} bytes with SHA-256 {found}; nothing was kept",
        item.file
    );
    Err(io::Error::new(ErrorKind::InvalidData, message))
}

/// Lets curl download the rest of an unfinished file, in several attempts if connections break.
fn fill(file: &mut File, part: &Path, item: &Item, address: &str) -> Result<(), Failure> {
    let length = |file: &File| file.metadata().map(|there| there.len()).map_err(FileError::write(part));
    if length(file)? > item.bytes {
        file.set_len(0).map_err(FileError::write(part))?;
    }
    // Progress is counted from the largest length so far. Servers that restart the download make none.
    let (mut fruitless, mut most) = (0, length(file)?);
    while length(file)? < item.bytes {
        let meter = if say::is_quiet() { "--no-progress-meter" } else { "--progress-bar" };
        let limit = item.bytes.to_string();
        let mut curl = Command::new("curl");
        curl.args(["--fail", "--location", "--show-error", meter, "--connect-timeout", "60"]);
        curl.args(["--speed-limit", "1", "--speed-time", "60", "--max-filesize", &limit]);
        curl.args(["--continue-at", "-", "--output"]).arg(part).args(["--", address]);
        let ended = curl.stdin(Stdio::null()).stdout(Stdio::null()).status().map_err(|e| {
            let advice = format!("fetch {address} by other means, and give its folder with --from");
            Failure::Internal(format!("cannot run curl: {e}; install curl, or {advice}"))
        })?;
        let after = length(file)?;
        if ended.code() == Some(NO_RANGES) || ended.code() == Some(TOO_LONG) {
            file.set_len(0).map_err(FileError::write(part))?;
        }
        if ended.code() == Some(TOO_LONG) {
            let message = format!("the content is not that of {}: it is longer; nothing was kept", item.file);
            return Err(Failure::Input(format!("{address}: {message}")));
        }
        fruitless = if after > most { 0 } else { fruitless + 1 };
        most = most.max(after);
        if after < item.bytes && (fruitless == ATTEMPTS || ended.code() == Some(REFUSED)) {
            let kept = format!("{after} of {} bytes are kept; the next run continues from there", item.bytes);
            return Err(Failure::Internal(format!("{address}: the download ended early; {kept}")));
        }
        std::thread::sleep(Duration::from_millis(if fruitless > 0 { 200 << fruitless } else { 0 }));
    }
    Ok(())
}
