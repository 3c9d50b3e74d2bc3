//! Gaussians in a binary glTF, as the extension `KHR_gaussian_splatting` stores them: points whose attributes are
//! activated values and SH coefficients. Viewers without the extension draw the points in `COLOR_0`.
//!
//! The axes are x right, y up, z back, as in the world frame; nothing is rotated. Layout: glTF 2.0, section 4.4
//! (GLB), and the extension's README (github.com/KhronosGroup/glTF, `extensions/2.0/Khronos/KHR_gaussian_splatting`).

use std::io::{self, Read, Write};

use serde_json::{Map, Value, json};
use snapsnap_base::quoted;

use crate::sh;
use crate::stored::{COEFFICIENTS, MIN_SCALE, Problem, Stored, logit, opacity, unit};

/// First bytes of a file.
pub(crate) const MAGIC: [u8; 2] = *b"gl";
const EXTENSION: &str = "KHR_gaussian_splatting";
const GLTF: u32 = 0x4654_6c67;
const JSON: u32 = 0x4e4f_534a;
const BINARY: u32 = 0x004e_4942;
/// Component types.
const BYTE: u32 = 5121;
const FLOAT: u32 = 5126;
/// Largest file in bytes: lengths have 32 bits.
const MAX_LENGTH: u64 = u32::MAX as u64;
/// Largest JSON chunk that is read, in bytes. Written ones have four kilobytes.
const MAX_JSON: u32 = 16 << 20;
/// Largest deviation of a node's transform from the identity, per number.
const MOVED: f64 = 1e-9;

/// Names of the attributes, their types, and the columns of [`Stored`] in their order.
fn attributes(stored: &Stored) -> Vec<(String, &'static str, Vec<&[f32]>)> {
    let columns = |rows: &[usize]| rows.iter().map(|row| &*stored.columns[*row]).collect();
    let named = |name: &str| format!("{EXTENSION}:{name}");
    let mut all = vec![
        ("POSITION".into(), "VEC3", columns(&[0, 1, 2])),
        // glTF's quaternions end with w.
        (named("ROTATION"), "VEC4", columns(&[4, 5, 6, 3])),
        (named("SCALE"), "VEC3", columns(&[7, 8, 9])),
        (named("OPACITY"), "SCALAR", columns(&[10])),
    ];
    for band in 0..stored.coefficients {
        let bands = (0..3).map(|channel| stored.band(band, channel)).collect();
        all.push((named(&coefficient(band)), "VEC3", bands));
    }
    all
}

/// The name of SH coefficient number `band`.
fn coefficient(band: usize) -> String {
    let degree = band.isqrt();
    format!("SH_DEGREE_{degree}_COEF_{}", band - degree * degree)
}

/// The reason why a GLB cannot contain the Gaussians, if there is one.
pub(crate) fn check(stored: &Stored) -> Result<(), String> {
    let bytes = 4 * stored.len() as u64 * (stored.columns.len() as u64 + 1) + (1 << 16);
    if stored.is_empty() {
        return Err("a GLB has one Gaussian at least".into());
    }
    if stored.columns[7..10].iter().flatten().any(|log| !log.exp().is_finite()) {
        return Err("a scale is too large for a GLB".into());
    }
    if bytes > MAX_LENGTH {
        return Err(format!(
            "{} Gaussians take {} MB; a GLB has 4294 at most",
            stored.len(),
            bytes / 1_000_000
        ));
    }
    Ok(())
}

