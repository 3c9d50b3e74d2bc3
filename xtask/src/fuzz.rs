//! `cargo xtask fuzz`: the suite's fuzzing, for longer or of less.

use super::{cargo, succeeds};

const USAGE: &str = "usage: cargo xtask fuzz [--minutes N] [--only FORMAT] [--from SEED]

  --minutes N    seed after seed of all formats for N minutes [default: one seed, as the suite does]
  --only FORMAT  only formats whose names begin so; names are in tests/tests/fuzz/formats.rs
  --from SEED    the first seed [default: 0]";

/// Runs the test; returns whether nothing failed.
pub fn run(arguments: &[String]) -> bool {
    let mut command = cargo(&["test", "--release", "--workspace", "--test", "fuzz", "--", "--nocapture"]);
    for pair in arguments.chunks(2) {
        let is_sound = match pair {
            [option, _] if option == "--only" => true,
            [option, value] if option == "--minutes" => value.parse().is_ok_and(|m: f64| m > 0.0 && m < 1e6),
            [option, value] if option == "--from" => value.parse::<u64>().is_ok(),
            _ => false,
        };
        if !is_sound {
            eprintln!("{USAGE}");
            return matches!(pair, [option] if option == "--help" || option == "-h");
        }
        command.env(format!("SNAPSNAP_FUZZ_{}", pair[0][2..].to_uppercase()), &pair[1]);
    }
    succeeds("fuzz", &mut command)
}
