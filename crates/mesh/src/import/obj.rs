//! Wavefront OBJ: polygons with several materials and textures, vertex colours.

use std::cell::Cell;
use std::collections::HashMap;
use std::io::{self, BufRead, Read};
use std::path::Path;

use glam::{Vec2, Vec3};
use snapsnap_base::{file, quoted};
use tobj::{LoadError, LoadOptions};

use super::{MAX_BYTES, Textures, beside};
use crate::mesh::{Face, Material, Mesh};
use snapsnap_base::FileError;

/// Longest line; a face of a scan has a handful of corners.
const MAX_LINE: usize = 1 << 20;
/// Share of the vertices, the last ones, that may belong to no face: files that were cut short have many.
const UNUSED: f64 = 0.05;

pub fn read(path: &Path) -> Result<Mesh, FileError> {
    let text = read_lossy(path)?;
    let line = Cell::new(0);
    let mut lines = Lines { source: text.as_bytes(), line: &line, length: 0 };
    let failed = Cell::new(None);
    let fail = |e: FileError| {
        failed.set(Some(e));
        LoadError::MaterialParseError
    };
    let options =
        LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
    let loaded = tobj::load_obj_buf(&mut lines, &options, |name| {
        let name = name.to_string_lossy();
        let file = beside(path, &name).ok_or_else(|| {
            let message = format!("its material file `{}` is missing", quoted(&name));
            fail(FileError::unsuitable(path, message))
        })?;
        read_materials(&file).map_err(fail)
    });
    let (models, materials) = loaded.map_err(|e| {
        // The line is the one that was read last; what is wrong with the whole shows at the end.
        FileError::unsuitable(path, format!("line {}: {e}", line.get().max(1)))
    })?;
    if let Some(e) = failed.take() {
        return Err(e);
    }
    check_whole(path, &text)?;
    let materials = materials.unwrap_or_default();
    // The parser takes unknown names for no material at all.
    let mut used = text.lines().filter_map(|line| line.strip_prefix("usemtl ")).map(str::trim);
    let known = |name: &&str| materials.is_empty() || materials.iter().any(|m| m.name == **name);
    if let Some(name) = used.find(|name| !known(name)) {
        return Err(FileError::unsuitable(path, format!("its material `{}` is missing", quoted(name))));
    }

    let mut mesh = Mesh { materials: vec![Material::default()], ..Mesh::default() };
    let mut textures = Textures::of(path);
    for material in materials {
        let texture = material.diffuse_texture.as_deref().map(|name| textures.load(file_name(name)));
        let color = match (&texture, material.diffuse) {
            // Exporters leave the colour black or grey where a texture replaces it.
            (Some(_), _) | (None, None) => Vec3::ONE,
            (None, Some(color)) => Vec3::from_array(color).clamp(Vec3::ZERO, Vec3::ONE),
        };
        mesh.materials.push(Material { color, texture: texture.transpose()? });
    }
    for model in models {
        let model = model.mesh;
        let (first, first_texcoord) = (mesh.positions.len() as u32, mesh.texcoords.len() as u32);
        mesh.positions.extend(model.positions.chunks_exact(3).map(Vec3::from_slice));
        mesh.texcoords.extend(model.texcoords.chunks_exact(2).map(Vec2::from_slice));
        let colors = model.vertex_color.chunks_exact(3).map(Vec3::from_slice);
        if !model.vertex_color.is_empty() || !mesh.colors.is_empty() {
            mesh.colors.resize(first as usize, Vec3::ONE);
            mesh.colors.extend(colors);
            mesh.colors.resize(mesh.positions.len(), Vec3::ONE);
        }
        let corner = |rows: &[u32], first: u32| [rows[0] + first, rows[1] + first, rows[2] + first];
        let material = model.material_id.map_or(0, |id| id as u32 + 1);
        for (index, rows) in model.indices.chunks_exact(3).enumerate() {
            let texcoords = model.texcoord_indices.get(3 * index..3 * index + 3);
            mesh.faces.push(Face {
                positions: corner(rows, first),
                texcoords: texcoords.map(|rows| corner(rows, first_texcoord)),
                material,
            });
        }
    }
    Ok(mesh)
}

