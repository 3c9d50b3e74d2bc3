//! Skeletons and skin weights of people made of Gaussians, and their poses (docs/method.md, "Skeletons").

mod body;
mod bones;
mod landmarks;
mod posed;
mod weights;

use glam::{Affine3A, Vec3};
use snapsnap_mesh::export::{Clip, Skin};
use snapsnap_mesh::fuse::{self, FuseError};
use snapsnap_mesh::mesh::Mesh;
use snapsnap_people::poses::Motion;
use snapsnap_people::{Placed, Pose, avatars};
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Gaussians, SplatError};

use body::Body;
pub use bones::Bone;
pub use posed::pose_mesh;
use weights::Field;

/// Errors of [`Rig::new`] and [`Rig::transforms`].
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// No body.
    #[error(transparent)]
    Fuse(#[from] FuseError),
    /// An error of the rasteriser.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// Nobody whom the network knows.
    #[error("no skeleton: the network that looks for joints sees no person")]
    Nobody,
    /// A mesh without an inside.
    #[error("no skeleton: the mesh encloses no bone")]
    Hollow,
    /// Joints whose place cannot be.
    #[error("no skeleton: {0}")]
    Impossible(String),
}

/// The skeleton of a person, and what follows it.
#[derive(Debug, Clone)]
pub struct Rig {
    /// Hips, spine, neck and head; shoulder, arm, forearm, hand, thigh, leg, foot and toes of the left side and of the right.
    pub bones: Vec<Bone>,
    field: Field,
}

impl Rig {
    /// Finds the skeleton of a person who stands upright and faces +z. `mesh` is the person's closed surface.
    ///
    /// # Errors
    /// [`RigError`].
    pub fn new(scene: &Loaded, mesh: &Mesh) -> Result<Self, RigError> {
        let (centre, size) = fuse::body(&scene.gaussians)?;
        let landmarks = landmarks::landmarks(scene, [centre, size])?.ok_or(RigError::Nobody)?;
        let body = Body::new(mesh);
        let bones = bones::bones(&landmarks, &body);
        let field = Field::new(body, &bones::sources(&bones), bones.len()).ok_or(RigError::Hollow)?;
        Ok(Self { bones, field })
    }

    /// The skin of a mesh of the person, which may have more positions than the mesh of [`Self::new`].
    pub fn skin(&self, mesh: &Mesh) -> Skin {
        let weights = mesh.positions.iter().map(|place| self.field.at(*place)).collect();
        Skin { joints: bones::joints(&self.bones), weights, clips: Vec::new() }
    }

    /// By bone: the transform into a pose. The feet stay at their height.
    ///
    /// # Errors
    /// [`RigError::Impossible`].
    pub fn transforms(&self, pose: &Pose) -> Result<Vec<Affine3A>, RigError> {
        let placed = avatars::placed(&bones::nodes(&self.bones), pose).map_err(RigError::Impossible)?;
        let transforms: Vec<Affine3A> = placed.iter().map(Placed::transform).collect();
        let feet = || self.bones.iter().zip(&transforms).filter(|(bone, _)| bone.name.ends_with("Foot"));
        let before = feet().map(|(bone, _)| bone.ends[0].y).fold(f32::INFINITY, f32::min);
        let after =
            feet().map(|(bone, moved)| moved.transform_point3(bone.ends[0]).y).fold(f32::INFINITY, f32::min);
        let lift = Affine3A::from_translation((before - after) * Vec3::Y);
        Ok(transforms.into_iter().map(|transform| lift * transform).collect())
    }

    /// A motion for [`Skin::clips`].
    ///
    /// # Errors
    /// [`RigError::Impossible`].
    pub fn clip(&self, name: &str, motion: &Motion) -> Result<Clip, RigError> {
        let joints = bones::joints(&self.bones);
        let frame = |pose: &Pose| {
            let moved = self.transforms(pose)?.into_iter().zip(&joints);
            Ok(moved.map(|(transform, joint)| transform * joint.rest).collect())
        };
        let frames = motion.poses.iter().map(frame).collect::<Result<_, RigError>>()?;
        Ok(Clip { name: name.to_owned(), step: motion.step, frames })
    }

    /// Moves Gaussians and turns them with their bones. Their sizes stay.
    pub fn pose_gaussians(&self, gaussians: &Gaussians, transforms: &[Affine3A]) -> Gaussians {
        posed::pose_gaussians(gaussians, &self.field, transforms)
    }
}
