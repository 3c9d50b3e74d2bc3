//! `snapsnap evaluate`, `bench`, `compare` and `stability`: reports, and missing or damaged inputs.

mod bench;
mod compare;
mod meshes;
mod people;
mod stability;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;
use snapsnap_tests::{TRAINING, root, snapsnap, succeed, synthetic_people};

/// A data set of two test people and two training people, with eight views of 64². It is made once.
fn people() -> &'static Path {
    static PEOPLE: OnceLock<PathBuf> = OnceLock::new();
    PEOPLE.get_or_init(|| {
        let folder =
            PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("tested-{}", std::process::id()));
        for split in ["test", "train"] {
            succeed(synthetic_people(&folder, split, 2, 8).arg("--save-scans"));
        }
        folder
    })
}

/// A copy of the data set in a folder.
fn copied(to: &Path) -> PathBuf {
    let folder = to.join("people");
    let status = Command::new("cp").arg("-r").arg(people()).arg(&folder).status().expect("cp");
    assert!(status.success());
    folder
}

/// Random weights of small networks.
fn weights(seed: u32) -> PathBuf {
    static LOCK: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _lock = LOCK.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let file = folder.join(format!("tested-{}-{seed}.safetensors", std::process::id()));
    if !file.exists() {
        let config = folder.join(format!("tested-{}.toml", std::process::id()));
        let networks = TRAINING.split("[samples]").next().expect("sections");
        fs::write(&config, networks.replace("conf_threshold", "")).expect("writes");
        let mut command = snapsnap();
        command.args(["init-weights", "--seed", &seed.to_string(), "--config"]).arg(&config);
        succeed(command.args(["--set", "network.conf_threshold=0.4", "-o"]).arg(&file));
    }
    file
}

/// An evaluation on data sets with the repository's config.
fn evaluation(data: &[&Path], report: &Path) -> Command {
    let mut command = snapsnap();
    command.args(["--quiet", "evaluate", "--config"]).arg(root().join("configs/eval.toml"));
    command.arg("--data").args(data).arg("-o").arg(report);
    command
}

/// An evaluation on the CPU with random weights, unless `arguments` say otherwise.
fn evaluate(data: &Path, report: &Path, arguments: &[&str]) -> Command {
    let mut command = evaluation(&[data], report);
    command.args(arguments);
    if !arguments.contains(&"--weights") {
        command.arg("--weights").arg(weights(1));
    }
    if !arguments.contains(&"--device") {
        command.args(["--device", "cpu"]);
    }
    command
}

fn json(report: &Path) -> Value {
    let text = fs::read_to_string(report.join("report.json")).expect("a report");
    serde_json::from_str(&text).expect("JSON")
}
