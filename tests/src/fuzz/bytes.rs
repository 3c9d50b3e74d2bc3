//! Damage that any file can take: what broken disks, cut downloads and hostile hands do to bytes, whatever they mean.
#![allow(clippy::ptr_arg, reason = "all kinds of damage have one signature")]

use rand::Rng;

use super::Random;

/// Where readers decide what follows: half of all damage goes there.
const HEAD: usize = 256;
/// Longest block that is removed, repeated or moved.
const BLOCK: usize = 64;
/// Whole numbers at which sums, shifts, signs and allocations go wrong.
const WHOLE: [u64; 22] = [
    0,
    1,
    2,
    u64::MAX,
    u64::MAX - 1,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0x8000,
    0xffff,
    0x1_0000,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    0x1_0000_0000,
    0x3fff_ffff_ffff_ffff,
    0x7fff_ffff_ffff_ffff,
    0x8000_0000_0000_0000,
    1_000_000_000,
    // Both sides of a picture at once, in two bytes each or four: large, but not absurdly so.
    0x3e80_3e7f,
    0x3e80_0000_3e7f,
];
/// Numbers at which arithmetic goes wrong.
const REAL: [f64; 9] =
    [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e38, -1e38, 1e-45, f64::MAX, f64::MIN_POSITIVE, -0.0];

/// A kind of damage: changes the bytes and says how.
pub type Damage = fn(&mut Vec<u8>, &[u8], &mut Random) -> String;

/// Every kind.
const DAMAGES: &[Damage] = &[
    truncate,
    append,
    flip_bit,
    overwrite,
    delete_block,
    duplicate_block,
    swap_blocks,
    zero_run,
    whole_number,
    whole_number,
    whole_number,
    real_number,
    splice,
];

/// A kind of damage.
pub fn damage(random: &mut Random) -> Damage {
    DAMAGES[random.random_range(0..DAMAGES.len())]
}

/// A place to damage, often near the beginning.
fn place(bytes: &[u8], random: &mut Random) -> usize {
    let end = if random.random_bool(0.5) { bytes.len().min(HEAD) } else { bytes.len() };
    if end == 0 { 0 } else { random.random_range(0..end) }
}

/// A block that begins at such a place.
fn block(bytes: &[u8], random: &mut Random) -> std::ops::Range<usize> {
    let start = place(bytes, random);
    let length = random.random_range(1..=BLOCK);
    start..(start + length).min(bytes.len())
}

fn truncate(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    // The last bytes are where cuts are noticed least.
    let length = match bytes.len() {
        0 => 0,
        all if random.random_bool(0.3) => all - random.random_range(1..=all.min(16)),
        all => random.random_range(0..all),
    };
    let before = bytes.len();
    bytes.truncate(length);
    format!("cut to {length} of {before} bytes")
}

fn append(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let before = bytes.len();
    if random.random_bool(0.2) {
        bytes.extend_from_within(..);
    } else {
        let more = random.random_range(1..=BLOCK);
        bytes.extend((0..more).map(|_| random.random::<u8>()));
    }
    format!("{} bytes behind its end", bytes.len() - before)
}

fn flip_bit(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let (at, bit) = (place(bytes, random), random.random_range(0..8));
    if let Some(byte) = bytes.get_mut(at) {
        *byte ^= 1 << bit;
    }
    format!("bit {bit} of byte {at} flipped")
}

fn overwrite(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let start = place(bytes, random);
    let end = (start + random.random_range(1..=8)).min(bytes.len());
    random.fill(&mut bytes[start..end]);
    format!("bytes {start} to {end} random")
}

fn delete_block(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let block = block(bytes, random);
    bytes.drain(block.clone());
    format!("bytes {block:?} removed")
}

fn duplicate_block(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let (block, to) = (block(bytes, random), place(bytes, random));
    let copy = bytes[block.clone()].to_vec();
    bytes.splice(to..to, copy);
    format!("bytes {block:?} again at {to}")
}

fn swap_blocks(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let (a, b) = (place(bytes, random), place(bytes, random));
    let (first, second) = (a.min(b), a.max(b));
    let length = random.random_range(1..=BLOCK).min(second - first).min(bytes.len() - second);
    for i in 0..length {
        bytes.swap(first + i, second + i);
    }
    format!("{length} bytes at {first} and {second} swapped")
}

fn zero_run(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let block = block(bytes, random);
    bytes[block.clone()].fill(0);
    format!("bytes {block:?} zero")
}

fn whole_number(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let value = WHOLE[random.random_range(0..WHOLE.len())];
    let size = [1, 2, 4, 8][random.random_range(0..4)];
    put(bytes, &value.to_le_bytes()[..size], &value.to_string(), random)
}

fn real_number(bytes: &mut Vec<u8>, _: &[u8], random: &mut Random) -> String {
    let value = REAL[random.random_range(0..REAL.len())];
    let text = format!("{value:e}");
    if random.random_bool(0.7) {
        put(bytes, &(value as f32).to_le_bytes(), &text, random)
    } else {
        put(bytes, &value.to_le_bytes(), &text, random)
    }
}

/// Writes a number, lowest byte first or last, often where numbers are aligned.
fn put(bytes: &mut [u8], value: &[u8], text: &str, random: &mut Random) -> String {
    let mut value = value.to_vec();
    let big = random.random_bool(0.5);
    if big {
        value.reverse();
    }
    let mut at = place(bytes, random);
    if random.random_bool(0.5) {
        at -= at % value.len();
    }
    let end = (at + value.len()).min(bytes.len());
    bytes[at..end].copy_from_slice(&value[..end - at]);
    let order = if big { "big" } else { "little" };
    format!("{text} in {} bytes at {at}, {order}-endian", value.len())
}

/// The beginning of this file and the end of another.
fn splice(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    let (at, from) = (place(bytes, random), place(other, random));
    bytes.truncate(at);
    bytes.extend_from_slice(&other[from..]);
    format!("byte {from} of another sample and all behind it from byte {at} on")
}
