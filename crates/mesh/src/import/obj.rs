//! Wavefront OBJ: polygons with several materials and textures, vertex colours.

use std::borrow::Cow;
use std::path::Path;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::{GrayImage, Rgba, RgbaImage};
use snapsnap_base::{FileError, file, quoted};

use super::glb_material::cut_out;
use super::{MAX_BYTES, MAX_TEXTURE, Textures, beside, triangles};
use crate::mesh::{Face, Material, Mesh};
use crate::picture::decode;

/// Longest line in bytes.
const MAX_LINE: usize = 1 << 20;
/// Largest share of vertices at the end of a file that no face uses.
const UNUSED: f64 = 0.05;

/// The statements of a file.
#[derive(Default)]
struct Statements {
    positions: Vec<Vec3>,
    colors: Vec<Option<Vec3>>,
    texcoords: Vec<Vec2>,
    /// Position and texture coordinate of all faces' corners.
    corners: Vec<(usize, Option<usize>)>,
    faces: Vec<Polygon>,
    /// Names after `usemtl`, and the line of each.
    used: Vec<(usize, String)>,
    /// The `mtllib` statements.
    libraries: Vec<String>,
    /// Number of vertices up to the last one that a face, a line or a point uses.
    last: usize,
    counts: Counts,
}

struct Polygon {
    line: usize,
    /// Number of corners.
    corners: usize,
    /// Number of `usemtl` statements before it.
    material: usize,
}

pub fn read(path: &Path) -> Result<Mesh, FileError> {
    let text = read_lossy(path)?;
    let wrong = |message: String| FileError::unsuitable(path, message);
    let mut read = Statements::default();
    for (number, line) in statements(&text) {
        read.add(number, &line).map_err(|e| match line.len() {
            0..=MAX_LINE => wrong(format!("line {number}, `{}`: {e}", quoted(&line))),
            _ => wrong(format!("line {number}: {e}")),
        })?;
    }
    read.check_whole(&text).map_err(wrong)?;
    let mut mesh = Mesh { materials: vec![Material::default()], ..Mesh::default() };
    let known = read.materials(path, &mut mesh)?;
    read.build(&known, &mut mesh).map_err(wrong)?;
    Ok(mesh)
}

/// Line numbers and statements. A statement goes on after a line that ends with a backslash.
fn statements(text: &str) -> impl Iterator<Item = (usize, Cow<'_, str>)> {
    let mut lines = (1..).zip(text.lines());
    std::iter::from_fn(move || {
        let (number, line) = lines.next()?;
        let mut whole = Cow::Borrowed(line.trim());
        while let Some(start) = whole.strip_suffix('\\').filter(|start| start.len() <= MAX_LINE) {
            let next = lines.next().map_or("", |(_, line)| line.trim());
            whole = Cow::Owned(format!("{start} {next}"));
        }
        Some((number, whole))
    })
}

impl Statements {
    fn add(&mut self, number: usize, line: &str) -> Result<(), String> {
        if line.len() > MAX_LINE {
            return Err(format!("longer than {MAX_LINE} bytes"));
        }
        self.counts.comment(line);
        let (word, rest) = first_word(line);
        // Names of files and materials may contain the sign of a comment.
        let values = rest.split_once('#').map_or(rest, |(values, _)| values);
        match word {
            "v" => {
                let values = numbers(values, 3).ok_or("no position")?;
                self.positions.push(Vec3::from_slice(&values));
                // After four or more numbers the fourth is a weight, and a seventh is the opacity.
                self.colors.push((values.len() >= 6).then(|| Vec3::from_slice(&values[3..])));
                self.counts.vertices += 1;
            }
            "vt" => {
                let values = numbers(values, 1).ok_or("no texture coordinates")?;
                self.texcoords.push(Vec2::new(values[0], values.get(1).copied().unwrap_or(0.0)));
            }
            "f" | "l" | "p" => {
                let corners = values.split_ascii_whitespace().map(|corner| self.corner(corner));
                let corners = corners.collect::<Option<Vec<_>>>().ok_or("no face")?;
                self.last = corners.iter().map(|(row, _)| row + 1).fold(self.last, usize::max);
                if word != "f" {
                    return Ok(());
                }
                if corners.len() < 3 {
                    return Err("a face needs three corners".into());
                }
                self.counts.faces += 1;
                self.counts.triangles += corners.len() as i64 - 2;
                self.faces.push(Polygon { line: number, corners: corners.len(), material: self.used.len() });
                self.corners.extend(corners);
            }
            "usemtl" => self.used.push((number, rest.to_owned())),
            "mtllib" => self.libraries.push(rest.to_owned()),
            _ => {}
        }
        Ok(())
    }

