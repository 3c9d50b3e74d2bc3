//! Reads binary glTF 2.0: the triangles of the default scene with base colours, moved by nodes or skins, and its bones.

use std::borrow::Cow;
use std::collections::HashSet;
use std::fmt::Display;
use std::path::Path;

use glam::{Mat4, Vec2, Vec3};
use gltf::accessor::{DataType, Dimensions, Item, Iter};
use gltf::json::Root;
use gltf::mesh::Mode;
use gltf::{Accessor, Document, Node, Primitive};
use snapsnap_base::{FileError, file};

use super::glb_material::{base, check_extensions, is_invisible, of_uri, shown, texture_set, transformed};
use super::skin::moved;
use super::{MAX_BYTES, Textures};
use crate::mesh::{Face, Material, Mesh};

/// Deepest nesting of nodes.
const MAX_DEPTH: usize = 256;

/// Largest number of positions and face corners that repeated uses of the same data may add.
const MAX_ELEMENTS: usize = 4_000_000;

/// Number of bones that may move a position.
pub const BONES: usize = 4;

/// Bones that move a position, with shares that add up to 1.
pub type Weights = [(u32, f32); BONES];

/// A node of the skeleton in the pose of the file.
#[derive(Debug, Clone)]
pub struct Bone {
    /// Name; empty if the file has none.
    pub name: String,
    /// Index of the parent, which precedes the bone.
    pub parent: Option<usize>,
    /// Origin in the space of the mesh's positions.
    pub place: Vec3,
}

/// A mesh with its skeleton and skin weights.
#[derive(Debug, Clone, Default)]
pub struct Rigged {
    /// The mesh in the pose of the file's nodes.
    pub mesh: Mesh,
    /// All nodes of the scene, parents before children.
    pub bones: Vec<Bone>,
    /// By position: skin weights. A mesh without a skin follows its node. Empty if the file has no skin.
    pub weights: Vec<Weights>,
    /// Whether the file has morph targets or animations, which are ignored.
    pub has_animations: bool,
}

/// By skin and joint: index of the bone, and the matrix from the mesh's space to the world.
pub type Skins = Vec<Vec<(u32, Mat4)>>;

/// A primitive at a node.
pub struct Place {
    pub mesh: usize,
    pub primitive: usize,
    /// Index of the node in [`Rigged::bones`].
    pub node: usize,
    pub skin: Option<usize>,
}

pub struct File<'a> {
    pub path: &'a Path,
    /// The binary chunk.
    pub blob: Vec<u8>,
    pub rigged: Rigged,
    /// By the index of the image.
    pub(super) textures: Textures<usize>,
    /// Number of nodes that may still be visited. A tree has each node once, but a damaged file may contain loops.
    pub nodes_left: usize,
    pub places: Vec<Place>,
    /// Accessors of positions and indices that an entry of `places` uses.
    pub shown: HashSet<usize>,
    /// Positions and corners that second and further uses of an accessor add.
    pub elements: usize,
    /// By bone: index of the node, and the node's transform to the world.
    pub worlds: Vec<(usize, Mat4)>,
}

pub fn read_rigged(path: &Path) -> Result<Rigged, FileError> {
    let bytes = file::read(path, MAX_BYTES).map_err(FileError::read(path))?;
    let invalid = |e: &dyn Display| FileError::unsuitable(path, format!("is no valid GLB: {e}"));
    let (json, mut blob) = if bytes.starts_with(b"glTF") {
        let glb = gltf::Glb::from_slice(&bytes).map_err(|e| invalid(&e))?;
        (glb.json, glb.bin.map_or_else(Vec::new, Cow::into_owned))
    } else {
        (Cow::from(&*bytes), Vec::new())
    };
    // Some exporters pad the text with zeros.
    let is_text = |byte: &u8| *byte != 0 && !byte.is_ascii_whitespace();
    let json = &json[..json.iter().rposition(is_text).map_or(0, |last| last + 1)];
    let mut root: Root = gltf::json::deserialize::from_slice(json).map_err(|e| invalid(&e))?;
    drop(bytes);
    check_references(&root).map_err(|e| invalid(&e))?;
    check_extensions(&mut root).map_err(|e| FileError::unsuitable(path, e))?;
    if let Some(uri) = root.buffers.first().and_then(|buffer| buffer.uri.as_deref()) {
        blob = of_uri(uri).map_err(|e| FileError::unsuitable(path, format!("its data {e}")))?;
    }
    let document = Document::from_json(root).map_err(|e| invalid(&e))?;
    let mut file = File {
        path,
        blob,
        rigged: Rigged::default(),
        textures: Textures::default(),
        nodes_left: document.nodes().len(),
        places: Vec::new(),
        shown: HashSet::new(),
        elements: 0,
        worlds: Vec::new(),
    };
    file.add(&document)?;
    let has_targets = document.meshes().flat_map(|m| m.primitives()).any(|p| p.morph_targets().len() > 0);
    file.rigged.has_animations = has_targets || document.animations().len() > 0;
    Ok(file.rigged)
}