/// Writes a GLB of Gaussians that [`check`] accepts.
pub(crate) fn write(stored: &Stored, out: &mut impl Write) -> io::Result<()> {
    let n = stored.len();
    let attributes = attributes(stored);
    let (mut views, mut accessors, mut names, mut at) = (Vec::new(), Vec::new(), Map::new(), 0);
    let mut add = |name: &str, kind: &str, component: u32, size: usize| {
        names.insert(name.into(), json!(accessors.len()));
        views.push(json!({"buffer": 0, "byteOffset": at, "byteLength": size * n, "target": 34962}));
        accessors.push(
            json!({"bufferView": accessors.len(), "componentType": component, "count": n, "type": kind}),
        );
        at += size * n;
    };
    for (name, kind, columns) in &attributes {
        add(name, kind, FLOAT, 4 * columns.len());
    }
    add("COLOR_0", "VEC4", BYTE, 4);
    let limit =
        |of: fn(f32, f32) -> f32| [0, 1, 2].map(|axis| stored.columns[axis].iter().copied().reduce(of));
    (accessors[0]["min"], accessors[0]["max"]) = (json!(limit(f32::min)), json!(limit(f32::max)));
    let last = accessors.len() - 1;
    accessors[last]["normalized"] = json!(true);
    let splats = json!({
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance",
    });
    let json = json!({
        "asset": {"version": "2.0", "generator": "snapsnap"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": names, "mode": 0, "extensions": {EXTENSION: splats}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": at}],
    });
    let mut json = serde_json::to_vec(&json)?;
    json.resize(json.len().next_multiple_of(4), b' ');
    let words = [GLTF, 2, (28 + json.len() + at) as u32, json.len() as u32, JSON];
    words.iter().try_for_each(|word| out.write_all(&word.to_le_bytes()))?;
    out.write_all(&json)?;
    [at as u32, BINARY].iter().try_for_each(|word| out.write_all(&word.to_le_bytes()))?;
    for (name, _, columns) in &attributes {
        let activate: fn(f32) -> f32 = match name.rsplit(':').next() {
            Some("SCALE") => f32::exp,
            Some("OPACITY") => opacity,
            _ => |value| value,
        };
        let is_rotation = name.ends_with("ROTATION");
        for i in 0..n {
            let mut values: Vec<f32> = columns.iter().map(|column| activate(column[i])).collect();
            if is_rotation {
                let [w, x, y, z] = unit([values[3], values[0], values[1], values[2]]);
                values = vec![x, y, z, w];
            }
            values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))?;
        }
    }
    for i in 0..n {
        let color = |channel: usize| linear_light(0.5 + sh::C0 * stored.band(0, channel)[i]);
        let color = [color(0), color(1), color(2), opacity(stored.columns[10][i])];
        out.write_all(&color.map(|value| (255.0 * value).round() as u8))?;
    }
    Ok(())
}

/// Linear light of an sRGB value, which is clamped to [0, 1] (IEC 61966-2-1).
pub fn linear_light(shown: f32) -> f32 {
    let shown = shown.clamp(0.0, 1.0);
    if shown <= 0.04045 { shown / 12.92 } else { ((shown + 0.055) / 1.055).powf(2.4) }
}

/// Reads a file of `length` bytes: its only primitive with the extension, with float attributes and unmoved nodes.
pub(crate) fn read(mut input: impl Read, length: u64) -> Result<Stored, Problem> {
    let mut word = || {
        let mut bytes = [0; 4];
        input.read_exact(&mut bytes).map_err(|_| "the file ends within its header".to_owned())?;
        Ok::<u32, String>(u32::from_le_bytes(bytes))
    };
    let [magic, version, all, size, kind] = [word()?, word()?, word()?, word()?, word()?];
    if magic != GLTF || version != 2 || kind != JSON || size > MAX_JSON {
        return Err("no binary glTF of version 2".to_owned().into());
    }
    if u64::from(all) > length {
        return Err(format!("the file ends after {length} of {all} bytes").into());
    }
    let mut json = vec![0; size as usize];
    input.read_exact(&mut json).map_err(|_| "the file ends within its JSON".to_owned())?;
    let json: Value = serde_json::from_slice(&json).map_err(|e| format!("its JSON: {e}"))?;
    let mut binary = Vec::new();
    input.take(u64::from(all)).read_to_end(&mut binary)?;
    let header = binary.first_chunk::<8>().filter(|header| header[4..] == BINARY.to_le_bytes());
    header.ok_or("it has no binary part".to_owned())?;
    Ok(File { json, binary: &binary[8..] }.gaussians()?)
}

