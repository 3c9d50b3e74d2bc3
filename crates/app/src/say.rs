//! Printing that never fails: a closed pipe or a full disk on the other end is no reason to lose a result. What files are
//! called and what they hold reaches the terminal as text, never as a command to it.

use std::io::Write;

/// A line on stdout.
pub fn out(line: &str) {
    let _ = writeln!(std::io::stdout(), "{}", printable(line));
}

/// A line on stderr.
pub fn err(line: &str) {
    let _ = writeln!(std::io::stderr(), "{}", printable(line));
}

/// Bytes of our own on stdout, as they are.
pub fn raw(bytes: &[u8]) {
    let _ = std::io::stdout().write_all(bytes);
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
