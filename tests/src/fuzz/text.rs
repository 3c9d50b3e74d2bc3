//! Damage to what is written in text: numbers, lines, words, keys and brackets, which changed byte by byte would hardly
//! ever become other numbers, lines, words and keys.

use std::ops::Range;

use rand::Rng;

use super::Random;
use super::bytes::Damage;

/// What numbers and words become.
const EXTREMES: [&str; 30] = [
    "nan",
    "inf",
    "-inf",
    "1e38",
    "1e39",
    "-1e300",
    "1e999",
    "1e-45",
    "0",
    "-0",
    "1",
    "-1",
    "2",
    "0.5",
    "255",
    "256",
    "65535",
    "65536",
    "2147483647",
    "2147483648",
    "-2147483648",
    "4294967295",
    "9223372036854775807",
    "-9223372036854775808",
    "18446744073709551615",
    "99999999999999999999",
    "",
    "null",
    "true",
    "[]",
];
/// What a terminal would obey, and what no text should hold.
const ESCAPES: [&str; 7] =
    ["\u{1b}[31m", "\u{1b}]0;title\u{7}", "\u{7}", "\r", "\0", "\u{9b}31m", "\u{202e}\u{7f}"];
/// How deep brackets are nested: deeper than any stack that a parser could recurse on.
const DEPTH: usize = 200_000;
/// How often something is repeated that others refer to: small files that unfold to large ones.
const MANY: usize = 20_000;
/// Most bytes that repetition adds.
const REPEATED: usize = 4 << 20;
/// Length of a line without an end.
const LINE: usize = 3_000_000;

/// Kinds of damage to any text.
const PLAIN: &[Damage] =
    &[number, number, number, number, lines, lines, words, escape, escape, nest, endless, many_lines];
/// Kinds of damage to a text that has keys.
const KEYED: &[Damage] = &[drop_key, drop_key, duplicate_key, rename_key, many_items];

/// A kind of damage that fits the text.
pub fn damage(bytes: &[u8], random: &mut Random) -> Damage {
    let kinds = if random.random_bool(0.4) && !keys(bytes).is_empty() { KEYED } else { PLAIN };
    kinds[random.random_range(0..kinds.len())]
}

/// Whether the bytes read as text for the most part.
pub fn is_text(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(1024)];
    let odd = start.iter().filter(|b| **b < b' ' && !b.is_ascii_whitespace()).count();
    !start.is_empty() && 20 * odd < start.len() && std::str::from_utf8(&start[..start.len().min(64)]).is_ok()
}

fn pick<T: Clone>(from: &[T], random: &mut Random) -> Option<T> {
    (!from.is_empty()).then(|| from[random.random_range(0..from.len())].clone())
}

/// Ranges of bytes for which `inside` holds without a gap.
fn runs(bytes: &[u8], inside: impl Fn(u8) -> bool) -> Vec<Range<usize>> {
    let mut found = Vec::new();
    let mut start = None;
    for at in 0..=bytes.len() {
        let is_inside = bytes.get(at).is_some_and(|b| inside(*b));
        match start {
            None if is_inside => start = Some(at),
            Some(from) if !is_inside => {
                found.push(from..at);
                start = None;
            }
            _ => {}
        }
    }
    found
}

fn number(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let mut numbers = runs(bytes, |b| b.is_ascii_digit() || matches!(b, b'-' | b'+' | b'.'));
    numbers.retain(|run| bytes[run.clone()].iter().any(u8::is_ascii_digit));
    let (Some(run), Some(value)) = (pick(&numbers, random), pick(&EXTREMES, random)) else {
        return "no number to change".into();
    };
    let before = String::from_utf8_lossy(&bytes[run.clone()]).into_owned();
    let at = run.start;
    bytes.splice(run, value.bytes());
    format!("`{before}` at {at} became `{value}`")
}

fn lines(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let mut lines: Vec<Vec<u8>> = bytes.split_inclusive(|b| *b == b'\n').map(<[u8]>::to_vec).collect();
    if lines.is_empty() {
        return "no line to change".into();
    }
    let (a, b) = (random.random_range(0..lines.len()), random.random_range(0..lines.len()));
    let done = match random.random_range(0..3) {
        0 => {
            lines.remove(a);
            format!("line {} removed", a + 1)
        }
        1 => {
            let copy = lines[a].clone();
            lines.insert(b, copy);
            format!("line {} again before line {}", a + 1, b + 1)
        }
        _ => {
            lines.swap(a, b);
            format!("lines {} and {} swapped", a + 1, b + 1)
        }
    };
    *bytes = lines.concat();
    done
}

fn words(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let words = runs(bytes, |b| !b.is_ascii_whitespace());
    let (Some(run), Some(other)) = (pick(&words, random), pick(&words, random)) else {
        return "no word to change".into();
    };
    let at = run.start;
    let new = match random.random_range(0..3) {
        0 => Vec::new(),
        1 => bytes[other].to_vec(),
        _ => pick(&EXTREMES, random).unwrap_or_default().into(),
    };
    let done = format!("the word at {at} became `{}`", String::from_utf8_lossy(&new));
    bytes.splice(run, new);
    done
}

