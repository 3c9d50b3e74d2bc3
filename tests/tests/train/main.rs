//! `snapsnap train-stage1` and `train-stage2` as a user types them: their files, runs that are continued after a kill,
//! an interrupt or a full disk, and refusals.

mod options;
#[cfg(unix)]
mod ranks;
mod refusals;
mod resume;
mod runs;
mod samples;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use snapsnap_tests::{TRAINING, snapsnap, succeed, synthetic_people};

/// A data set of three training people and one held-out person, made once.
fn people() -> &'static Path {
    static PEOPLE: OnceLock<PathBuf> = OnceLock::new();
    PEOPLE.get_or_init(|| {
        let folder =
            PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("people-{}", std::process::id()));
        for (split, count) in [("train", 3), ("val", 1)] {
            succeed(&mut synthetic_people(&folder, split, count, 4));
        }
        folder
    })
}

/// A temporary folder with the config of the tests.
fn place() -> (tempfile::TempDir, PathBuf) {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let config = temporary.path().join("train.toml");
    fs::write(&config, TRAINING).expect("writes");
    (temporary, config)
}

fn train(stage: u32, config: &Path, run: &Path) -> Command {
    train_on(people(), stage, config, run)
}

/// A training on a data set.
fn train_on(data: &Path, stage: u32, config: &Path, run: &Path) -> Command {
    let mut command = snapsnap();
    command.arg(format!("train-stage{stage}")).arg("--config").arg(config);
    command.args(["--device", "cpu", "--data"]).arg(data).arg("-o").arg(run);
    command
}

/// Files that must not depend on the interruptions of a run.
fn results(run: &Path) -> Vec<Vec<u8>> {
    let names = ["last.safetensors", "best.safetensors", "state/state.safetensors"];
    names.map(|name| fs::read(run.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))).to_vec()
}

/// The values of a field over the lines of a log.
fn logged(run: &Path, name: &str) -> Vec<(u64, f64)> {
    let text = fs::read_to_string(run.join("log.jsonl")).expect("a log");
    let lines = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).expect("a line"));
    let value = |line: serde_json::Value| Some((line["step"].as_u64()?, line["values"][name].as_f64()?));
    lines.filter_map(value).collect()
}
