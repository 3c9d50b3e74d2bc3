//! The values of any PLY file after its header, row by row: text or numbers of either byte order.

use std::io::{self, BufRead, ErrorKind, Read};

use snapsnap_base::quoted;

use super::Problem;
use super::header::{Element, Format, Property, Scalar};

/// Longest line of a body in text.
const MAX_LINE: u64 = 1 << 20;

/// A value of the body.
#[derive(Clone, Copy, Debug)]
pub enum Value<'a> {
    /// A word of a text.
    Text(&'a str),
    /// Bytes in little-endian order. Bytes beyond the type's size mean nothing.
    Binary(Scalar, [u8; 8]),
}

impl Value<'_> {
    fn binary(mut bytes: [u8; 8], kind: Scalar, big: bool) -> Self {
        if big {
            bytes[..kind.size()].reverse();
        }
        Self::Binary(kind, bytes)
    }

    /// The value as a number; `None` for text that is no number.
    pub fn number(self) -> Option<f32> {
        match self {
            Self::Text(word) => word.parse().ok(),
            Self::Binary(kind, bytes) => Some(kind.read(bytes) as f32),
        }
    }

    /// As [`Self::number`], with all digits of integers.
    pub(super) fn exact(self) -> Option<f64> {
        match self {
            Self::Text(word) => word.parse().ok(),
            Self::Binary(kind, bytes) => Some(kind.read(bytes)),
        }
    }

    /// The value as a length or an index. `None` for floats and negative numbers.
    pub fn count(self) -> Option<usize> {
        match self {
            Self::Text(word) => word.parse().ok(),
            Self::Binary(Scalar::F32 | Scalar::F64, _) => None,
            Self::Binary(kind, bytes) => Some(kind.read(bytes)).filter(|n| *n >= 0.0).map(|n| n as usize),
        }
    }
}

/// The values after the header.
#[derive(Debug)]
pub struct Body<R> {
    input: R,
    format: Format,
    /// The present row, if it is a text or has numbers only.
    line: Vec<u8>,
}

impl<R: BufRead> Body<R> {
    /// The body at the start of `input`.
    pub fn new(input: R, format: Format) -> Self {
        Self { input, format, line: Vec::new() }
    }

    /// Reads the next row, which is number `row` of its element. `each` receives the index of a property and one of
    /// its values. It returns `None` for a value that is no suitable number.
    ///
    /// # Errors
    /// A missing or wrong value, a list of more than `longest` values, a line of a text with further values.
    pub fn row(
        &mut self,
        element: &Element,
        row: usize,
        longest: usize,
        mut each: impl FnMut(usize, Value<'_>) -> Option<()>,
    ) -> Result<(), Problem> {
        let wrong = |property: &Property, problem: &str| {
            let (name, property) = (quoted(&element.name), quoted(&property.name));
            format!("{name} {row} of {}: `{property}` {problem}", element.count)
        };
        let missing = |property: &Property| wrong(property, "is missing; the file may be cut off");
        let no_number = |property: &Property, value: Value<'_>| match value {
            Value::Text(word) => wrong(property, &format!("is `{}`, no suitable number", quoted(word))),
            Value::Binary(..) => wrong(property, "is no suitable number"),
        };
        let Self { input, format, line } = self;
        line.clear();
        let big = *format == Format::BigEndian;
        if *format != Format::Ascii && element.properties.iter().all(|p| p.list.is_none()) {
            // Rows of a fixed size are read as a whole, which takes half the time.
            input.take(element.properties.iter().map(|p| p.kind.size() as u64).sum()).read_to_end(line)?;
            let (mut at, end) = (0, line.len());
            line.extend([0; 8]);
            for (column, property) in element.properties.iter().enumerate() {
                let bytes = line[at..].first_chunk().filter(|_| at + property.kind.size() <= end);
                let value = Value::binary(*bytes.ok_or_else(|| missing(property))?, property.kind, big);
                each(column, value).ok_or_else(|| no_number(property, value))?;
                at += property.kind.size();
            }
            return Ok(());
        }
        if *format == Format::Ascii {
            next_line(input, line)?;
        }
        let text = std::str::from_utf8(line)
            .map_err(|_| "the body is not text, though the format is ascii".to_owned())?;
        let mut words = text.split_ascii_whitespace();
        let mut next = |kind: Scalar| match format {
            Format::Ascii => Ok(words.next().map(Value::Text)),
            _ => next_number(input, kind, big),
        };
        for (column, property) in element.properties.iter().enumerate() {
            let mut length = 1;
            if let Some(kind) = property.list {
                let value = next(kind)?.ok_or_else(|| missing(property))?;
                length = value.count().ok_or_else(|| no_number(property, value))?;
            }
            if length > longest {
                return Err(wrong(property, &format!("has {length} entries")).into());
            }
            for _ in 0..length {
                let value = next(property.kind)?.ok_or_else(|| missing(property))?;
                each(column, value).ok_or_else(|| no_number(property, value))?;
            }
        }
        match (words.next(), element.properties.last()) {
            (Some(_), Some(last)) => Err(wrong(last, "is not the last value of its line").into()),
            _ => Ok(()),
        }
    }

    /// Skips the rows of an element.
    ///
    /// # Errors
    /// As [`Self::row`].
    pub fn skip(&mut self, element: &Element) -> Result<(), Problem> {
        // Elements without properties have no bytes in the file.
        let rows = if element.properties.is_empty() { 0 } else { element.count };
        (0..rows).try_for_each(|row| self.row(element, row, usize::MAX, |_, _| Some(())))
    }
}

/// The next line that is not blank; an empty one at the end of the file.
fn next_line(input: &mut impl BufRead, line: &mut Vec<u8>) -> Result<(), Problem> {
    loop {
        line.clear();
        let read = input.take(MAX_LINE).read_until(b'\n', line)?;
        if line.len() as u64 == MAX_LINE && !line.ends_with(b"\n") {
            return Err(format!("a line of the body is longer than {MAX_LINE} bytes").into());
        }
        if read == 0 || !line.trim_ascii().is_empty() {
            return Ok(());
        }
    }
}

/// The next value of a binary body; `None` at the end of the file.
fn next_number(input: &mut impl BufRead, kind: Scalar, big: bool) -> io::Result<Option<Value<'static>>> {
    let mut bytes = [0; 8];
    match input.read_exact(&mut bytes[..kind.size()]) {
        Err(e) if e.kind() == ErrorKind::UnexpectedEof => Ok(None),
        read => read.map(|()| Some(Value::binary(bytes, kind, big))),
    }
}
