//! Formats that wrap others in lengths and checksums. Damage of their bytes is noticed at the wrapping, so the parts
//! inside are damaged by themselves and wrapped again.

use std::io::{Cursor, Read, Write};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

/// Name and content of each part. A chunk's type is in its content, and only entries of archives have names.
pub type Parts = Vec<(Vec<u8>, Vec<u8>)>;

const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";

/// The parts of a sound file whose name ends in `ending`; `None` if the format wraps nothing.
pub fn open(ending: &str, bytes: &[u8]) -> Option<Parts> {
    let mut parts = Parts::new();
    match ending {
        "png" | "glb" => {
            let is_png = ending == "png";
            let mut rest = bytes.get(if is_png { PNG.len() } else { 12 }..)?;
            while let Some((length, more)) = rest.split_first_chunk() {
                let length = if is_png { u32::from_be_bytes(*length) } else { u32::from_le_bytes(*length) };
                let (chunk, more) = more.split_at_checked(4 + length as usize)?;
                parts.push((Vec::new(), chunk.to_vec()));
                rest = if is_png { more.get(4..)? } else { more };
            }
        }
        "spz" => {
            let mut content = Vec::new();
            GzDecoder::new(bytes).read_to_end(&mut content).ok()?;
            parts.push((Vec::new(), content));
        }
        "safetensors" => {
            let (length, rest) = bytes.split_first_chunk()?;
            let (header, data) = rest.split_at_checked(u64::from_le_bytes(*length) as usize)?;
            parts.extend([header, data].map(|part| (Vec::new(), part.to_vec())));
        }
        "npz" | "pth" | "sog" => {
            let mut archive = ZipArchive::new(Cursor::new(bytes)).ok()?;
            for row in 0..archive.len() {
                let mut entry = archive.by_index(row).ok()?;
                let mut content = Vec::new();
                entry.read_to_end(&mut content).ok()?;
                parts.push((entry.name_raw().to_vec(), content));
            }
        }
        _ => return None,
    }
    Some(parts)
}

/// The file again, with lengths and checksums that fit.
pub fn close(ending: &str, parts: &Parts) -> Vec<u8> {
    match ending {
        "png" => parts.iter().fold(PNG.to_vec(), |mut bytes, (_, chunk)| {
            bytes.extend((chunk.len().saturating_sub(4) as u32).to_be_bytes());
            bytes.extend(chunk);
            bytes.extend(crc32fast::hash(chunk).to_be_bytes());
            bytes
        }),
        "glb" => {
            let chunks = parts.iter().fold(Vec::<u8>::new(), |mut bytes, (_, chunk)| {
                let length = chunk.len().saturating_sub(4).next_multiple_of(4);
                let end = bytes.len() + 8 + length;
                bytes.extend((length as u32).to_le_bytes());
                bytes.extend(chunk);
                bytes.resize(end, if chunk.starts_with(b"JSON") { b' ' } else { 0 });
                bytes
            });
            let length = (12 + chunks.len() as u32).to_le_bytes();
            [b"glTF", &2_u32.to_le_bytes()[..], &length, &chunks].concat()
        }
        "spz" => {
            let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
            encoder.write_all(&parts[0].1).and_then(|()| encoder.finish()).expect("memory")
        }
        "safetensors" => [&(parts[0].1.len() as u64).to_le_bytes()[..], &parts[0].1, &parts[1].1].concat(),
        _ => {
            let method =
                if ending != "npz" { CompressionMethod::Stored } else { CompressionMethod::Deflated };
            let options = SimpleFileOptions::default().compression_method(method);
            let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
            for (name, part) in parts {
                archive.start_file(String::from_utf8_lossy(name), options).expect("a new entry");
                archive.write_all(part).expect("written to memory");
            }
            archive.finish().expect("written to memory").into_inner()
        }
    }
}
