//! `cargo xtask fuzz`: runs the suite's fuzzing for longer, on less, or on one case.

use std::env;
use std::path::Path;

use super::{cargo, succeeds};

const USAGE: &str = "usage: cargo xtask fuzz [--minutes N] [--only FORMAT] [--from SEED] [--report FILE.md] | --case FORMAT:SEED

Damaged files of every format that the program reads: each must be read whole or refused, in bounded time and memory.

  --minutes N         as many cases as fit into N minutes, all formats in turn [default: the suite's short run]
  --only FORMAT       only formats whose names begin so; names are in tests/src/fuzz/formats
  --from SEED         the first seed of a run with --minutes [default: 0]
  --report FILE.md    write a report of the cases and failures
  --case FORMAT:SEED  one case again; its files are kept, and their folder is printed";

/// Options and the environment variables that pass them to the test.
const OPTIONS: [(&str, &str); 5] = [
    ("--minutes", "SNAPSNAP_FUZZ_MINUTES"),
    ("--only", "SNAPSNAP_FUZZ_ONLY"),
    ("--from", "SNAPSNAP_FUZZ_FIRST"),
    ("--report", "SNAPSNAP_FUZZ_REPORT"),
    ("--case", "SNAPSNAP_FUZZ_CASE"),
];

/// Runs the test; returns whether nothing failed.
pub fn run(arguments: &[String]) -> bool {
    if arguments.iter().any(|argument| argument == "--help" || argument == "-h") {
        println!("{USAGE}");
        return true;
    }
    let mut command = cargo(&["test", "--release", "--workspace", "--test", "fuzz", "--", "--nocapture"]);
    // A failure is identified by its case. The test's backtrace adds nothing.
    command.env("RUST_BACKTRACE", "0");
    command.env("SNAPSNAP_FUZZ_COMMAND", format!("cargo xtask fuzz {}", arguments.join(" ")).trim_end());
    for pair in arguments.chunks(2) {
        let [option, value] = pair else { return refuse(&format!("{} needs a value", pair[0])) };
        let Some((_, variable)) = OPTIONS.iter().find(|(name, _)| name == option) else {
            return refuse(&format!("no option {option}"));
        };
        let fits = match option.as_str() {
            "--minutes" => value.parse().is_ok_and(|minutes: f64| minutes > 0.0 && minutes < 1e6),
            "--from" => value.parse::<u64>().is_ok(),
            "--case" => value.contains(':'),
            _ => true,
        };
        if !fits {
            return refuse(&format!("{option} {value}: no such value"));
        }
        // The test runs in a folder of its own.
        let folder = env::current_dir().unwrap_or_default();
        match option.as_str() {
            "--report" => command.env(variable, folder.join(Path::new(value))),
            _ => command.env(variable, value),
        };
    }
    succeeds("fuzz", &mut command)
}

fn refuse(problem: &str) -> bool {
    eprintln!("error: {problem}\n\n{USAGE}");
    false
}