/// Refuses what is left of a file that was cut: a last line without an end; a face of fewer than three corners, which the
/// parser takes for a line; vertices at the end that no face refers to any more; fewer vertices or faces than a comment
/// says.
fn check_whole(path: &Path, text: &str) -> Result<(), FileError> {
    let wrong = |message: String| FileError::unsuitable(path, message);
    let mut counts = Counts::default();
    let mut last = 0_i64;
    for (number, line) in text.lines().enumerate() {
        counts.comment(line);
        let mut words = line.split_ascii_whitespace().take_while(|word| !word.starts_with('#'));
        match words.next() {
            Some("v") => counts.vertices += 1,
            Some(kind @ ("f" | "l" | "p")) => {
                let mut corners = 0;
                for word in words {
                    corners += 1;
                    let row: i64 = word.split('/').next().and_then(|row| row.parse().ok()).unwrap_or(0);
                    // Negative numbers count from the end.
                    last = last.max(if row < 0 { counts.vertices + row + 1 } else { row });
                }
                if kind == "f" && corners < 3 {
                    let message =
                        format!("line {}, `{}`: a face needs three corners", number + 1, quoted(line));
                    return Err(wrong(message));
                }
                if kind == "f" {
                    counts.faces += 1;
                    counts.triangles += corners - 2;
                }
            }
            _ => {}
        }
    }
    // Old systems end a file with a character of its own.
    let text = text.trim_end_matches(['\0', '\u{1a}']);
    let end = text.lines().last().unwrap_or_default();
    if counts.vertices > 0
        && !text.ends_with('\n')
        && !end.trim().is_empty()
        && !end.trim_start().starts_with('#')
    {
        let message = format!(
            "its last line, `{}`, has no end: the file seems to be cut short (if it is whole, end it with a line break)",
            quoted(end)
        );
        return Err(wrong(message));
    }
    if let Some(message) = counts.missing() {
        return Err(wrong(message));
    }
    let (vertices, unused) = (counts.vertices, counts.vertices - last);
    if last > 0 && unused > 2 && unused as f64 > UNUSED * vertices as f64 {
        let message = format!(
            "its last {unused} of {vertices} vertices belong to no face: the file seems to be cut short"
        );
        return Err(wrong(message));
    }
    Ok(())
}

/// What an OBJ holds, and what its own comments say that it holds.
#[derive(Default)]
struct Counts {
    vertices: i64,
    faces: i64,
    triangles: i64,
    /// What comments before the first vertex and the first face say: number and noun.
    promised: Vec<(i64, &'static str)>,
    /// Whether a comment counts points.
    has_points: bool,
}

impl Counts {
    /// Takes note of comments that count and say nothing else, as exporters write them: `# Vertices: 8`, `# 12 faces`,
    /// `# number of triangles: 12`, `#Vertex Count 8`. Behind the first vertex or face they count what stands before
    /// them, which is there.
    fn comment(&mut self, line: &str) {
        let Some(comment) = line.trim_start().strip_prefix('#') else { return };
        if self.vertices + self.faces > 0 || comment.len() > 80 {
            return;
        }
        let comment = comment.to_ascii_lowercase();
        let is_filler = |word: &&str| !matches!(*word, "" | "total" | "number" | "of" | "count" | "num");
        let words: Vec<&str> = comment.split([' ', '\t', '\r', ':', '=']).filter(is_filler).collect();
        let (number, noun) = match words[..] {
            [a, b] => match (a.parse::<i64>(), b.parse::<i64>()) {
                (Ok(number), Err(_)) => (number, b),
                (Err(_), Ok(number)) => (number, a),
                _ => return,
            },
            _ => return,
        };
        let noun = match noun {
            "vertices" | "vertex" | "verts" => "vertices",
            "triangles" | "faces" | "face" => "faces",
            // Houdini calls positions so, and corners of faces vertices.
            "points" => {
                self.has_points = true;
                return;
            }
            _ => return,
        };
        self.promised.push((number, noun));
    }

