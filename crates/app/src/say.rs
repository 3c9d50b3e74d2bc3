//! Printing that never fails: a closed pipe or a full disk on the other end is no reason to lose a result.

use std::io::Write;

/// A line on stdout.
pub fn out(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// A line on stderr.
pub fn err(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}
