//! Changes of bytes and text, as broken disks, cut downloads and hostile hands make them.

use std::ops::Range;

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::{Index, select};

/// Where readers decide what follows: half of all changes are there.
const HEAD: usize = 256;
/// Most bytes of a block that is moved, repeated or removed.
const BLOCK: usize = 64;
/// More bytes than any file has.
const ALL: usize = usize::MAX;
/// Large numbers that are no powers of two. The last two are both sides of a large picture.
const LARGE: [u64; 3] = [1_000_000_000, 0x3e80_3e7f, 0x3e80_0000_3e7f];
/// Numbers at which arithmetic goes wrong.
const REAL: [f64; 8] =
    [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e38, -1e38, 1e-45, f64::MAX, f64::MIN_POSITIVE];
/// Words that take the place of others, with spaces between them; a terminal would obey the last ones.
const WORDS: &str = "0 -0 1 -1 2 0.5 nan inf -inf 1e38 1e39 1e999 1e-45 255 256 65536 2147483648 -2147483648 4294967295 \
                     9223372036854775807 18446744073709551615 99999999999999999999 null true [] \u{1b}[31m \
                     \u{1b}]0;title\u{7} \u{9b}31m\r\0 \u{202e}\u{7f} ";
/// Brackets nested deeper than any stack that a parser could recurse on, and words without an end, when repeated.
const ENDLESS: [&str; 8] = ["[", "{\"a\":", "(", "a.", "x", "1", " ", "\""];
/// How often an item is repeated: small files that unfold to large ones.
const MANY: usize = 20_000;
/// Most bytes that repetition adds. The program reads configs of a little more.
const REPEATED: usize = 1_000_000;

/// A place between bytes: whether it is in the head, and where.
type Place = (bool, Index);

fn place((is_in_head, at): Place, bytes: &[u8]) -> usize {
    at.index(1 + if is_in_head { bytes.len().min(HEAD) } else { bytes.len() })
}

/// A change of bytes, whatever they mean.
#[derive(Debug, Clone)]
enum Binary {
    Overwrite {
        at: Place,
        aligned: bool,
        value: Vec<u8>,
    },
    /// A block of this or another file takes the place of so many bytes; [`ALL`] goes to the end.
    Copy {
        from: Place,
        length: usize,
        to: Place,
        removed: usize,
        is_other: bool,
    },
}

