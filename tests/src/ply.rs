//! PLY files of Gaussians, in every layout that programs write.

use crate::scenes::Random;

/// A Gaussian's numbers by property name, as text.
pub type Row = Vec<(String, f64)>;

/// A cloud of the size of a person, with values as files store them (logits, logarithms, SH coefficients).
pub fn cloud(n: usize, degree: usize) -> Vec<Row> {
    let mut random = Random(4);
    let mut between = |low: f32, high: f32| f64::from(random.between(low, high));
    let rest = 3 * ((degree + 1) * (degree + 1) - 1);
    (0..n)
        .map(|_| {
            let mut row: Row = Vec::new();
            let mut put = |name: &str, value: f64| row.push((name.to_owned(), f64::from(value as f32)));
            put("x", between(-0.3, 0.3));
            put("y", between(0.0, 1.8));
            put("z", between(-0.2, 0.2));
            for axis in ["nx", "ny", "nz"] {
                put(axis, 0.0);
            }
            for c in 0..3 {
                put(&format!("f_dc_{c}"), between(-1.0, 1.5));
            }
            for i in 0..rest {
                put(&format!("f_rest_{i}"), between(-0.3, 0.3));
            }
            put("opacity", between(-1.0, 8.0));
            for c in 0..3 {
                put(&format!("scale_{c}"), between(-5.0, -3.5));
            }
            for c in 0..4 {
                put(&format!("rot_{c}"), between(-1.0, 1.0));
            }
            row
        })
        .collect()
}

/// Encoding of the numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Format {
    /// As text.
    Ascii,
    /// Floats in little-endian order.
    Little,
    /// Floats in big-endian order.
    Big,
    /// Doubles in little-endian order.
    Double,
}

/// A PLY file of these rows, in `format`, with `before` in the header ahead of the vertices and `prefix` in the body.
pub fn ply_bytes(rows: &[Row], format: Format, before: &str, prefix: &[u8]) -> Vec<u8> {
    let name = match format {
        Format::Ascii => "ascii",
        Format::Big => "binary_big_endian",
        Format::Little | Format::Double => "binary_little_endian",
    };
    let kind = if format == Format::Double { "double" } else { "float" };
    let mut bytes =
        format!("ply\nformat {name} 1.0\ncomment test\n{before}element vertex {}\n", rows.len()).into_bytes();
    for (property, _) in rows.first().into_iter().flatten() {
        bytes.extend(format!("property {kind} {property}\n").bytes());
    }
    bytes.extend(b"end_header\n");
    bytes.extend(prefix);
    for row in rows {
        for (_, value) in row {
            match format {
                Format::Ascii => bytes.extend(format!("{value} ").bytes()),
                Format::Little => bytes.extend((*value as f32).to_le_bytes()),
                Format::Big => bytes.extend((*value as f32).to_be_bytes()),
                Format::Double => bytes.extend(value.to_le_bytes()),
            }
        }
        if format == Format::Ascii {
            bytes.push(b'\n');
        }
    }
    bytes
}

/// A PLY of opaque grey balls of radius `e^scale` at these places.
pub fn balls(places: impl ExactSizeIterator<Item = [f32; 3]>, scale: f32) -> Vec<u8> {
    let names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
    let names = names.into_iter().chain(["rot_0", "rot_1", "rot_2", "rot_3"]);
    let properties: String = names.map(|name| format!("property float {name}\n")).collect();
    let count = places.len();
    let header =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n");
    let mut bytes = header.into_bytes();
    for [x, y, z] in places {
        let values = [x, y, z, 0.0, 0.0, 0.0, 2.0, scale, scale, scale, 1.0, 0.0, 0.0, 0.0];
        bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    }
    bytes
}
