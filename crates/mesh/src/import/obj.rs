//! Wavefront OBJ: polygons with several materials and textures, vertex colours.

use std::cell::Cell;
use std::collections::HashMap;
use std::path::Path;

use glam::{Vec2, Vec3};
use snapsnap_base::{FileError, file, quoted};
use tobj::{LoadError, LoadOptions};

use super::{MAX_BYTES, Textures, add_colors, beside};
use crate::mesh::{Face, Material, Mesh};

/// Longest line in bytes.
const MAX_LINE: usize = 1 << 20;
/// Largest share of vertices at the end of a file that no face uses.
const UNUSED: f64 = 0.05;

pub fn read(path: &Path) -> Result<Mesh, FileError> {
    let text = read_lossy(path)?;
    let wrong = |message: String| FileError::unsuitable(path, message);
    if let Some(row) = text.lines().position(|line| line.len() > MAX_LINE) {
        return Err(wrong(format!("line {}: longer than {MAX_LINE} bytes", row + 1)));
    }
    let failed = Cell::new(None);
    let fail = |e: FileError| {
        failed.set(Some(e));
        LoadError::MaterialParseError
    };
    let options =
        LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
    let mut rest = text.as_bytes();
    let loaded = tobj::load_obj_buf(&mut rest, &options, |name| {
        let file = beside(path, "material file", &name.to_string_lossy()).map_err(fail)?;
        read_materials(&file).map_err(fail)
    });
    let (models, materials) = loaded.map_err(|e| {
        // Errors about the whole file name its last line.
        let lines = text[..text.len() - rest.len()].lines().count();
        wrong(format!("line {}: {e}", lines.max(1)))
    })?;
    if let Some(e) = failed.take() {
        return Err(e);
    }
    check_whole(&text).map_err(wrong)?;
    let materials = materials.unwrap_or_default();
    // The parser ignores unknown names of materials.
    let mut used = text.lines().filter_map(|line| line.strip_prefix("usemtl ")).map(str::trim);
    let known = |name: &&str| materials.is_empty() || materials.iter().any(|m| m.name == **name);
    if let Some(name) = used.find(|name| !known(name)) {
        return Err(wrong(format!("its material `{}` is missing", quoted(name))));
    }

    let mut mesh = Mesh { materials: vec![Material::default()], ..Mesh::default() };
    let mut textures = Textures::new();
    for material in materials {
        let texture = material.diffuse_texture.as_deref().map(|name| textures.beside(path, file_name(name)));
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
        add_colors(&mut mesh, first as usize, colors);
        let material = model.material_id.map_or(0, |id| id as u32 + 1);
        let mut texcoords = model.texcoord_indices.as_chunks::<3>().0.iter();
        for rows in model.indices.as_chunks::<3>().0 {
            mesh.faces.push(Face {
                positions: rows.map(|row| row + first),
                texcoords: texcoords.next().map(|rows| rows.map(|row| row + first_texcoord)),
                material,
            });
        }
    }
    Ok(mesh)
}

/// Refuses a truncated file. Signs of truncation are:
/// * a last line without a line break,
/// * a face of fewer than three corners, which the parser takes for a line,
/// * many vertices at the end that belong to no face,
/// * a comment that counts more vertices or faces than the file contains.
fn check_whole(text: &str) -> Result<(), String> {
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
                    // Negative indices count from the end.
                    last = last.max(if row < 0 { counts.vertices + row + 1 } else { row });
                }
                if kind == "f" && corners < 3 {
                    let line = quoted(line);
                    return Err(format!("line {}, `{line}`: a face needs three corners", number + 1));
                }
                if kind == "f" {
                    counts.faces += 1;
                    counts.triangles += corners - 2;
                }
            }
            _ => {}
        }
    }
    // Old systems end a file with a control character.
    let text = text.trim_end_matches(['\0', '\u{1a}']);
    let end = text.lines().last().unwrap_or_default();
    let is_statement = !end.trim().is_empty() && !end.trim_start().starts_with('#');
    if counts.vertices > 0 && !text.ends_with('\n') && is_statement {
        return Err(format!(
            "its last line, `{}`, has no end: the file seems to be cut short (if it is whole, end it with a line break)",
            quoted(end)
        ));
    }
    counts.check()?;
    let (vertices, unused) = (counts.vertices, counts.vertices - last);
    if last > 0 && unused > 2 && unused as f64 > UNUSED * vertices as f64 {
        return Err(format!(
            "its last {unused} of {vertices} vertices belong to no face: the file seems to be cut short"
        ));
    }
    Ok(())
}

