//! Damaged files of every format that the program reads: a short run of fixed cases in the suite, or the run of
//! `cargo xtask fuzz`.
#![cfg(target_os = "linux")]

use std::env;
use std::fs;
use std::path::Path;
use std::time::Duration;

use snapsnap_tests::fuzz::campaign::Campaign;

#[test]
fn damaged_files_are_read_whole_or_refused() {
    let variable = |name: &str| env::var(format!("SNAPSNAP_FUZZ_{name}")).ok();
    let only = variable("ONLY");
    if let Some(name) = variable("CASE") {
        return repeat(&name);
    }
    let campaign = Campaign::new(only.as_deref());
    let minutes = variable("MINUTES").map(|minutes| minutes.parse::<f64>().expect("a number of minutes"));
    let first = variable("FIRST").map_or(0, |seed| seed.parse().expect("a seed"));
    let tally = match minutes {
        Some(minutes) => campaign.long(Duration::from_secs_f64(60.0 * minutes), first),
        None => campaign.short(),
    };
    println!("{}", tally.progress());
    if let Some(path) = variable("REPORT") {
        let command = variable("COMMAND").unwrap_or_else(|| "cargo xtask fuzz".into());
        fs::write(&path, tally.markdown(&command)).unwrap_or_else(|e| panic!("{path}: {e}"));
    }
    let failures = tally.failures();
    assert!(failures.is_empty(), "{} different failures:\n{}", failures.len(), failures.join("\n"));
}

/// One case, whose files are kept.
fn repeat(name: &str) {
    let format = name.split(':').next().expect("never empty");
    let campaign = Campaign::new(Some(format));
    let case = campaign.case(name);
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fuzz");
    let place = target.join(name.replace(':', "-"));
    // Left by an earlier run.
    let _ = fs::remove_dir_all(&place);
    fs::create_dir_all(&place).expect("a folder");
    let outcome = campaign.keep(case, &place);
    println!("{case} in {}", place.display());
    outcome.changes.iter().for_each(|change| println!("  {}", change.escape_debug()));
    println!("  snapsnap {}", case.format.command);
    let ran = &outcome.ran;
    println!("  {:?} after {:.2} s, {} MB", ran.ended, ran.time.as_secs_f64(), ran.memory >> 20);
    print!("{}", String::from_utf8_lossy(&ran.printed).replace(|c: char| c.is_control() && c != '\n', "␛"));
    assert!(outcome.problems.is_empty(), "{case}:\n{}", outcome.problems.join("\n"));
}