struct File<'a> {
    json: Value,
    binary: &'a [u8],
}

impl File<'_> {
    fn gaussians(&self) -> Result<Stored, String> {
        let list = |name: &str| self.json[name].as_array().map(Vec::as_slice).unwrap_or_default();
        let with_splats = list("meshes").iter().enumerate().flat_map(|(mesh, value)| {
            let primitives = value["primitives"].as_array().map(Vec::as_slice).unwrap_or_default();
            primitives.iter().filter(|p| p["extensions"].get(EXTENSION).is_some()).map(move |p| (mesh, p))
        });
        let found: Vec<(usize, &Value)> = with_splats.collect();
        let (mesh, primitive) = match found[..] {
            [] => return Err(format!("it has no Gaussians ({EXTENSION})")),
            [one] => one,
            [..] => {
                let count = found.len();
                return Err(format!("it has {count} primitives with {EXTENSION}; files with one are read"));
            }
        };
        let told = &primitive["extensions"][EXTENSION];
        if told["extensions"].is_object() {
            return Err("its Gaussians are compressed by another extension".into());
        }
        let shown = |value: &Value| value.as_str().map_or_else(|| value.to_string(), quoted);
        // The specification gives defaults to the last two.
        for (name, value, has_default) in [
            ("kernel", "ellipse", false),
            ("colorSpace", "srgb_rec709_display", false),
            ("projection", "perspective", true),
            ("sortingMethod", "cameraDistance", true),
        ] {
            if told[name] != json!(value) && !(has_default && told[name].is_null()) {
                let found = shown(&told[name]);
                return Err(format!("its Gaussians have the `{name}` {found}; only {value} is read"));
            }
        }
        if primitive["mode"] != json!(0) || !primitive["indices"].is_null() || primitive["targets"].is_array()
        {
            return Err("its Gaussians are no plain points (`mode` 0 without `indices` and `targets`)".into());
        }
        if list("buffers").first().is_none_or(|buffer| !buffer["uri"].is_null()) {
            return Err("its Gaussians are outside of the file, which is not read".into());
        }
        if let Some(other) = list("extensionsRequired").iter().find(|name| **name != json!(EXTENSION)) {
            return Err(format!("it requires {}, which is not read", shown(other)));
        }
        let nodes = list("nodes").iter().filter(|node| node["mesh"] == json!(mesh)).count();
        if nodes != 1 {
            return Err(format!(
                "its Gaussians are placed {nodes} times; files that place them once are read"
            ));
        }
        if list("nodes").iter().any(is_moved) {
            return Err("one of its nodes is moved, turned or scaled, which is not read".into());
        }
        let attributes = &primitive["attributes"];
        let named = |name: &str| format!("{EXTENSION}:{name}");
        let read = |name: &str, size: usize| self.floats(&attributes[name], name, size);
        let positions = read("POSITION", 3)?;
        let n = positions.len() / 3;
        let there = (0..16).take_while(|band| attributes.get(named(&coefficient(*band))).is_some()).count();
        let Some(&coefficients) = COEFFICIENTS.iter().rev().find(|count| **count <= there) else {
            return Err(format!("its Gaussians have no {}", named(&coefficient(0))));
        };
        let mut columns = Vec::with_capacity(Stored::COLUMNS.len() + 3 * (coefficients - 1));
        let mut add = |values: &[f32], size: usize, order: &[usize], f: fn(f32) -> f32| {
            columns.extend(
                order
                    .iter()
                    .map(|c| values.iter().skip(*c).step_by(size).map(|v| f(*v)).collect::<Vec<f32>>()),
            );
        };
        add(&positions, 3, &[0, 1, 2], |v| v);
        add(&read(&named("ROTATION"), 4)?, 4, &[3, 0, 1, 2], |v| v);
        let log = |v: f32| if v < MIN_SCALE { MIN_SCALE.ln() } else { v.ln() };
        add(&read(&named("SCALE"), 3)?, 3, &[0, 1, 2], log);
        add(&read(&named("OPACITY"), 1)?, 1, &[0], logit);
        let bands: Result<Vec<Vec<f32>>, String> =
            (0..coefficients).map(|band| read(&named(&coefficient(band)), 3)).collect();
        let bands = bands?;
        add(&bands[0], 3, &[0, 1, 2], |v| v);
        for channel in 0..3 {
            bands[1..].iter().for_each(|band| add(band, 3, &[channel], |v| v));
        }
        if let Some(column) = columns.iter().position(|column| column.len() != n) {
            let name = Stored::COLUMNS.get(column).unwrap_or(&"f_rest");
            return Err(format!("{} values of `{name}` for {n} Gaussians", columns[column].len()));
        }
        Ok(Stored { coefficients, columns })
    }

    /// The values of an attribute with `size` floats per Gaussian.
    fn floats(&self, accessor: &Value, name: &str, size: usize) -> Result<Vec<f32>, String> {
        let bad = |what: &str| format!("its attribute {name} {what}");
        let entry = |list: &str, row: &Value| {
            let row = usize::try_from(row.as_u64()?).ok()?;
            self.json[list].get(row)
        };
        let accessor = entry("accessors", accessor).ok_or_else(|| bad("is missing"))?;
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][size - 1];
        if accessor["componentType"] != json!(FLOAT)
            || accessor["type"] != json!(kind)
            || accessor["sparse"].is_object()
        {
            return Err(bad(&format!("is no {kind} of floats; others are not read")));
        }
        let view = entry("bufferViews", &accessor["bufferView"]).ok_or_else(|| bad("has no buffer view"))?;
        let number = |value: &Value, default: u64| match value {
            Value::Null => Some(default),
            value => value.as_u64(),
        };
        let place = || {
            let first = number(&view["byteOffset"], 0)?.checked_add(number(&accessor["byteOffset"], 0)?)?;
            let stride = number(&view["byteStride"], 4 * size as u64)?;
            let count = accessor["count"].as_u64()?;
            let end = first
                .checked_add(count.checked_sub(1)?.checked_mul(stride)?)?
                .checked_add(4 * size as u64)?;
            let limit = number(&view["byteOffset"], 0)?.checked_add(view["byteLength"].as_u64()?)?;
            let inside = end <= limit.min(self.binary.len() as u64)
                && stride >= 4 * size as u64
                && view["buffer"] == json!(0)
                && view["extensions"].is_null();
            inside.then_some((first as usize, stride as usize, count as usize))
        };
        let (first, stride, count) = place().ok_or_else(|| bad("is empty, or lies outside of the file"))?;
        let value = |at: usize| f32::from_le_bytes(self.binary[at..at + 4].try_into().expect("four bytes"));
        Ok((0..count).flat_map(|i| (0..size).map(move |c| first + i * stride + 4 * c)).map(value).collect())
    }
}

/// Whether a node has a transform other than the identity.
fn is_moved(node: &Value) -> bool {
    let differs = |name: &str, identity: &[f64]| match node[name].as_array() {
        None => !node[name].is_null(),
        Some(values) => {
            values.len() != identity.len()
                || values.iter().zip(identity).any(|(v, i)| v.as_f64().is_none_or(|v| (v - i).abs() > MOVED))
        }
    };
    let matrix: Vec<f64> = (0..16).map(|i| f64::from(u8::from(i % 5 == 0))).collect();
    differs("matrix", &matrix)
        || differs("translation", &[0.0; 3])
        || differs("rotation", &[0.0, 0.0, 0.0, 1.0])
        || differs("scale", &[1.0; 3])
}
