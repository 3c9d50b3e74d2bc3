//! TensorBoard's event files. A record is a length, data and checksums. The data is a protocol buffer with a time, a
//! step and named values. (Crates that write such files need protobuf's compiler or are no longer maintained.)

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// An open event file.
pub struct Events(File);

impl Events {
    /// Makes the file, or empties it.
    pub fn create(path: &Path) -> io::Result<Self> {
        let mut events = Self(File::create(path)?);
        // Field 3, text: the version of the format.
        let mut event = now();
        text(&mut event, 3, b"brain.Event:2");
        events.record(&event)?;
        Ok(events)
    }

    /// Adds the values of a step.
    pub fn add(&mut self, step: u64, values: &BTreeMap<String, f64>) -> io::Result<()> {
        let mut summary = Vec::new();
        for (name, value) in values {
            let mut entry = Vec::new();
            text(&mut entry, 1, name.as_bytes());
            // Field 2, four bytes.
            entry.push(2 << 3 | 5);
            entry.extend((*value as f32).to_le_bytes());
            text(&mut summary, 1, &entry);
        }
        self.summary(step, &summary)
    }

    fn summary(&mut self, step: u64, summary: &[u8]) -> io::Result<()> {
        let mut event = now();
        event.push(2 << 3);
        varint(&mut event, step);
        text(&mut event, 5, summary);
        self.record(&event)
    }

    /// Adds a PNG of `size` (width, height) to a step, named `preview`.
    pub fn add_preview(&mut self, step: u64, size: (u32, u32), png: &[u8]) -> io::Result<()> {
        // Height, width, number of channels, bytes.
        let mut picture = Vec::new();
        for (field, value) in [(1, size.1), (2, size.0), (3, 3)] {
            picture.push(field << 3);
            varint(&mut picture, value.into());
        }
        text(&mut picture, 4, png);
        let (mut entry, mut summary) = (Vec::new(), Vec::new());
        text(&mut entry, 1, b"preview");
        text(&mut entry, 4, &picture);
        text(&mut summary, 1, &entry);
        self.summary(step, &summary)
    }

    fn record(&mut self, data: &[u8]) -> io::Result<()> {
        let length = (data.len() as u64).to_le_bytes();
        let mut record = length.to_vec();
        record.extend(masked(crc32c(&length)).to_le_bytes());
        record.extend(data);
        record.extend(masked(crc32c(data)).to_le_bytes());
        self.0.write_all(&record)
    }
}

/// Field 1, eight bytes: seconds since 1970.
fn now() -> Vec<u8> {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64());
    let mut event = vec![1 << 3 | 1];
    event.extend(seconds.to_le_bytes());
    event
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn text(out: &mut Vec<u8>, field: u8, bytes: &[u8]) {
    out.push(field << 3 | 2);
    varint(out, bytes.len() as u64);
    out.extend(bytes);
}

/// The checksum as TensorFlow's records store it.
fn masked(crc: u32) -> u32 {
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

/// Castagnoli's checksum.
fn crc32c(bytes: &[u8]) -> u32 {
    let bit = |crc: u32, _: u8| if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
    let byte = |crc: u32, byte: &u8| (0..8).fold(crc ^ u32::from(*byte), bit);
    !bytes.iter().fold(!0, byte)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// RFC 3720, B.4, and TensorFlow's own test of the mask.
    #[test]
    fn checksums_are_the_published_ones() {
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
    }

    #[test]
    fn records_contain_the_values() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("events");
        let mut events = Events::create(&path).expect("writes");
        events.add(300, &[("loss".to_owned(), 0.5)].into()).expect("writes");
        let bytes = std::fs::read(&path).expect("there");
        // The second record comes after length 8 + 4, time 9, version 2 + 13 and checksum 4.
        let second = &bytes[12 + 9 + 15 + 4..];
        let length = u64::from_le_bytes(second[..8].try_into().expect("eight")) as usize;
        let data = &second[12..12 + length];
        assert_eq!(second.len(), 12 + length + 4);
        assert_eq!(&data[9..12], &[2 << 3, 0xac, 0x02]);
        let value = [&[5 << 3 | 2, 13, 1 << 3 | 2, 11, 1 << 3 | 2, 4][..], b"loss", &[2 << 3 | 5]].concat();
        assert_eq!(&data[12..], [&value[..], &0.5_f32.to_le_bytes()].concat());
    }
}
