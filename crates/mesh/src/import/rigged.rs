//! A mesh with its skeleton, and the binary glTF of which it is made.

use std::collections::HashSet;
use std::path::Path;

use glam::{Mat4, Vec3};
use gltf::Accessor;
use gltf::accessor::{DataType, Dimensions};
use snapsnap_base::FileError;

use super::Textures;
use crate::mesh::Mesh;

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
    /// Index of the node in `File::bones`.
    pub node: usize,
    pub skin: Option<usize>,
}

pub struct File<'a> {
    pub path: &'a Path,
    /// The binary chunk.
    pub blob: Vec<u8>,
    pub mesh: Mesh,
    /// By the index of the image.
    pub(super) textures: Textures<usize>,
    /// Number of nodes that may still be visited. A tree has each node once, but a damaged file may contain loops.
    pub nodes_left: usize,
    pub places: Vec<Place>,
    /// Accessors of positions and indices that an entry of `places` uses.
    pub shown: HashSet<usize>,
    /// Positions and corners that second and further uses of an accessor add.
    pub elements: usize,
    pub bones: Vec<Bone>,
    /// By bone: index of the node, and the node's transform to the world.
    pub worlds: Vec<(usize, Mat4)>,
    pub weights: Vec<Weights>,
}

impl File<'_> {
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
