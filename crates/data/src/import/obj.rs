//! Wavefront OBJ: polygons with several materials and textures, vertex colours.

use std::cell::Cell;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

use glam::{Vec2, Vec3};
use snapsnap_splat::quoted;
use tobj::{LoadError, LoadOptions};

use super::{Textures, beside};
use crate::DataError;
use crate::mesh::{Face, Material, Mesh};

/// Longest line; a face of a scan has a handful of corners.
const MAX_LINE: usize = 1 << 20;

pub fn read(path: &Path) -> Result<Mesh, DataError> {
    let file = File::open(path).map_err(DataError::read(path))?;
    let line = Cell::new(0);
    let mut lines = Lines { source: BufReader::new(file), line: &line, length: 0 };
    let missing = Cell::new(None);
    let options =
        LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
    let loaded = tobj::load_obj_buf(&mut lines, &options, |name| {
        let Some(file) = beside(path, &name.to_string_lossy()) else {
            missing.set(Some(format!("its material file `{}` is missing", quoted(&name.to_string_lossy()))));
            return Err(LoadError::OpenFileFailed);
        };
        tobj::load_mtl(&file).map_err(|e| {
            missing.set(Some(format!("its material file {}: {e}", file.display())));
            e
        })
    });
    let (models, materials) = loaded.map_err(|e| {
        // The line is the one that was read last; what is wrong with the whole shows at the end.
        DataError::unsuitable(path, format!("line {}: {e}", line.get().max(1)))
    })?;
    if let Some(problem) = missing.take() {
        return Err(DataError::unsuitable(path, problem));
    }

    let mut mesh = Mesh { materials: vec![Material::default()], ..Mesh::default() };
    let mut textures = Textures::of(path);
    for material in materials.unwrap_or_default() {
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

/// Counts the lines that were begun, and refuses those that never end.
struct Lines<'a> {
    source: BufReader<File>,
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
        self.source.fill_buf()
    }

    fn consume(&mut self, amount: usize) {
        if self.length == 0 && amount > 0 {
            self.line.set(self.line.get() + 1);
        }
        // `lines` consumes up to a line's end and no further.
        let ended = self.source.buffer()[..amount].ends_with(b"\n");
        self.length = if ended { 0 } else { self.length + amount };
        self.source.consume(amount);
    }
}
