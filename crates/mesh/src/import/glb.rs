//! Binary glTF 2.0: every triangle of the default scene, in its node's place, with its base colour.

use std::collections::{HashMap, HashSet};
use std::fmt::Display;
use std::path::Path;
use std::sync::Arc;

use glam::{Mat4, Vec2, Vec3};
use gltf::accessor::{DataType, Dimensions};
use gltf::mesh::Mode;
use gltf::{Accessor, Document, Node, Primitive, image::Source};
use image::RgbImage;
use serde_json::Value;
use snapsnap_base::file;

use super::{MAX_BYTES, Room};

use crate::mesh::{Face, Material, Mesh};
use crate::picture::decode_bytes;
use snapsnap_base::FileError;

/// Deepest nesting of nodes.
const MAX_DEPTH: usize = 256;

/// Most positions and corners of faces that nodes may add which show a mesh once more.
const MAX_ELEMENTS: usize = 10_000_000;

/// What an attribute may be stored as.
struct Kind {
    name: &'static str,
    types: &'static [DataType],
    dimensions: &'static [Dimensions],
}

const SHARES: &[DataType] = &[DataType::U8, DataType::U16, DataType::F32];
const POSITIONS: Kind = Kind { name: "positions", types: &[DataType::F32], dimensions: &[Dimensions::Vec3] };
const TEXCOORDS: Kind = Kind { name: "texture coordinates", types: SHARES, dimensions: &[Dimensions::Vec2] };
const COLORS: Kind =
    Kind { name: "colours", types: SHARES, dimensions: &[Dimensions::Vec3, Dimensions::Vec4] };
const INDICES: Kind = Kind {
    name: "indices",
    types: &[DataType::U8, DataType::U16, DataType::U32],
    dimensions: &[Dimensions::Scalar],
};

pub fn read(path: &Path) -> Result<Mesh, FileError> {
    let bytes = file::read(path, MAX_BYTES).map_err(FileError::read(path))?;
    let invalid = |e: &dyn Display| FileError::unsuitable(path, format!("is no valid GLB: {e}"));
    check_references(&bytes).map_err(|e| invalid(&e))?;
    let gltf::Gltf { document, blob } = gltf::Gltf::from_slice(&bytes).map_err(|e| invalid(&e))?;
    drop(bytes);
    let mut file = File {
        path,
        blob: blob.unwrap_or_default(),
        mesh: Mesh::default(),
        textures: HashMap::new(),
        room: Room::new(),
        nodes_left: document.nodes().len(),
        places: Vec::new(),
        shown: HashSet::new(),
        elements: 0,
    };
    file.add(&document)?;
    Ok(file.mesh)
}

/// Refuses references to nothing that the parser follows before it looks.
fn check_references(bytes: &[u8]) -> Result<(), String> {
    let glb;
    let json = if bytes.starts_with(b"glTF") {
        glb = gltf::Glb::from_slice(bytes).map_err(|e| e.to_string())?;
        &glb.json[..]
    } else {
        bytes
    };
    let json: Value = serde_json::from_slice(json).map_err(|e| e.to_string())?;
    let accessors = list(&json, "accessors").len() as u64;
    for (mesh, value) in list(&json, "meshes").iter().enumerate() {
        for primitive in list(value, "primitives") {
            let attributes = primitive["attributes"].as_object().into_iter().flatten().map(|(_, row)| row);
            let rows = attributes.chain(primitive.get("indices")).filter_map(Value::as_u64);
            if let Some(row) = rows.into_iter().find(|row| *row >= accessors) {
                return Err(format!("mesh {mesh} refers to accessor {row}, there are {accessors}"));
            }
        }
    }
    for (index, image) in list(&json, "images").iter().enumerate() {
        let is_inside = image.get("bufferView").is_some() && image.get("mimeType").is_some();
        if image.get("uri").is_none() && !is_inside {
            return Err(format!("image {index} has neither `uri` nor `bufferView` and `mimeType`"));
        }
    }
    Ok(())
}

fn list<'a>(of: &'a Value, key: &str) -> &'a [Value] {
    of[key].as_array().map_or(&[], Vec::as_slice)
}

struct File<'a> {
    path: &'a Path,
    /// The binary part.
    blob: Vec<u8>,
    mesh: Mesh,
    /// By the row of the image.
    textures: HashMap<usize, Arc<RgbImage>>,
    room: Room,
    /// Nodes that may still be visited: in a tree each comes once, in a damaged file there may be loops.
    nodes_left: usize,
    /// Where primitives stand: mesh, primitive and the node's place.
    places: Vec<(usize, usize, Mat4)>,
    /// Mesh and primitive of those that stand somewhere.
    shown: HashSet<(usize, usize)>,
    /// Positions and corners of those that stand in a further place.
    elements: usize,
}