/// Numbers of an OBJ's statements, and the numbers that its comments promise.
#[derive(Default)]
struct Counts {
    vertices: i64,
    faces: i64,
    triangles: i64,
    /// Number and noun of each counting comment before the first vertex and face.
    promised: Vec<(i64, &'static str)>,
    /// Whether a comment counts points.
    has_points: bool,
}

impl Counts {
    /// Records a comment that contains only a count, as exporters write it: `# Vertices: 8`, `# 12 faces`, `# number
    /// of triangles: 12`, `#Vertex Count 8`. Comments after the first vertex or face count the preceding statements
    /// and are ignored.
    fn comment(&mut self, line: &str) {
        let Some(comment) = line.trim_start().strip_prefix('#') else { return };
        if self.vertices + self.faces > 0 || comment.len() > 80 {
            return;
        }
        let comment = comment.to_ascii_lowercase();
        let is_filler = |word: &&str| matches!(*word, "" | "total" | "number" | "of" | "count" | "num");
        let words = comment.split([' ', '\t', '\r', ':', '=']).filter(|word| !is_filler(word));
        let [a, b] = words.collect::<Vec<&str>>()[..] else { return };
        let (number, noun) = match (a.parse(), b.parse()) {
            (Ok(number), Err(_)) => (number, b),
            (Err(_), Ok(number)) => (number, a),
            _ => return,
        };
        match noun {
            "vertices" | "vertex" | "verts" => self.promised.push((number, "vertices")),
            "triangles" | "faces" | "face" => self.promised.push((number, "faces")),
            // Houdini calls vertices points, and corners of faces vertices.
            "points" => self.has_points = true,
            _ => {}
        }
    }

    /// Refuses a comment that counts more than the file contains.
    fn check(&self) -> Result<(), String> {
        for &(promised, noun) in &self.promised {
            let (found, most) = match noun {
                "vertices" if self.has_points => continue,
                "vertices" => (self.vertices, self.vertices),
                // Some exporters count polygons, others triangles.
                _ => (self.faces, self.faces.max(self.triangles)),
            };
            if promised > most {
                return Err(format!(
                    "a comment promises {promised} {noun}, there are {found}: the file seems to be cut short"
                ));
            }
        }
        Ok(())
    }
}

/// The file in a `map_Kd` statement, after its options (`-s 1 1 1 skin.png`).
fn file_name(statement: &str) -> &str {
    let is_number = |text| first_word(text).0.parse::<f32>().is_ok();
    let mut rest = statement.trim();
    while rest.starts_with('-') {
        let (option, values) = first_word(rest);
        // The values of an option are numbers or one word (on, off, a channel).
        if option == "-imfchan" || !is_number(values) {
            rest = first_word(values).1;
            continue;
        }
        rest = values;
        while is_number(rest) {
            rest = first_word(rest).1;
        }
    }
    rest
}

/// The first word, and the text after it.
fn first_word(text: &str) -> (&str, &str) {
    text.split_once(char::is_whitespace).map_or((text, ""), |(word, rest)| (word, rest.trim_start()))
}

/// Reads a text file. Invalid UTF-8 is replaced.
fn read_lossy(path: &Path) -> Result<String, FileError> {
    let bytes = file::read(path, MAX_BYTES).map_err(FileError::read(path))?;
    Ok(String::from_utf8(bytes).unwrap_or_else(|e| String::from_utf8_lossy(e.as_bytes()).into_owned()))
}

/// Reads names, colours and textures of materials. The reader in `tobj` fails on damaged files.
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
