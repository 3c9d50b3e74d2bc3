//! Changes of bytes and text, as broken disks, cut downloads and hostile hands make them.

use std::ops::Range;

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::{Index, select};

/// Where readers decide what follows: half of all changes are there.
const HEAD: usize = 256;
/// Most bytes that are moved, repeated or removed.
const BLOCK: usize = 64;
/// Whole numbers at which sums, shifts, signs and allocations go wrong. The last two are both sides of a large picture.
const WHOLE: [u64; 16] = [
    0,
    1,
    2,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0xffff,
    1 << 31,
    (1 << 31) - 1,
    (1 << 32) - 1,
    u64::MAX,
    u64::MAX / 2,
    1_000_000_000,
    0x3e80_3e7f,
    0x3e80_0000_3e7f,
];
/// Numbers at which arithmetic goes wrong.
const REAL: [f64; 8] =
    [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e38, -1e38, 1e-45, f64::MAX, f64::MIN_POSITIVE];
/// Words that take the place of others, with spaces between them; a terminal would obey the last ones.
const WORDS: &str = "0 -0 1 -1 2 0.5 nan inf -inf 1e38 1e39 1e999 1e-45 255 256 65536 2147483648 -2147483648 4294967295 \
                     9223372036854775807 18446744073709551615 99999999999999999999 null true [] \u{1b}[31m \
                     \u{1b}]0;title\u{7} \u{9b}31m\r\0 \u{202e}\u{7f} ";
/// Brackets nested deeper than any stack that a parser could recurse on, and words without an end.
const ENDLESS: [(&str, usize); 8] = [
    ("[", 200_000),
    ("{\"a\":", 200_000),
    ("(", 200_000),
    ("a.", 200_000),
    ("x", 3_000_000),
    ("1", 3_000_000),
    (" ", 3_000_000),
    ("\"", 3_000_000),
];
/// How often an item is repeated: small files that unfold to large ones.
const MANY: usize = 20_000;
/// Most bytes that repetition adds.
const REPEATED: usize = 4 << 20;

/// A place between bytes.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    in_head: bool,
    at: Index,
}

impl Place {
    fn of(self, bytes: &[u8]) -> usize {
        self.at.index(1 + if self.in_head { bytes.len().min(HEAD) } else { bytes.len() })
    }
}

/// A change of bytes, whatever they mean.
#[derive(Debug, Clone)]
enum Binary {
    Cut(Place),
    Overwrite {
        at: Place,
        aligned: bool,
        value: Vec<u8>,
    },
    /// A block of this or another file takes the place of so many bytes.
    Copy {
        from: Place,
        length: usize,
        to: Place,
        removed: usize,
        is_other: bool,
    },
    /// The beginning of this file and the end of another.
    Join(Place, Place),
}

/// A change of text, which changes of bytes would hardly ever make.
#[derive(Debug, Clone)]
enum Text {
    Word(Index, &'static str),
    OtherWord(Index, Index),
    Within(Index, &'static str),
    Endless(Index, (&'static str, usize)),
    /// A line, before another, so many times; 0 removes it.
    Line(Index, Index, usize),
    /// The item of a list, many times.
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

fn place() -> impl Strategy<Value = Place> + Clone {
    any::<(bool, Index)>().prop_map(|(in_head, at)| Place { in_head, at })
}

fn binary() -> impl Strategy<Value = Binary> + Clone {
    let whole = (select(&WHOLE[..]), select(&[1_usize, 2, 4, 8][..]))
        .prop_map(|(value, size)| value.to_le_bytes()[..size].to_vec());
    let real = (select(&REAL[..]), any::<bool>()).prop_map(|(value, single)| {
        if single { (value as f32).to_le_bytes().to_vec() } else { value.to_le_bytes().to_vec() }
    });
    let number =
        (prop_oneof![2 => whole, 1 => real], any::<bool>()).prop_map(|(mut bytes, is_big_endian)| {
            if is_big_endian {
                bytes.reverse();
            }
            bytes
        });
    let value = prop_oneof![
        4 => number,
        2 => vec(any::<u8>(), 1..=8),
        1 => (1..=BLOCK).prop_map(|length| vec![0; length]),
    ];
    let overwrite = (place(), any::<bool>(), value);
    let copy = (place(), 0..=BLOCK, place(), 0..=BLOCK, any::<bool>());
    prop_oneof![
        1 => place().prop_map(Binary::Cut),
        7 => overwrite.prop_map(|(at, aligned, value)| Binary::Overwrite { at, aligned, value }),
        4 => copy.prop_map(|(from, length, to, removed, is_other)| {
            Binary::Copy { from, length, to, removed, is_other }
        }),
        1 => (place(), place()).prop_map(|(at, from)| Binary::Join(at, from)),
    ]
}

fn text() -> impl Strategy<Value = Text> + Clone {
    let index = any::<Index>;
    let word = || select(WORDS.split(' ').collect::<Vec<_>>());
    let times = prop_oneof![2 => Just(0), 3 => Just(1), 1 => Just(MANY)];
    prop_oneof![
        6 => (index(), word()).prop_map(|(word, new)| Text::Word(word, new)),
        4 => (index(), index()).prop_map(|(word, other)| Text::OtherWord(word, other)),
        2 => (index(), word()).prop_map(|(word, new)| Text::Within(word, new)),
        1 => (index(), select(&ENDLESS[..])).prop_map(|(word, what)| Text::Endless(word, what)),
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
            Self::Cut(at) => bytes.truncate(at.of(bytes)),
            Self::Overwrite { at, aligned, value } => {
                let at = at.of(bytes);
                let at = if *aligned { at - at % value.len() } else { at };
                let end = (at + value.len()).min(bytes.len());
                bytes[at..end].copy_from_slice(&value[..end - at]);
            }
            Self::Copy { from, length, to, removed, is_other } => {
                let source: &[u8] = if *is_other { other } else { bytes };
                let from = from.of(source);
                let copy = source[from..(from + length).min(source.len())].to_vec();
                let to = to.of(bytes);
                bytes.splice(to..(to + removed).min(bytes.len()), copy);
            }
            Self::Join(at, from) => {
                bytes.truncate(at.of(bytes));
                bytes.extend_from_slice(&other[from.of(other)..]);
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
            Self::Word(word, new) => {
                bytes.splice(pick(word, &words), new.bytes());
            }
            Self::OtherWord(word, other) => {
                let other = bytes[pick(other, &words)].to_vec();
                bytes.splice(pick(word, &words), other);
            }
            Self::Within(word, new) => {
                let word = pick(word, &words);
                let middle = word.start + word.len() / 2;
                bytes.splice(middle..middle, new.bytes());
            }
            Self::Endless(word, (what, times)) => {
                let start = pick(word, &words).start;
                bytes.splice(start..start, what.repeat(*times).into_bytes());
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
                let lists: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at] == b'[').collect();
                if lists.is_empty() {
                    return;
                }
                let start = lists[list.index(lists.len())] + 1;
                let item = [&bytes[start..value_end(bytes, start)], b","].concat();
                bytes.splice(start..start, repeated(&item, MANY));
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

/// The end of the value that begins at `start`: the comma or bracket that closes it.
fn value_end(bytes: &[u8], start: usize) -> usize {
    let mut depth = 0_usize;
    for (at, byte) in bytes.iter().enumerate().skip(start) {
        match byte {
            b'[' | b'{' => depth += 1,
            b',' | b']' | b'}' if depth == 0 => return at,
            b']' | b'}' => depth -= 1,
            _ => {}
        }
    }
    bytes.len()
}