fn escape(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let Some(escape) = pick(&ESCAPES, random) else { return String::new() };
    // In the midst of a word: a name, a number, a string.
    let words = runs(bytes, |b| b.is_ascii_alphanumeric());
    let at = pick(&words, random).map_or(bytes.len(), |word| random.random_range(word));
    bytes.splice(at..at, escape.bytes());
    format!("{escape:?} put in at {at}")
}

/// `"name":` and the byte behind it, in JSON and what looks like it.
fn keys(bytes: &[u8]) -> Vec<(Range<usize>, usize)> {
    let quotes: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at] == b'"').collect();
    let pairs = quotes.windows(2).filter_map(|pair| {
        let behind = bytes[pair[1] + 1..].iter().position(|b| !b.is_ascii_whitespace())? + pair[1] + 1;
        (bytes[behind] == b':').then_some((pair[0]..pair[1] + 1, behind + 1))
    });
    pairs.collect()
}

/// The end of the value that begins at `start`: the comma or bracket that closes it.
fn value_end(bytes: &[u8], start: usize) -> usize {
    let (mut depth, mut quoted) = (0_usize, false);
    for (at, byte) in bytes.iter().enumerate().skip(start) {
        match byte {
            b'"' if bytes[at - 1] != b'\\' => quoted = !quoted,
            _ if quoted => {}
            b'[' | b'{' => depth += 1,
            b',' | b']' | b'}' if depth == 0 => return at,
            b']' | b'}' => depth -= 1,
            _ => {}
        }
    }
    bytes.len()
}

fn name_of(bytes: &[u8], key: Range<usize>) -> String {
    String::from_utf8_lossy(&bytes[key]).into_owned()
}

fn drop_key(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    let Some((key, value)) = pick(&keys(bytes), random) else { return lines(bytes, other, random) };
    let name = name_of(bytes, key.clone());
    let mut start = key.start;
    let mut end = value_end(bytes, value);
    if bytes.get(end) == Some(&b',') {
        end += 1;
    } else if let Some(comma) = bytes[..start].iter().rposition(|b| !b.is_ascii_whitespace())
        && bytes[comma] == b','
    {
        start = comma;
    }
    bytes.drain(start..end);
    format!("key {name} removed")
}

fn duplicate_key(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    let Some((key, value)) = pick(&keys(bytes), random) else { return lines(bytes, other, random) };
    let mut copy = bytes[key.start..value_end(bytes, value)].to_vec();
    copy.push(b',');
    let done = format!("key {} twice", name_of(bytes, key.clone()));
    bytes.splice(key.start..key.start, copy);
    done
}

/// One key gets another's name, or another's value.
fn rename_key(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    let keys = keys(bytes);
    let (Some((a, at)), Some((b, from))) = (pick(&keys, random), pick(&keys, random)) else {
        return words(bytes, other, random);
    };
    let names = [a.clone(), b.clone()].map(|key| name_of(bytes, key));
    if random.random_bool(0.5) {
        let name = bytes[b].to_vec();
        bytes.splice(a, name);
        return format!("key {} called {}", names[0], names[1]);
    }
    let value = bytes[from..value_end(bytes, from)].to_vec();
    let end = value_end(bytes, at);
    bytes.splice(at..end, value);
    format!("key {} given the value of {}", names[0], names[1])
}

fn nest(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    // Most files take no harm from it, and it makes them long: seldom.
    if random.random_bool(0.7) {
        return escape(bytes, &[], random);
    }
    let opening = pick(&["[", "{\"a\":", "(", "a."], random).unwrap_or_default();
    let at = match pick(&keys(bytes), random) {
        Some((_, value)) => value,
        None => bytes.iter().position(|b| matches!(b, b'=' | b'[')).map_or(0, |at| at + 1),
    };
    bytes.splice(at..at, opening.repeat(DEPTH).into_bytes());
    format!("{DEPTH} times `{opening}` at {at}")
}

fn repeated(part: &[u8]) -> Vec<u8> {
    part.repeat(MANY.min(REPEATED / part.len()))
}

/// A line many times.
fn many_lines(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    if random.random_bool(0.7) {
        return lines(bytes, other, random);
    }
    let Some(line) = pick(&runs(bytes, |b| b != b'\n'), random) else { return "no line to repeat".into() };
    let end = (line.end + 1).min(bytes.len());
    let copies = repeated(&bytes[line.start..end]);
    let done = format!("the line at {} many times", line.start);
    bytes.splice(end..end, copies);
    done
}

/// The first item of a list many times.
fn many_items(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    let mut keys = keys(bytes);
    keys.retain(|(_, value)| bytes.get(*value) == Some(&b'['));
    let Some((key, list)) = pick(&keys, random) else { return lines(bytes, other, random) };
    let item = &bytes[list + 1..value_end(bytes, list + 1)];
    let copies = repeated(&[item, b","].concat());
    let done = format!("the first of {} many times", name_of(bytes, key));
    bytes.splice(list + 1..list + 1, copies);
    done
}

fn endless(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    if random.random_bool(0.7) {
        return number(bytes, &[], random);
    }
    let words = runs(bytes, |b| !b.is_ascii_whitespace());
    let at = pick(&words, random).map_or(0, |word| word.start);
    let byte = pick(b"x1 \"-", random).unwrap_or(b'x');
    bytes.splice(at..at, std::iter::repeat_n(byte, LINE));
    format!("{LINE} times {:?} at {at}", char::from(byte))
}