/// Refuses missing and out-of-range references, on which the validation of the `gltf` crate would panic.
fn check_references(root: &Root) -> Result<(), String> {
    let accessors = root.accessors.len();
    for (mesh, value) in root.meshes.iter().enumerate() {
        for primitive in &value.primitives {
            let mut rows = primitive.attributes.values().chain(&primitive.indices).map(|row| row.value());
            if let Some(row) = rows.find(|row| *row >= accessors) {
                return Err(format!("mesh {mesh} refers to accessor {row}, there are {accessors}"));
            }
        }
    }
    for (index, image) in root.images.iter().enumerate() {
        if image.uri.is_none() && (image.buffer_view.is_none() || image.mime_type.is_none()) {
            return Err(format!("image {index} has neither `uri` nor `bufferView` and `mimeType`"));
        }
    }
    Ok(())
}

impl File<'_> {
    fn add(&mut self, document: &Document) -> Result<(), FileError> {
        for material in document.materials() {
            let material = self.material(&material, document)?;
            self.rigged.mesh.materials.push(material);
        }
        // Primitives without a material are white.
        self.rigged.mesh.materials.push(Material::default());
        let scene = document.default_scene().or_else(|| document.scenes().next());
        let scene = scene.ok_or_else(|| self.wrong("it has no scene"))?;
        for node in scene.nodes() {
            self.node(&node, None, 0)?;
        }
        // The total size has been checked by now.
        let meshes = document.meshes().map(|mesh| mesh.primitives().collect());
        let primitives: Vec<Vec<Primitive>> = meshes.collect();
        let skins = self.skins(document)?;
        for place in std::mem::take(&mut self.places) {
            self.primitive(&primitives[place.mesh][place.primitive], &place, &skins)?;
        }
        Ok(())
    }

    fn node(&mut self, node: &Node, parent: Option<usize>, depth: usize) -> Result<(), FileError> {
        if depth > MAX_DEPTH || self.nodes_left == 0 {
            return Err(self.wrong(format!("its nodes form a loop, or nest deeper than {MAX_DEPTH}")));
        }
        self.nodes_left -= 1;
        let from = parent.map_or(Mat4::IDENTITY, |row| self.worlds[row].1);
        let to_world = from * Mat4::from_cols_array_2d(&node.transform().matrix());
        let own = self.rigged.bones.len();
        let name = node.name().unwrap_or_default().to_owned();
        self.rigged.bones.push(Bone { name, parent, place: to_world.transform_point3(Vec3::ZERO) });
        self.worlds.push((node.index(), to_world));
        if let Some(mesh) = node.mesh() {
            for (row, primitive) in mesh.primitives().enumerate() {
                self.check_accessors(&primitive)?;
                let data = [primitive.get(&gltf::Semantic::Positions), primitive.indices()];
                for accessor in data.into_iter().flatten() {
                    if !self.shown.insert(accessor.index()) {
                        self.elements = self.elements.saturating_add(accessor.count());
                    }
                }
                // A primitive without data counts as one element.
                self.elements += 1;
                if self.elements > MAX_ELEMENTS {
                    let message =
                        format!("its nodes unfold to more than {MAX_ELEMENTS} positions and corners");
                    return Err(self.wrong(message));
                }
                let skin = node.skin().map(|skin| skin.index());
                self.places.push(Place { mesh: mesh.index(), primitive: row, node: own, skin });
            }
        }
        for child in node.children() {
            self.node(&child, Some(own), depth + 1)?;
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &Primitive, place: &Place, skins: &Skins) -> Result<(), FileError> {
        let mode = primitive.mode();
        let is_drawn = matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan);
        if !is_drawn || is_invisible(&primitive.material()) {
            return Ok(());
        }
        let set = texture_set(primitive);
        let accessor = primitive.get(&gltf::Semantic::Positions);
        let count = accessor.as_ref().map_or(0, Accessor::count);
        let joints = place.skin.map(|skin| &skins[skin][..]);
        let mut weights = match joints {
            Some(joints) => self.weights(primitive, count, joints)?,
            None if skins.is_empty() => Vec::new(),
            None => vec![[(place.node as u32, 1.0), (0, 0.0), (0, 0.0), (0, 0.0)]; count],
        };
        // A skin replaces the transform of the node.
        let to_world = joints.map_or(self.worlds[place.node].1, |_| Mat4::IDENTITY);
        let reader = primitive.reader(|_| Some(&self.blob));
        let read = accessor.into_iter().flat_map(|rows| self.numbers::<3>(&rows)).map(Vec3::from_array);
        let positions: Vec<Vec3> = match joints {
            Some(joints) => read.zip(&weights).map(|(p, weights)| moved(p, weights, joints)).collect(),
            None => read.map(|p| to_world.transform_point3(p)).collect(),
        };
        for (row, _) in weights.iter_mut().flatten().filter(|(_, share)| *share > 0.0) {
            *row = joints.map_or(*row, |joints| joints[*row as usize].0);
        }
        let texture = base(&primitive.material()).1;
        let texcoords = primitive.get(&gltf::Semantic::TexCoords(set));
        let texcoords = texcoords.into_iter().flat_map(|rows| self.numbers::<2>(&rows)).map(Vec2::from_array);
        let texcoords = texcoords.map(|at| texture.as_ref().map_or(at, |texture| transformed(texture, at)));
        // The origin of glTF's texture coordinates is at the top.
        let texcoords: Vec<Vec2> = texcoords.map(|at| Vec2::new(at.x, 1.0 - at.y)).collect();
        if texture.is_some() && texcoords.is_empty() && count > 0 {
            return Err(self.wrong(format!("a primitive has a texture, but no `TEXCOORD_{set}`")));
        }
        let colors = reader.read_colors(0).into_iter().flat_map(|colors| colors.into_rgb_f32());
        let colors: Vec<Vec3> = colors.map(|color| Vec3::from_array(color).map(shown)).collect();
        let indices: Option<Vec<u32>> = reader.read_indices().map(|indices| indices.into_u32().collect());

        for (found, what) in [(texcoords.len(), "texture coordinates"), (colors.len(), "colours")] {
            if found != 0 && found != count {
                return Err(self.wrong(format!("a primitive has {found} {what} for {count} positions")));
            }
        }
        let mesh = &mut self.rigged.mesh;
        let first = mesh.positions.len() as u32;
        let first_texcoord = mesh.texcoords.len() as u32;
        let rows = indices.unwrap_or_else(|| (0..positions.len() as u32).collect());
        let material = primitive.material().index().unwrap_or(mesh.materials.len() - 1) as u32;
        // A node that mirrors turns its triangles inside out.
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
            mesh.faces.push(Face {
                positions: [a, b, c].map(|row| row + first),
                texcoords: (!texcoords.is_empty()).then(|| [a, b, c].map(|row| row + first_texcoord)),
                material,
            });
        }
        mesh.positions.extend(positions);
        mesh.texcoords.extend(texcoords);
        // If some positions have a colour, the others are white.
        if !colors.is_empty() || !mesh.colors.is_empty() {
            mesh.colors.resize(first as usize, Vec3::ONE);
            mesh.colors.extend(colors);
            mesh.colors.resize(mesh.positions.len(), Vec3::ONE);
        }
        self.rigged.weights.extend(weights);
        Ok(())
    }

    /// Checks the accessors of a primitive with [`File::check`].
    fn check_accessors(&self, primitive: &Primitive) -> Result<(), FileError> {
        let shares: &[DataType] = &[DataType::U8, DataType::U16, DataType::F32];
        // Whole numbers: `KHR_mesh_quantization`.
        let numbers = [shares, &[DataType::I8, DataType::I16]].concat();
        let texcoords = gltf::Semantic::TexCoords(texture_set(primitive));
        let positions = primitive.get(&gltf::Semantic::Positions);
        self.check("positions", positions, &numbers, &[Dimensions::Vec3])?;
        self.check("texture coordinates", primitive.get(&texcoords), &numbers, &[Dimensions::Vec2])?;
        let colors = primitive.get(&gltf::Semantic::Colors(0));
        self.check("colours", colors, shares, &[Dimensions::Vec3, Dimensions::Vec4])?;
        let rows = [DataType::U8, DataType::U16, DataType::U32];
        self.check("indices", primitive.indices(), &rows, &[Dimensions::Scalar])
    }

    pub fn wrong(&self, problem: impl ToString) -> FileError {
        FileError::unsuitable(self.path, problem)
    }

    /// Refuses an accessor of a wrong type or beyond the file. The reader of the `gltf` crate checks neither.
    pub fn check(
        &self,
        name: &str,
        accessor: Option<Accessor>,
        types: &[DataType],
        dimensions: &[Dimensions],
    ) -> Result<(), FileError> {
        let Some(accessor) = accessor else { return Ok(()) };
        let index = accessor.index();
        if !types.contains(&accessor.data_type()) || !dimensions.contains(&accessor.dimensions()) {
            let found = format!("{:?} of {:?}", accessor.dimensions(), accessor.data_type());
            return Err(self.wrong(format!("accessor {index} holds {name}, but as {found}")));
        }
        if accessor.sparse().is_some() {
            return Err(self.wrong(format!("accessor {index} is sparse, which scans are not")));
        }
        let view = accessor.view().ok_or_else(|| self.wrong(format!("accessor {index} has no data")))?;
        if view.buffer().index() != 0 {
            return Err(self.wrong(format!("accessor {index} lies outside the file")));
        }
        let size = accessor.size();
        let stride = view.stride().unwrap_or(size);
        let end = |last: usize| last.checked_mul(stride)?.checked_add(size)?.checked_add(accessor.offset());
        let end = accessor.count().checked_sub(1).and_then(end);
        let inside = view.offset().checked_add(view.length()).is_some_and(|end| end <= self.blob.len());
        if stride < size || !inside || end.is_none_or(|end| end > view.length()) {
            let count = accessor.count();
            return Err(self.wrong(format!(
                "accessor {index} promises {count} entries, more than the file holds; it may be cut off"
            )));
        }
        Ok(())
    }

    /// The rows of a checked accessor. Normalised integers are shares of the largest one.
    fn numbers<const N: usize>(&self, accessor: &Accessor) -> Vec<[f32; N]>
    where
        [i8; N]: Item,
        [u8; N]: Item,
        [i16; N]: Item,
        [u16; N]: Item,
        [f32; N]: Item,
    {
        let most = |most: f32| if accessor.normalized() { most } else { 1.0 };
        match accessor.data_type() {
            DataType::I8 => self.rows::<i8, N>(accessor, most(127.0)),
            DataType::U8 => self.rows::<u8, N>(accessor, most(255.0)),
            DataType::I16 => self.rows::<i16, N>(accessor, most(32_767.0)),
            DataType::U16 => self.rows::<u16, N>(accessor, most(65_535.0)),
            _ => self.rows::<f32, N>(accessor, 1.0),
        }
    }

    fn rows<T: Into<f32>, const N: usize>(&self, accessor: &Accessor, most: f32) -> Vec<[f32; N]>
    where
        [T; N]: Item,
    {
        let rows = Iter::<[T; N]>::new(accessor.clone(), |_| Some(&self.blob));
        rows.into_iter().flatten().map(|row| row.map(|value| value.into() / most)).collect()
    }
}