    /// Rows of the position and of the texture coordinate of a corner, as `7`, `7/3`, `7//2` or `7/3/2`. Negative
    /// numbers count from the end.
    fn corner(&self, text: &str) -> Option<(usize, Option<usize>)> {
        let row = |text: &str, count: usize| match text.parse::<i64>().ok()? {
            0 => None,
            row if row < 0 => count.checked_sub(row.unsigned_abs() as usize),
            row => Some(row as usize - 1),
        };
        let mut parts = text.split('/');
        let position = row(parts.next()?, self.positions.len())?;
        match parts.next().filter(|text| !text.is_empty()) {
            Some(text) => Some((position, Some(row(text, self.texcoords.len())?))),
            None => Some((position, None)),
        }
    }

    /// Reads the materials into `mesh`. Returns their names.
    fn materials(&self, path: &Path, mesh: &mut Mesh) -> Result<Vec<String>, FileError> {
        let mut files = Vec::new();
        for names in &self.libraries {
            // One name with spaces, or several names.
            match beside(path, "material file", names) {
                Ok(file) => files.push(file),
                Err(e) if !names.contains(char::is_whitespace) => return Err(e),
                Err(_) => {
                    for name in names.split_whitespace() {
                        files.push(beside(path, "material file", name)?);
                    }
                }
            }
        }
        let (mut known, mut textures) = (Vec::new(), Textures::default());
        for file in files {
            for Described { name, color, texture, opacity } in read_materials(&file)? {
                let texture = texture.map(|statement| textures.beside(path, file_name(&statement)));
                // Exporters leave the colour black or grey where a texture replaces it.
                let color = color.filter(|_| texture.is_none()).unwrap_or(Vec3::ONE);
                let color = color.clamp(Vec3::ZERO, Vec3::ONE);
                let opacity = opacity.map(|statement| cut_outs(path, file_name(&statement))).transpose()?;
                let (texture, opacity) = (texture.transpose()?, opacity.flatten());
                mesh.materials.push(Material { color, texture, opacity });
                known.push(name);
            }
        }
        Ok(known)
    }

    /// Makes triangles of the faces. `known` are the names of the mesh's materials after the first one.
    fn build(&self, known: &[String], mesh: &mut Mesh) -> Result<(), String> {
        let has_colors = self.colors.iter().any(Option::is_some);
        let mut materials = vec![0];
        for (line, name) in &self.used {
            let row = known.iter().rposition(|other| other == name);
            if row.is_none() && (!known.is_empty() || !has_colors) {
                let name = quoted(name);
                return Err(format!(
                    "line {line}: its material `{name}` is missing: no `mtllib` file describes it"
                ));
            }
            materials.push(row.map_or(0, |row| row as u32 + 1));
        }
        // Vertices without a face are left out: they are no part of the surface's size.
        let mut rows = vec![u32::MAX; self.positions.len()];
        let mut left = &self.corners[..];
        for Polygon { line, corners, material } in &self.faces {
            let (polygon, after) = left.split_at(*corners);
            left = after;
            let mut places = Vec::with_capacity(*corners);
            for (position, texcoord) in polygon {
                let missing = |what: &str, row: usize, count: usize| {
                    format!("line {line}: a face refers to {what} {}, there are {count}", row + 1)
                };
                let place = self.positions.get(*position);
                places.push(*place.ok_or_else(|| missing("vertex", *position, self.positions.len()))?);
                if let Some(row) = texcoord.filter(|row| *row >= self.texcoords.len()) {
                    return Err(missing("texture coordinate", row, self.texcoords.len()));
                }
                if rows[*position] == u32::MAX {
                    rows[*position] = mesh.positions.len() as u32;
                    mesh.positions.push(self.positions[*position]);
                    if has_colors {
                        mesh.colors.push(self.colors[*position].unwrap_or(Vec3::ONE));
                    }
                }
            }
            for triangle in triangles(&places) {
                let [a, b, c] = triangle.map(|i| polygon[i].1.map(|row| row as u32));
                mesh.faces.push(Face {
                    positions: triangle.map(|i| rows[polygon[i].0]),
                    texcoords: a.zip(b).zip(c).map(|((a, b), c)| [a, b, c]),
                    material: materials[*material],
                });
            }
        }
        mesh.texcoords.clone_from(&self.texcoords);
        Ok(())
    }