    /// The first comment that counts more than there is.
    fn missing(&self) -> Option<String> {
        let found = |noun: &str| match noun {
            "vertices" if self.has_points => i64::MAX,
            "vertices" => self.vertices,
            // Some count polygons as triangles.
            _ => self.faces.max(self.triangles),
        };
        let (promised, noun) = self.promised.iter().find(|(number, noun)| *number > found(noun))?;
        let found = if *noun == "vertices" { self.vertices } else { self.faces };
        Some(format!(
            "a comment promises {promised} {noun}, there are {found}: the file seems to be cut short"
        ))
    }
}

/// The file in a `map_Kd` statement, behind its options (`-s 1 1 1 skin.png`).
fn file_name(statement: &str) -> &str {
    let mut rest = statement.trim();
    while rest.starts_with('-') {
        let mut words = rest.split_ascii_whitespace();
        let option = words.next().unwrap_or_default();
        let after = |words: usize| {
            let mut rest = rest;
            for _ in 0..words {
                rest = rest.trim_start().split_once(char::is_whitespace).map_or("", |(_, rest)| rest);
            }
            rest.trim_start()
        };
        let numbers = words.take_while(|word| word.parse::<f32>().is_ok()).count();
        // Options take numbers or one word (on, off, a channel).
        rest = after(1 + if option == "-imfchan" || numbers == 0 { 1 } else { numbers });
    }
    rest
}

/// A text file; bytes that are no UTF-8, as in names from elsewhere, are replaced.
fn read_lossy(path: &Path) -> Result<String, FileError> {
    let bytes = file::read(path, MAX_BYTES).map_err(FileError::read(path))?;
    Ok(String::from_utf8(bytes).unwrap_or_else(|e| String::from_utf8_lossy(e.as_bytes()).into_owned()))
}

/// Names, colours and textures of materials; the parser of OBJ files stumbles over damaged ones.
fn read_materials(path: &Path) -> Result<(Vec<tobj::Material>, HashMap<String, usize>), FileError> {
    let text = read_lossy(path)?;
    let mut materials: Vec<tobj::Material> = Vec::new();
    for (number, line) in text.lines().map(str::trim).enumerate() {
        let (word, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        match (word, materials.last_mut()) {
            ("newmtl", _) => {
                materials.push(tobj::Material { name: rest.trim().to_owned(), ..Default::default() });
            }
            ("Kd", Some(material)) => {
                let numbers: Vec<f32> = rest.split_whitespace().map_while(|n| n.parse().ok()).collect();
                let color = numbers.try_into().ok().filter(|c: &[f32; 3]| c.iter().all(|v| v.is_finite()));
                material.diffuse = Some(color.ok_or_else(|| {
                    let message = format!("line {}, `{}`: no colour", number + 1, quoted(line));
                    FileError::unsuitable(path, message)
                })?);
            }
            ("map_Kd", Some(material)) => material.diffuse_texture = Some(rest.trim().to_owned()),
            _ => {}
        }
    }
    let rows = materials.iter().enumerate().map(|(row, m)| (m.name.clone(), row)).collect();
    Ok((materials, rows))
}

/// Counts the lines that were begun, and refuses those that never end.
struct Lines<'a> {
    source: &'a [u8],
    line: &'a Cell<usize>,
    /// Bytes of the line that is being read.
    length: usize,
}

impl Read for Lines<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.source.read(buffer)
    }
}

impl BufRead for Lines<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.length > MAX_LINE {
            return Err(io::Error::other("a line without an end"));
        }
        Ok(self.source)
    }

    fn consume(&mut self, amount: usize) {
        if self.length == 0 && amount > 0 {
            self.line.set(self.line.get() + 1);
        }
        // `lines` consumes up to a line's end and no further.
        let ended = self.source[..amount].ends_with(b"\n");
        self.length = if ended { 0 } else { self.length + amount };
        self.source.consume(amount);
    }
}
