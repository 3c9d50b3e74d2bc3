//! Damaged files of every format that the program reads. Each must be read whole or refused, in bounded time and memory.
//!
//! A case is a sound sample of a [`formats::Format`] with random changes, and the command that a user would run on it, in
//! a process of its own. `SNAPSNAP_FUZZ_ONLY`, `_MINUTES` and `_FROM` are the options of `cargo xtask fuzz`.
#![cfg(target_os = "linux")]

mod case;
mod change;
mod checks;
mod envelope;
mod formats;
mod run;
mod samples;

use std::env;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use proptest::test_runner::{Config, RngAlgorithm, TestCaseError, TestError, TestRng, TestRunner};
use rayon::prelude::*;

use case::Sample;

/// Longest search for a smaller case that fails as well, milliseconds.
const SHRINKING: u32 = 120_000;

#[test]
fn damaged_files_are_read_whole_or_refused() {
    let variable = |name: &str| env::var(format!("SNAPSNAP_FUZZ_{name}")).ok();
    let only = variable("ONLY").unwrap_or_default();
    let first: u64 = variable("FROM").map_or(0, |seed| seed.parse().expect("a seed"));
    let minutes: f64 = variable("MINUTES").map_or(0.0, |minutes| minutes.parse().expect("minutes"));
    let end = Instant::now() + Duration::from_secs_f64(60.0 * minutes);
    let mut formats = formats::all();
    formats.retain(|format| format.name.starts_with(&only));
    assert!(!formats.is_empty(), "no format's name begins with `{only}`");

    let root = tempfile::Builder::new().prefix("snapsnap-fuzz-").tempdir().expect("a temporary folder");
    let samples = formats.into_par_iter().with_max_len(1);
    let samples: Vec<Sample> = samples.map(|format| Sample::new(format, root.path())).collect();
    let mut failures = Vec::new();
    for seed in first.. {
        let samples = samples.par_iter().with_max_len(1);
        failures.par_extend(samples.filter_map(|sample| failure(sample, seed, root.path())));
        if Instant::now() > end {
            break;
        }
    }
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

/// Runs the format's cases of a seed. A failing case is made smaller, its files are kept, and it is described.
fn failure(sample: &Sample, seed: u64, root: &Path) -> Option<String> {
    let name = sample.format.name;
    let config = Config {
        cases: sample.format.cases,
        failure_persistence: None,
        max_shrink_time: SHRINKING,
        max_shrink_iters: 200,
        ..Config::default()
    };
    let mut bytes = format!("{seed} {name}").into_bytes();
    bytes.resize(32, 0);
    let random = TestRng::from_seed(RngAlgorithm::ChaCha, &bytes);
    let result = TestRunner::new_with_rng(config, random).run(&case::cases(), |case| {
        let place = tempfile::tempdir_in(root).expect("a temporary folder");
        let problems = sample.run(Some(&case), place.path()).problems;
        if problems.is_empty() { Ok(()) } else { Err(TestCaseError::fail(problems.join("; "))) }
    });
    let Err(TestError::Fail(reason, case)) = result else {
        return result.err().map(|e| e.to_string());
    };
    let place = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz-{name}-{seed}"));
    // Of a run before.
    let _ = fs::remove_dir_all(&place);
    sample.run(Some(&case), &place);
    let command = format!("cargo xtask fuzz --only {name} --from {seed}");
    let (file, place) = (sample.target(&case).display(), place.display());
    let failure = format!("{name}: {reason}\n  {command}\n  {file}: {case:?}\n  files: {place}");
    println!("{failure}");
    Some(failure)
}
