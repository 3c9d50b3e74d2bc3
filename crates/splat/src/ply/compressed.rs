//! PlayCanvas' compressed PLY: each Gaussian is four words, relative to the ranges of its chunk
//! (developer.playcanvas.com, "The Compressed PLY Format").

use std::io::BufRead;

use super::body::Body;
use super::header::{Element, Header};
use crate::sh;
use crate::stored::{COEFFICIENTS, Problem, Stored, logit, smallest_three};

/// Gaussians of a chunk.
const CHUNK: usize = 256;
/// The words of a Gaussian.
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// What the ranges of a chunk are of. Colours may have none.
const RANGES: [&str; 9] = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
/// Range of the SH coefficients' bytes.
const HARMONICS: f32 = 8.0;

/// Whether a header is of a compressed PLY.
pub(super) fn is_compressed(header: &Header) -> bool {
    let is_packed = |element: &Element| element.properties.iter().any(|p| p.name == WORDS[0]);
    header.elements.iter().any(|element| element.name == "vertex" && is_packed(element))
}

/// The values of an element, row after row. They must be single.
fn values(body: &mut Body<impl BufRead>, element: &Element) -> Result<Vec<f64>, Problem> {
    if let Some(list) = element.properties.iter().find(|p| p.list.is_some()) {
        return Err(format!("`{}` has a list, `{}`", element.name, snapsnap_base::quoted(&list.name)).into());
    }
    // Without properties, the file need not contain the rows that the header promises.
    if element.properties.is_empty() {
        return Err(format!("`{}` has no properties", element.name).into());
    }
    let mut values = Vec::new();
    for row in 0..element.count {
        body.row(element, row, 1, |_, value| {
            values.push(value.exact()?);
            Some(())
        })?;
    }
    Ok(values)
}

/// Reads the Gaussians of a header for which [`is_compressed`] holds.
pub(super) fn read(header: &Header, mut body: Body<impl BufRead>) -> Result<Stored, Problem> {
    let (mut chunks, mut vertices, mut harmonics) = (None, None, None);
    for element in &header.elements {
        let found = match element.name.as_str() {
            "chunk" => &mut chunks,
            "vertex" => &mut vertices,
            "sh" => &mut harmonics,
            _ => {
                body.skip(element)?;
                continue;
            }
        };
        *found = Some((element, values(&mut body, element)?));
    }
    let (chunk, chunks) = chunks.ok_or_else(|| "a compressed PLY without its element `chunk`".to_owned())?;
    let (vertex, vertices) = vertices.expect("a compressed PLY has packed vertices");
    if chunk.count < vertex.count.div_ceil(CHUNK) {
        return Err(format!("{} chunks for {} Gaussians", chunk.count, vertex.count).into());
    }
    let place = |element: &Element, name: &str| element.properties.iter().position(|p| p.name == name);
    let lacks = |name: &str| Problem::from(format!("a compressed PLY without `{name}`"));
    let mut ranges = Vec::new();
    for (i, name) in RANGES.iter().enumerate() {
        let limits = [format!("min_{name}"), format!("max_{name}")].map(|limit| place(chunk, &limit));
        match limits {
            [Some(low), Some(high)] => ranges.push(Some([low, high])),
            _ if i >= 6 => ranges.push(None),
            _ => return Err(lacks(&format!("min_{name}"))),
        }
    }
    let mut words = Vec::new();
    for name in WORDS {
        words.push(place(vertex, name).ok_or_else(|| lacks(name))?);
    }
    let word = |row: &[f64], which: usize| row[words[which]] as u32;
    // A share of the range of a chunk.
    let ranged = |i: usize, which: usize, share: f32| match ranges[which] {
        Some([low, high]) => {
            let own = &chunks[i / CHUNK * chunk.properties.len()..];
            let [low, high] = [low, high].map(|limit| own[limit] as f32);
            low + share * (high - low)
        }
        None => share,
    };
    let mut columns = vec![Vec::with_capacity(vertex.count); Stored::COLUMNS.len()];
    for (i, row) in vertices.chunks_exact(vertex.properties.len()).enumerate() {
        let centre = eleven_ten_eleven(word(row, 0));
        let scale = eleven_ten_eleven(word(row, 2));
        let color = word(row, 3).to_be_bytes().map(|byte| f32::from(byte) / 255.0);
        let rgb = [0, 1, 2].map(|c| (ranged(i, 6 + c, color[c]) - 0.5) / sh::C0);
        let centre = [0, 1, 2].map(|axis| ranged(i, axis, centre[axis]));
        let scale = [0, 1, 2].map(|axis| ranged(i, 3 + axis, scale[axis]));
        let all = centre.into_iter().chain(rotation(word(row, 1))).chain(scale);
        let all = all.chain([logit(color[3])]).chain(rgb);
        columns.iter_mut().zip(all).for_each(|(column, value)| column.push(value));
    }
    let mut coefficients = 1;
    if let Some((element, bytes)) = harmonics {
        let count = element.properties.len();
        let known = COEFFICIENTS.into_iter().find(|known| 3 * (known - 1) == count);
        let there = known.filter(|_| element.count == vertex.count);
        coefficients = there.ok_or_else(|| {
            format!("`sh` has {count} values for {} of {} Gaussians", element.count, vertex.count)
        })?;
        let value = |byte: f64| match byte {
            0.0 => -0.5 * HARMONICS,
            255.0 => 0.5 * HARMONICS,
            byte => ((byte as f32 + 0.5) / 256.0 - 0.5) * HARMONICS,
        };
        columns.extend(
            (0..count).map(|band| bytes.iter().skip(band).step_by(count).map(|b| value(*b)).collect()),
        );
    }
    Ok(Stored { coefficients, columns })
}

/// Three shares of 11, 10 and 11 bits.
fn eleven_ten_eleven(word: u32) -> [f32; 3] {
    [(word >> 21) as f32 / 2047.0, (word >> 11 & 1023) as f32 / 1023.0, (word & 2047) as f32 / 2047.0]
}

/// A quaternion (w, x, y, z): the index of the largest component, and the others in ten bits each.
fn rotation(word: u32) -> [f32; 4] {
    smallest_three((word >> 30) as usize, [20, 10, 0].map(|shift| (word >> shift & 1023) as f32 / 1023.0))
}
