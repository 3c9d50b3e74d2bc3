//! Damaged files of every format that the program reads. Each must be read whole or refused, in bounded time and memory.
//!
//! A case is a sound sample of a [`Format`] with random changes, and the command that a user would run on it, in a process
//! of its own. `SNAPSNAP_FUZZ_ONLY`, `_MINUTES` and `_FROM` are the options of `cargo xtask fuzz`.
#![cfg(target_os = "linux")]

mod case;
mod change;
mod checks;
mod envelope;
mod formats;
mod run;
mod samples;

use std::env;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

use formats::Format;
use proptest::test_runner::{Config, RngAlgorithm, TestCaseError, TestError, TestRng, TestRunner};
use tempfile::TempDir;

use case::Sample;

/// Longest search for a smaller case that fails as well, milliseconds.
const SHRINKING: u32 = 120_000;

#[test]
fn damaged_files_are_read_whole_or_refused() {
    let variable = |name: &str| env::var(format!("SNAPSNAP_FUZZ_{name}")).ok();
    let only = variable("ONLY").unwrap_or_default();
    let first: u64 = variable("FROM").map_or(0, |seed| seed.parse().expect("a seed"));
    let minutes = variable("MINUTES").map(|minutes| minutes.parse::<f64>().expect("a number of minutes"));
    let end = minutes.map(|minutes| Instant::now() + Duration::from_secs_f64(60.0 * minutes));
    let formats: Vec<(Format, OnceLock<Sample>)> = formats::all()
        .into_iter()
        .filter(|format| format.name.starts_with(&only))
        .map(|format| (format, OnceLock::new()))
        .collect();
    assert!(!formats.is_empty(), "no format's name begins with `{only}`");

    let root = tempfile::Builder::new().prefix("snapsnap-fuzz-").tempdir().expect("a temporary folder");
    let (next, cases) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let failures = Mutex::new(Vec::new());
    let work = || {
        loop {
            let job = next.fetch_add(1, Ordering::Relaxed);
            let (round, (format, sample)) = (job / formats.len(), &formats[job % formats.len()]);
            if round > 0 && end.is_none_or(|end| Instant::now() > end) {
                break;
            }
            let sample = sample.get_or_init(|| Sample::make(format, &root.path().join(format.name)));
            if let Err(failure) = several(format, sample, first + round as u64, &root, &cases) {
                println!("{failure}");
                failures.lock().expect("no panic elsewhere").push(failure);
            }
        }
    };
    let cores = std::thread::available_parallelism().map_or(2, usize::from);
    std::thread::scope(|scope| (0..cores).for_each(|_| drop(scope.spawn(work))));
    let failures = failures.into_inner().expect("no panic elsewhere");
    println!("{} cases, {} failures", cases.into_inner(), failures.len());
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

/// Runs as many cases as the format's share is. A failing case is made smaller and its files are kept.
fn several(
    format: &Format,
    sample: &Sample,
    seed: u64,
    root: &TempDir,
    cases: &AtomicUsize,
) -> Result<(), String> {
    let config = Config {
        cases: format.share,
        failure_persistence: None,
        max_shrink_time: SHRINKING,
        max_shrink_iters: 200,
        ..Config::default()
    };
    let mut bytes = [0; 32];
    bytes[..8].copy_from_slice(&seed.to_le_bytes());
    let name = &format.name.as_bytes()[..format.name.len().min(24)];
    bytes[8..8 + name.len()].copy_from_slice(name);
    let random = TestRng::from_seed(RngAlgorithm::ChaCha, &bytes);
    let result = TestRunner::new_with_rng(config, random).run(&case::cases(), |case| {
        cases.fetch_add(1, Ordering::Relaxed);
        let place = tempfile::tempdir_in(root).expect("a temporary folder");
        let problems = sample.run(format, Some(&case), place.path()).problems;
        if problems.is_empty() { Ok(()) } else { Err(TestCaseError::fail(problems.join("; "))) }
    });
    let Err(TestError::Fail(reason, case)) = result else {
        return result.map_err(|e| e.to_string());
    };
    let place =
        std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz-{}-{seed}", format.name));
    // Of a run before.
    let _ = std::fs::remove_dir_all(&place);
    sample.run(format, Some(&case), &place);
    let command = format!("cargo xtask fuzz --only {} --from {seed}", format.name);
    let file = sample.target(format, &case).display();
    Err(format!("{}: {reason}\n  {command}\n  {file}: {case:?}\n  files: {}", format.name, place.display()))
}
