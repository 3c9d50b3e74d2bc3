//! Formats that wrap others in lengths and checksums. Damage to their bytes is noticed at the wrapping; so that what lies
//! inside is put to the test as well, it is damaged by itself and wrapped anew.

use std::io::{Cursor, Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

/// Start of every PNG.
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";

/// What is wrapped, and how it is wrapped again.
pub struct Envelope {
    kind: Kind,
    /// What can be damaged by itself.
    pub parts: Vec<Vec<u8>>,
}

enum Kind {
    /// Chunks: kind and content.
    Png,
    /// Kinds of the chunks.
    Glb(Vec<[u8; 4]>),
    /// A stream.
    Gzip,
    /// Header and data.
    Safetensors,
    /// Names of the entries and how they are packed.
    Zip(Vec<(String, CompressionMethod)>),
}

impl Envelope {
    /// Opens a sound file; `None` if its format wraps nothing.
    pub fn open(path: &Path, bytes: &[u8]) -> Option<Self> {
        let ending = path.extension()?.to_str()?;
        let (kind, parts) = match ending {
            "png" => (Kind::Png, png_chunks(bytes)?),
            "glb" => {
                let (kinds, parts) = glb_chunks(bytes)?;
                (Kind::Glb(kinds), parts)
            }
            "spz" => {
                let mut content = Vec::new();
                GzDecoder::new(bytes).read_to_end(&mut content).ok()?;
                (Kind::Gzip, vec![content])
            }
            "safetensors" => {
                let (length, rest) = bytes.split_first_chunk()?;
                let (header, data) = rest.split_at_checked(u64::from_le_bytes(*length) as usize)?;
                (Kind::Safetensors, vec![header.to_vec(), data.to_vec()])
            }
            "npz" | "pth" => {
                let (names, parts) = zip_entries(bytes)?;
                (Kind::Zip(names), parts)
            }
            _ => return None,
        };
        (!parts.is_empty()).then_some(Self { kind, parts })
    }

    /// The file again, with lengths and checksums that fit.
    pub fn close(&self) -> Vec<u8> {
        let parts = &self.parts;
        match &self.kind {
            Kind::Png => {
                let chunk = |part: &Vec<u8>| {
                    let length = (part.len().saturating_sub(4) as u32).to_be_bytes();
                    [&length, part.as_slice(), &crc(part).to_be_bytes()].concat()
                };
                [PNG.to_vec(), parts.iter().flat_map(chunk).collect()].concat()
            }
            Kind::Glb(kinds) => {
                let mut chunks = Vec::new();
                for (kind, part) in kinds.iter().zip(parts) {
                    let padding = if kind == b"JSON" { b' ' } else { 0 };
                    let length = part.len().next_multiple_of(4);
                    chunks.extend((length as u32).to_le_bytes());
                    chunks.extend(kind);
                    chunks.extend(part);
                    chunks.resize(chunks.len() + length - part.len(), padding);
                }
                let length = (12 + chunks.len() as u32).to_le_bytes();
                [b"glTF", &2_u32.to_le_bytes()[..], &length, &chunks].concat()
            }
            Kind::Gzip => {
                let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
                encoder.write_all(&parts[0]).and_then(|()| encoder.finish()).expect("memory")
            }
            Kind::Safetensors => [&(parts[0].len() as u64).to_le_bytes()[..], &parts[0], &parts[1]].concat(),
            Kind::Zip(names) => {
                let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
                for ((name, method), part) in names.iter().zip(parts) {
                    let options = SimpleFileOptions::default().compression_method(*method);
                    archive.start_file(name, options).expect("a new entry");
                    archive.write_all(part).expect("written to memory");
                }
                archive.finish().expect("written to memory").into_inner()
            }
        }
    }
}

fn png_chunks(bytes: &[u8]) -> Option<Vec<Vec<u8>>> {
    let mut rest = bytes.strip_prefix(PNG)?;
    let mut chunks = Vec::new();
    while let Some((length, more)) = rest.split_first_chunk() {
        let (chunk, more) = more.split_at_checked(4 + u32::from_be_bytes(*length) as usize)?;
        chunks.push(chunk.to_vec());
        rest = more.get(4..)?;
    }
    Some(chunks)
}

type Chunks = (Vec<[u8; 4]>, Vec<Vec<u8>>);

fn glb_chunks(bytes: &[u8]) -> Option<Chunks> {
    let mut rest = bytes.get(12..)?;
    let (mut kinds, mut parts) = (Vec::new(), Vec::new());
    while let Some((length, more)) = rest.split_first_chunk() {
        let (kind, more) = more.split_first_chunk()?;
        let (part, more) = more.split_at_checked(u32::from_le_bytes(*length) as usize)?;
        kinds.push(*kind);
        parts.push(part.to_vec());
        rest = more;
    }
    Some((kinds, parts))
}

type Entries = (Vec<(String, CompressionMethod)>, Vec<Vec<u8>>);

fn zip_entries(bytes: &[u8]) -> Option<Entries> {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).ok()?;
    let (mut names, mut parts) = (Vec::new(), Vec::new());
    for row in 0..archive.len() {
        let mut entry = archive.by_index(row).ok()?;
        let mut part = Vec::new();
        entry.read_to_end(&mut part).ok()?;
        names.push((entry.name().ok()?.into_owned(), entry.compression()));
        parts.push(part);
    }
    Some((names, parts))
}

/// CRC-32 as PNG has it.
fn crc(bytes: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { (crc >> 1) ^ 0xedb8_8320 } else { crc >> 1 };
    !bytes.iter().fold(!0, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), |crc, _| step(crc)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_opened_and_closed_is_the_same() {
        let mut png = Cursor::new(Vec::new());
        image::RgbImage::new(3, 2).write_to(&mut png, image::ImageFormat::Png).expect("encodes");
        let png = png.into_inner();
        let envelope = Envelope::open(Path::new("a.png"), &png).expect("a PNG");
        assert_eq!(&envelope.parts[0][..4], b"IHDR");
        assert_eq!(envelope.close(), png);

        let safetensors = [&2_u64.to_le_bytes()[..], b"{}123"].concat();
        let envelope = Envelope::open(Path::new("a.safetensors"), &safetensors).expect("a header");
        assert_eq!(envelope.parts, [b"{}".to_vec(), b"123".to_vec()]);
        assert_eq!(envelope.close(), safetensors);
        assert!(Envelope::open(Path::new("a.obj"), b"v 0 0 0").is_none());
    }
}