/// A change of text, which changes of bytes would hardly ever make.
#[derive(Debug, Clone)]
enum Text {
    /// A word takes the place of another, or goes into the middle of it, so many times.
    Word(Index, bool, (&'static str, usize)),
    OtherWord(Index, Index),
    /// A line, before another, so many times; 0 removes it.
    Line(Index, Index, usize),
    /// The item of a list, or a text without lists, many times.
    Items(Index),
}

/// One change: of text if a file or part of it is text, else of bytes.
#[derive(Debug, Clone)]
pub struct Change {
    text: Option<Text>,
    binary: Binary,
}

/// One to four changes, mostly few.
pub fn changes() -> impl Strategy<Value = Vec<Change>> {
    let change = (prop::option::weighted(0.75, text()), binary());
    let change = change.prop_map(|(text, binary)| Change { text, binary });
    prop_oneof![3 => vec(change.clone(), 1), 2 => vec(change, 2..=4)]
}

fn binary() -> impl Strategy<Value = Binary> + Clone {
    // Powers of two and their neighbours, at which sums, shifts, signs and allocations go wrong.
    let power = (0..64_u32, 0..3_u64).prop_map(|(bits, more)| (u64::MAX >> bits).wrapping_add(more));
    let whole = (prop_oneof![3 => power, 1 => select(&LARGE[..])], select(&[1_usize, 2, 4, 8][..]))
        .prop_map(|(value, size)| value.to_le_bytes()[..size].to_vec());
    let real = (select(&REAL[..]), any::<bool>()).prop_map(|(value, single)| {
        if single { (value as f32).to_le_bytes().to_vec() } else { value.to_le_bytes().to_vec() }
    });
    let value = prop_oneof![
        3 => whole,
        1 => real,
        2 => vec(any::<u8>(), 1..=8),
        1 => (1..=BLOCK).prop_map(|length| vec![0; length]),
    ];
    let value = (value, any::<bool>()).prop_map(|(bytes, is_big_endian): (Vec<u8>, bool)| {
        if is_big_endian { bytes.into_iter().rev().collect() } else { bytes }
    });
    let overwrite = (any::<Place>(), any::<bool>(), value);
    // Nothing and everything: a file is cut, joined to another, or has a block more or less.
    let length = || prop_oneof![2 => 0..=BLOCK, 1 => Just(0), 1 => Just(ALL)];
    let copy = (any::<Place>(), length(), any::<Place>(), length(), any::<bool>());
    prop_oneof![
        1 => overwrite.prop_map(|(at, aligned, value)| Binary::Overwrite { at, aligned, value }),
        1 => copy.prop_map(|(from, length, to, removed, is_other)| {
            Binary::Copy { from, length, to, removed, is_other }
        }),
    ]
}

fn text() -> impl Strategy<Value = Text> + Clone {
    let index = any::<Index>;
    let known = select(WORDS.split(' ').collect::<Vec<_>>()).prop_map(|word| (word, 1_usize));
    let endless = select(&ENDLESS[..]).prop_map(|word| (word, REPEATED));
    let new = prop_oneof![8 => known, 1 => endless];
    let times = prop_oneof![2 => Just(0), 3 => Just(1), 1 => Just(MANY)];
    prop_oneof![
        9 => (index(), prop::bool::weighted(0.25), new)
            .prop_map(|(at, is_within, new)| Text::Word(at, is_within, new)),
        4 => (index(), index()).prop_map(|(word, other)| Text::OtherWord(word, other)),
        3 => (index(), index(), times).prop_map(|(line, to, times)| Text::Line(line, to, times)),
        1 => index().prop_map(Text::Items),
    ]
}

/// Whether the bytes read as text for the most part.
pub fn is_text(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(1024)];
    let odd = start.iter().filter(|b| **b < b' ' && !b.is_ascii_whitespace()).count();
    !start.is_empty() && 20 * odd < start.len() && std::str::from_utf8(&start[..start.len().min(64)]).is_ok()
}

impl Change {
    /// Changes `bytes`; `other` is another file of the kind, or another part of this one.
    pub fn apply(&self, bytes: &mut Vec<u8>, other: &[u8]) {
        match &self.text {
            Some(text) if is_text(bytes) => text.apply(bytes),
            _ => self.binary.apply(bytes, other),
        }
    }
}

impl Binary {
    fn apply(&self, bytes: &mut Vec<u8>, other: &[u8]) {
        match self {
            Self::Overwrite { at, aligned, value } => {
                let at = place(*at, bytes);
                let at = if *aligned { at - at % value.len() } else { at };
                let end = (at + value.len()).min(bytes.len());
                bytes[at..end].copy_from_slice(&value[..end - at]);
            }
            Self::Copy { from, length, to, removed, is_other } => {
                let source: &[u8] = if *is_other { other } else { bytes };
                let from = place(*from, source);
                let copy = source[from..from.saturating_add(*length).min(source.len())].to_vec();
                let to = place(*to, bytes);
                bytes.splice(to..to.saturating_add(*removed).min(bytes.len()), copy);
            }
        }
    }
}

impl Text {
    fn apply(&self, bytes: &mut Vec<u8>) {
        let words = runs(bytes, |b| !(b.is_ascii_whitespace() || b"\"[]{}():,=/".contains(&b)));
        let lines = runs(bytes, |b| b != b'\n');
        let pick = |index: &Index, runs: &[Range<usize>]| {
            if runs.is_empty() { 0..0 } else { runs[index.index(runs.len())].clone() }
        };
        match self {
            Self::Word(at, is_within, (new, times)) => {
                let Range { start, end } = pick(at, &words);
                let middle = start.midpoint(end);
                let place = if *is_within { middle..middle } else { start..end };
                bytes.splice(place, repeated(new.as_bytes(), *times));
            }
            Self::OtherWord(word, other) => {
                let other = bytes[pick(other, &words)].to_vec();
                bytes.splice(pick(word, &words), other);
            }
            Self::Line(line, to, times) => {
                let (line, to) = (pick(line, &lines), pick(to, &lines).start);
                let end = (line.end + 1).min(bytes.len());
                if *times == 0 {
                    bytes.drain(line.start..end);
                } else {
                    let copies = repeated(&bytes[line.start..end], *times);
                    bytes.splice(to..to, copies);
                }
            }
            Self::Items(list) => {
                let start = pick(list, &runs(bytes, |b| b == b'[')).end;
                let item = [first_value(&bytes[start..]), b","].concat();
                // Each may be a picture that is drawn.
                bytes.splice(start..start, repeated(&item, MANY / 25));
            }
        }
    }
}

/// Ranges of bytes for which `inside` holds without a gap.
fn runs(bytes: &[u8], inside: impl Fn(u8) -> bool) -> Vec<Range<usize>> {
    let mut start = 0;
    let parts = bytes.split(|b| !inside(*b)).map(|part| {
        let run = start..start + part.len();
        start = run.end + 1;
        run
    });
    parts.filter(|run| !run.is_empty()).collect()
}

fn repeated(part: &[u8], times: usize) -> Vec<u8> {
    part.repeat(times.min(1 + REPEATED / part.len().max(1)))
}

/// The bytes before the comma or bracket that closes the first value.
fn first_value(bytes: &[u8]) -> &[u8] {
    let mut depth = 0;
    let end = bytes.iter().position(|byte| {
        match byte {
            b'[' | b'{' => depth += 1,
            b']' | b'}' => depth -= 1,
            _ => {}
        }
        depth < 0 || depth == 0 && *byte == b','
    });
    &bytes[..end.unwrap_or(bytes.len())]
}
