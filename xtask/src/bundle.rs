//! `cargo xtask bundle`: an archive that tests and measures the project on a machine without cargo.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::cargo;

/// The script that runs the programs of the archive.
const RUN: &str = include_str!("run.sh");
/// Files and folders that the programs read.
const DATA: [&str; 4] = ["configs", "tests/data", "README.md", "LICENSE"];

/// The archive.
const ARCHIVE: &str = "target/snapsnap-bundle.tar.xz";

/// Builds and packs. `features` are those of the program, comma-separated.
pub fn bundle(features: Option<&str>) -> Result<(), String> {
    let programs = [
        ("snapsnap", build(features, &["build", "--bin", "snapsnap"])?),
        ("numerical", build(features, &["test", "--no-run", "--test", "numerical"])?),
        ("splat", build(features, &["bench", "--no-run", "--bench", "splat"])?),
    ];
    // Not beside the archive: a folder of this name may be an unpacked bundle.
    let folder = Path::new("target/bundle/snapsnap-bundle").to_owned();
    if folder.exists() {
        fs::remove_dir_all(&folder).map_err(failed(&folder))?;
    }
    for (name, program) in programs {
        copy(&program, &folder.join("bin").join(name))?;
    }
    for path in DATA {
        copy(Path::new(path), &folder.join(path))?;
    }
    let script = folder.join("run.sh");
    let device = features.and_then(|features| features.split(',').next()).unwrap_or("wgpu");
    let text = RUN
        .replace("@DEVICE@", device)
        .replace("@FEATURES@", features.unwrap_or("none"))
        .replace("@COMMIT@", &commit());
    fs::write(&script, text).map_err(failed(&script))?;
    let archive = Path::new(ARCHIVE);
    pack(&folder, archive)?;
    let size = fs::metadata(archive).map_err(failed(archive))?.len();
    fs::remove_dir_all(&folder).map_err(failed(&folder))?;
    println!("{ARCHIVE}: {:.1} MB; unpack it anywhere and start `sh run.sh`", size as f64 / 1e6);
    Ok(())
}

/// Builds one program of the workspace and returns its path. Other features have a target folder of their own, so that
/// they do not replace the plain build.
fn build(features: Option<&str>, command: &[&str]) -> Result<PathBuf, String> {
    let mut build = cargo(&command[..1]);
    // `cargo bench` takes the release profile by itself.
    build.args((command[0] != "bench").then_some("--release"));
    build.args(["--workspace", "--message-format=json-render-diagnostics"]).args(&command[1..]);
    if let Some(features) = features {
        build.args(["--features", features]).args(["--target-dir", "target-gpu"]);
    }
    let output = build.stderr(Stdio::inherit()).output().map_err(|e| format!("cannot run cargo: {e}"))?;
    if !output.status.success() {
        return Err(format!("cargo {}: {}", command.join(" "), output.status));
    }
    let name = command.last().expect("a command names its target");
    let messages = String::from_utf8_lossy(&output.stdout);
    let message = |line: &str| -> Option<PathBuf> {
        let message: serde_json::Value = serde_json::from_str(line).ok()?;
        (message["target"]["name"] == *name).then(|| message["executable"].as_str().map(PathBuf::from))?
    };
    messages.lines().rev().find_map(message).ok_or_else(|| format!("cargo made no program `{name}`"))
}

fn failed(what: &Path) -> impl Fn(io::Error) -> String {
    move |e| format!("{}: {e}", what.display())
}

/// Copies a file, or a folder with its content.
fn copy(from: &Path, to: &Path) -> Result<(), String> {
    if !from.is_dir() {
        fs::create_dir_all(to.parent().unwrap_or(Path::new("."))).map_err(failed(to))?;
        return fs::copy(from, to).map(drop).map_err(failed(from));
    }
    for entry in fs::read_dir(from).map_err(failed(from))? {
        let name = entry.map_err(failed(from))?.file_name();
        copy(&from.join(&name), &to.join(&name))?;
    }
    Ok(())
}

/// Packs the folder. The ending of `output` selects the compression.
fn pack(folder: &Path, output: &Path) -> Result<(), String> {
    let parent = folder.parent().unwrap_or(Path::new("."));
    let name = folder.file_name().unwrap_or_default();
    let mut tar = Command::new("tar");
    // The programs share much code. A window that spans all of them stores it once.
    tar.env("XZ_OPT", "-6 --lzma2=preset=6,dict=256MiB -T1");
    let status = tar.arg("-caf").arg(output).arg("-C").arg(parent).arg(name).status();
    match status {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("tar: {status}; are tar and xz installed?")),
        Err(e) => Err(format!("cannot run tar: {e}")),
    }
}

/// The commit, marked as dirty if files differ from it.
fn commit() -> String {
    let git = Command::new("git").args(["describe", "--always", "--dirty"]).output();
    let text = git.ok().filter(|output| output.status.success()).map(|output| output.stdout);
    text.map_or_else(|| "unknown".into(), |text| String::from_utf8_lossy(&text).trim().to_owned())
}
