//! Printing that never fails: a closed pipe or a full disk on the other end is no reason to lose a result. What files are
//! called and what they hold reaches the terminal as text, never as a command to it.

use std::io::{ErrorKind, Write};

use crate::failure::Failure;

/// A line on stdout.
pub fn out(line: &str) {
    let _ = writeln!(std::io::stdout(), "{}", printable(line));
}

/// A line on stderr.
pub fn err(line: &str) {
    let _ = writeln!(std::io::stderr(), "{}", printable(line));
}

/// Lines on stdout that are all of the command's result.
pub fn lines(text: &str) -> Result<(), Failure> {
    result(format!("{}\n", printable(text)).as_bytes())
}

/// The same as JSON, in which only strings have control characters.
pub fn json(text: &str) -> Result<(), Failure> {
    let escaped = |c: char| match c {
        c if c.is_control() && c != '\n' => format!("\\u{:04x}", u32::from(c)),
        c => c.to_string(),
    };
    result(text.chars().map(escaped).chain(["\n".into()]).collect::<String>().as_bytes())
}

/// Writes the whole result of a command to stdout, unchanged. A full disk is an error; a reader that closes the pipe is none.
pub fn result(text: &[u8]) -> Result<(), Failure> {
    let mut stdout = std::io::stdout();
    match stdout.write_all(text).and_then(|()| stdout.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::Input(format!("stdout: cannot write: {e}")))
        }
        _ => Ok(()),
    }
}

/// The text with control characters written out; line breaks and tabs stay.
pub fn printable(text: &str) -> String {
    let is_plain = |c: char| !c.is_control() || c == '\n' || c == '\t';
    text.chars()
        .flat_map(|c| {
            let plain = is_plain(c).then_some(c);
            plain.into_iter().chain((!is_plain(c)).then(|| c.escape_default()).into_iter().flatten())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_written_out() {
        assert_eq!(printable("\x1b[31mrot\r\u{9b}\n\tünd"), "\\u{1b}[31mrot\\r\\u{9b}\n\tünd");
    }
}