    /// Refuses a truncated file. Signs of truncation are:
    /// * a last line without a line break, unless comments count as many vertices and faces as there are,
    /// * many vertices at the end that belong to no face,
    /// * a comment that counts more vertices or faces than the file contains.
    fn check_whole(&self, text: &str) -> Result<(), String> {
        let are_all_there = self.counts.check()?;
        // Old systems end a file with a control character.
        let text = text.trim_end_matches(['\0', '\u{1a}']);
        let end = text.lines().last().unwrap_or_default();
        let is_statement = !end.trim().is_empty() && !end.trim_start().starts_with('#');
        if !self.positions.is_empty() && !text.ends_with('\n') && is_statement && !are_all_there {
            return Err(format!(
                "its last line, `{}`, has no end: the file seems to be cut short (if it is whole, end it with a line break)",
                quoted(end)
            ));
        }
        let count = self.positions.len();
        let unused = count.saturating_sub(self.last);
        if self.last > 0 && unused > 2 && unused as f64 > UNUSED * count as f64 {
            return Err(format!(
                "its last {unused} of {count} vertices belong to no face: the file seems to be cut short"
            ));
        }
        Ok(())
    }
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

    /// Refuses a comment that counts more than the file contains. Returns whether comments count exactly its vertices
    /// and faces.
    fn check(&self) -> Result<bool, String> {
        let mut exact = [false; 2];
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
            exact[usize::from(noun != "vertices")] |= promised == found || promised == most;
        }
        Ok(exact == [true; 2])
    }
}

/// The numbers in a text; `None` for fewer than `least` or for another word.
fn numbers(text: &str, least: usize) -> Option<Vec<f32>> {
    let numbers: Option<Vec<f32>> = text.split_ascii_whitespace().map(|word| word.parse().ok()).collect();
    numbers.filter(|numbers| numbers.len() >= least)
}

/// The file in a `map_Kd` statement, after its options (`-s 1 1 1 skin.png`).
fn file_name(statement: &str) -> &str {
    let is_number = |text| first_word(text).0.parse::<f32>().is_ok();
    let mut rest = statement.trim();
    while rest.starts_with('-') {
        let (option, values) = first_word(rest);
        // The values of an option are numbers or one word (on, off, a channel).
        let has_numbers = option != "-imfchan" && is_number(values);
        rest = first_word(values).1;
        while has_numbers && is_number(rest) {
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

/// 0 where the surface is cut out by the picture in a `map_d` statement: where its alpha, or without alpha its
/// brightness, is below ½.
fn cut_outs(owner: &Path, name: &str) -> Result<Option<Arc<GrayImage>>, FileError> {
    let mut picture = decode(&beside(owner, "texture", name)?, MAX_TEXTURE)?;
    if !picture.color().has_alpha() {
        let brightness = picture.into_luma8();
        let mask = |x, y| Rgba([0, 0, 0, brightness.get_pixel(x, y)[0]]);
        picture = RgbaImage::from_fn(brightness.width(), brightness.height(), mask).into();
    }
    Ok(cut_out(&picture, 1.0, 0.5))
}

/// A material of an MTL file.
#[derive(Default)]
struct Described {
    name: String,
    color: Option<Vec3>,
    /// The text after `map_Kd`.
    texture: Option<String>,
    /// The text after `map_d`.
    opacity: Option<String>,
}

/// Reads names, colours and textures of materials.
fn read_materials(path: &Path) -> Result<Vec<Described>, FileError> {
    let text = read_lossy(path)?;
    let mut materials: Vec<Described> = Vec::new();
    for (number, line) in statements(&text) {
        let (word, rest) = first_word(&line);
        match (&*word.to_ascii_lowercase(), materials.last_mut()) {
            ("newmtl", _) => materials.push(Described { name: rest.to_owned(), ..Described::default() }),
            ("kd", Some(material)) => {
                // One number is a grey.
                let color = numbers(rest, 1).and_then(|values| match values[..] {
                    [grey] => Some(Vec3::splat(grey)),
                    [red, green, blue, ..] => Some(Vec3::new(red, green, blue)),
                    _ => None,
                });
                let message = || format!("line {number}, `{}`: no colour", quoted(&line));
                let color = color.filter(|color| color.is_finite());
                material.color = Some(color.ok_or_else(|| FileError::unsuitable(path, message()))?);
            }
            ("map_kd", Some(material)) => material.texture = Some(rest.to_owned()),
            ("map_d", Some(material)) => material.opacity = Some(rest.to_owned()),
            _ => {}
        }
    }
    Ok(materials)
}