impl File<'_> {
    fn wrong(&self, problem: impl ToString) -> FileError {
        FileError::unsuitable(self.path, problem)
    }

    fn add(&mut self, document: &Document) -> Result<(), FileError> {
        for material in document.materials() {
            let material = self.material(&material)?;
            self.mesh.materials.push(material);
        }
        // What has no material is white.
        self.mesh.materials.push(Material::default());
        let scene = document.default_scene().or_else(|| document.scenes().next());
        let scene = scene.ok_or_else(|| self.wrong("it has no scene"))?;
        for node in scene.nodes() {
            self.node(&node, Mat4::IDENTITY, 0)?;
        }
        // Only now: how much it is altogether is known.
        let meshes: Vec<gltf::Mesh> = document.meshes().collect();
        let primitives: Vec<Vec<Primitive>> = meshes.iter().map(|mesh| mesh.primitives().collect()).collect();
        for (mesh, primitive, to_world) in std::mem::take(&mut self.places) {
            self.primitive(&primitives[mesh][primitive], to_world)?;
        }
        Ok(())
    }

    fn material(&mut self, material: &gltf::Material) -> Result<Material, FileError> {
        let base = material.pbr_metallic_roughness();
        let [r, g, b, _] = base.base_color_factor();
        let texture = match base.base_color_texture() {
            Some(texture) => Some(self.texture(&texture.texture().source())?),
            None => None,
        };
        // Factors are linear, our colours are as they are shown.
        let color = Vec3::new(r, g, b).clamp(Vec3::ZERO, Vec3::ONE).map(shown);
        Ok(Material { color, texture })
    }

    fn texture(&mut self, image: &gltf::Image) -> Result<Arc<RgbImage>, FileError> {
        if let Some(texture) = self.textures.get(&image.index()) {
            return Ok(texture.clone());
        }
        let Source::View { view, .. } = image.source() else {
            return Err(self.wrong(format!("texture {} is not inside the file", image.index())));
        };
        let bytes =
            view.offset().checked_add(view.length()).and_then(|end| self.blob.get(view.offset()..end));
        let bytes = bytes.ok_or_else(|| self.wrong(format!("texture {} is cut off", image.index())))?;
        let texture = self.room.fill(|most| decode_bytes(self.path, bytes, most))?;
        self.textures.insert(image.index(), texture.clone());
        Ok(texture)
    }

    fn node(&mut self, node: &Node, parent: Mat4, depth: usize) -> Result<(), FileError> {
        if depth > MAX_DEPTH || self.nodes_left == 0 {
            return Err(self.wrong(format!("its nodes form a loop, or nest deeper than {MAX_DEPTH}")));
        }
        self.nodes_left -= 1;
        let to_world = parent * Mat4::from_cols_array_2d(&node.transform().matrix());
        if let Some(mesh) = node.mesh() {
            for (row, primitive) in mesh.primitives().enumerate() {
                let size = self.checked_size(&primitive)?;
                if !self.shown.insert((mesh.index(), row)) {
                    self.elements = self.elements.saturating_add(size);
                }
                if self.elements > MAX_ELEMENTS {
                    let message =
                        format!("its nodes unfold to more than {MAX_ELEMENTS} positions and corners");
                    return Err(self.wrong(message));
                }
                self.places.push((mesh.index(), row, to_world));
            }
        }
        for child in node.children() {
            self.node(&child, to_world, depth + 1)?;
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &Primitive, to_world: Mat4) -> Result<(), FileError> {
        let mode = primitive.mode();
        if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            return Ok(());
        }
        let set = texture_set(primitive);
        let count = primitive.get(&gltf::Semantic::Positions).as_ref().map_or(0, Accessor::count);
        let blob = std::mem::take(&mut self.blob);
        let reader = primitive.reader(|_| Some(&blob));
        let positions: Vec<Vec3> = reader
            .read_positions()
            .into_iter()
            .flatten()
            .map(|p| to_world.transform_point3(Vec3::from_array(p)))
            .collect();
        let texcoords: Vec<Vec2> = reader
            .read_tex_coords(set)
            .into_iter()
            // glTF's textures begin at the top.
            .flat_map(|t| t.into_f32().map(|[u, v]| Vec2::new(u, 1.0 - v)))
            .collect();
        let colors: Vec<Vec3> = reader
            .read_colors(0)
            .into_iter()
            .flat_map(|c| c.into_rgb_f32().map(|c| Vec3::from_array(c).map(shown)))
            .collect();
        let indices: Option<Vec<u32>> = reader.read_indices().map(|indices| indices.into_u32().collect());
        self.blob = blob;

        let many = |what: &str, found: usize| {
            self.wrong(format!("a primitive has {found} {what} for {count} positions"))
        };
        if !texcoords.is_empty() && texcoords.len() != count {
            return Err(many("texture coordinates", texcoords.len()));
        }
        if !colors.is_empty() && colors.len() != count {
            return Err(many("colours", colors.len()));
        }
        let first = self.mesh.positions.len() as u32;
        let first_texcoord = self.mesh.texcoords.len() as u32;
        let rows = indices.unwrap_or_else(|| (0..positions.len() as u32).collect());
        let material = primitive.material().index().unwrap_or(self.mesh.materials.len() - 1) as u32;
        // A mirrored node turns its triangles inside out.
        let mirrored = to_world.determinant() < 0.0;
        let triangles = rows.len().saturating_sub(2);
        let triangle = |i: usize| match mode {
            Mode::TriangleFan => [0, i + 1, i + 2],
            Mode::TriangleStrip if i % 2 == 1 => [i + 1, i, i + 2],
            _ => [i, i + 1, i + 2],
        };
        let step = if mode == Mode::Triangles { 3 } else { 1 };
        for corners in (0..triangles).step_by(step).map(triangle) {
            let [a, mut b, mut c] = corners.map(|i| rows[i]);
            if let Some(row) = [a, b, c].into_iter().find(|row| *row as usize >= count) {
                return Err(self.wrong(format!("a face refers to position {row}, there are {count}")));
            }
            if mirrored {
                (b, c) = (c, b);
            }
            self.mesh.faces.push(Face {
                positions: [a, b, c].map(|row| row + first),
                texcoords: (!texcoords.is_empty()).then(|| [a, b, c].map(|row| row + first_texcoord)),
                material,
            });
        }
        self.mesh.positions.extend(positions);
        self.mesh.texcoords.extend(texcoords);
        if !colors.is_empty() || !self.mesh.colors.is_empty() {
            self.mesh.colors.resize(first as usize, Vec3::ONE);
            self.mesh.colors.extend(colors);
            self.mesh.colors.resize(self.mesh.positions.len(), Vec3::ONE);
        }
        Ok(())
    }

    /// Positions and corners of a primitive, one at least, all of whose accessors lie inside the file.
    fn checked_size(&self, primitive: &Primitive) -> Result<usize, FileError> {
        let wanted = [
            (primitive.get(&gltf::Semantic::Positions), &POSITIONS),
            (primitive.get(&gltf::Semantic::TexCoords(texture_set(primitive))), &TEXCOORDS),
            (primitive.get(&gltf::Semantic::Colors(0)), &COLORS),
            (primitive.indices(), &INDICES),
        ];
        for (accessor, kind) in &wanted {
            accessor.as_ref().map_or(Ok(()), |accessor| self.check(accessor, kind))?;
        }
        let [positions, _, _, corners] = wanted.map(|(accessor, _)| accessor.as_ref().map(Accessor::count));
        let positions = positions.unwrap_or(0);
        Ok(positions.saturating_add(corners.unwrap_or(positions)).max(1))
    }

    /// Whether the accessor lies inside the file: the reader trusts it.
    fn check(&self, accessor: &Accessor, kind: &Kind) -> Result<(), FileError> {
        let index = accessor.index();
        if !kind.types.contains(&accessor.data_type()) || !kind.dimensions.contains(&accessor.dimensions()) {
            let found = format!("{:?} of {:?}", accessor.dimensions(), accessor.data_type());
            return Err(self.wrong(format!("accessor {index} holds {}, but as {found}", kind.name)));
        }
        if accessor.sparse().is_some() {
            return Err(self.wrong(format!("accessor {index} is sparse, which scans are not")));
        }
        let view = accessor.view().ok_or_else(|| self.wrong(format!("accessor {index} has no data")))?;
        let size = accessor.size();
        let stride = view.stride().unwrap_or(size);
        let end = accessor
            .count()
            .checked_sub(1)
            .and_then(|last| last.checked_mul(stride)?.checked_add(size)?.checked_add(accessor.offset()));
        let inside = view.offset().checked_add(view.length()).is_some_and(|end| end <= self.blob.len());
        if stride < size || !inside || end.is_none_or(|end| end > view.length()) {
            let count = accessor.count();
            return Err(self.wrong(format!(
                "accessor {index} promises {count} entries, more than the file holds; it may be cut off"
            )));
        }
        if view.buffer().index() != 0 {
            return Err(self.wrong(format!("accessor {index} lies outside the file")));
        }
        Ok(())
    }
}

/// Which texture coordinates the primitive's texture is laid by.
fn texture_set(primitive: &Primitive) -> u32 {
    let base = primitive.material().pbr_metallic_roughness();
    base.base_color_texture().map_or(0, |texture| texture.tex_coord())
}

/// Linear light as a screen shows it (sRGB).
fn shown(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}
