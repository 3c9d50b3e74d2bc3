//! Messages on stdout and stderr. Control characters in names and contents of files are escaped, since a terminal
//! would interpret them. Only [`lines`], [`json`] and [`result`] can fail.

use std::io::{ErrorKind, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use snapsnap_base::file;

use crate::failure::Failure;

static QUIET: AtomicBool = AtomicBool::new(false);

/// Sets --quiet, with which [`info`], [`note`] and progress print nothing.
pub fn set_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

/// Whether --quiet is given.
pub fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// A line on stdout unless --quiet is given.
pub fn info(line: &str) {
    if !is_quiet() {
        out(line);
    }
}

/// A line on stderr unless --quiet is given.
pub fn note(line: &str) {
    if !is_quiet() {
        err(line);
    }
}

/// [`out`], or [`err`] if the output file is a pipe or a device, so that messages do not mix with its data.
pub fn beside(output: &Path) -> fn(&str) {
    if file::is_special(output) { err } else { out }
}

/// A line on stdout.
pub fn out(line: &str) {
    let _ = writeln!(std::io::stdout(), "{}", printable(line));
}

/// A line on stderr.
pub fn err(line: &str) {
    let _ = writeln!(std::io::stderr(), "{}", printable(line));
}

/// Writes the result of a command, as lines, to stdout.
pub fn lines(text: &str) -> Result<(), Failure> {
    result(format!("{}\n", printable(text)).as_bytes())
}

/// Writes the result of a command, as JSON, to stdout. Only strings contain control characters.
pub fn json(text: &str) -> Result<(), Failure> {
    let escaped = |c: char| match c {
        c if is_hidden(c) && c != '\n' => format!("\\u{:04x}", u32::from(c)),
        c => c.to_string(),
    };
    result(text.chars().map(escaped).chain(["\n".into()]).collect::<String>().as_bytes())
}

/// Writes the result of a command, unchanged, to stdout.
pub fn result(text: &[u8]) -> Result<(), Failure> {
    let mut stdout = std::io::stdout();
    written(stdout.write_all(text).and_then(|()| stdout.flush()))
}

/// The outcome of writing to stdout. A full disk is an error, a closed pipe is not.
pub fn written(outcome: std::io::Result<()>) -> Result<(), Failure> {
    match outcome {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::Input(format!("stdout: cannot write: {e}")))
        }
        _ => Ok(()),
    }
}

/// Whether a character controls the terminal, or the direction of the text around it.
fn is_hidden(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// The text with escaped control characters, but for line breaks and tabs.
pub fn printable(text: &str) -> String {
    let shown = |c: char| match c {
        c if is_hidden(c) && c != '\n' && c != '\t' => c.escape_default().to_string(),
        c => c.to_string(),
    };
    text.chars().map(shown).collect()
}
