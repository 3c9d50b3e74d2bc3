//! Skins of binary glTF: linear blend skinning, and the skeleton for other poses.

use std::collections::HashMap;

use glam::{Mat4, Vec3};
use gltf::accessor::{DataType, Dimensions};
use gltf::{Document, Primitive, Semantic};
use snapsnap_base::FileError;

use super::glb::{BONES, File, Skins, Weights};

/// Largest deviation of the sum of a position's weights from 1.
const LARGEST_ERROR: f32 = 0.02;

impl File<'_> {
    /// The joints of all skins, from the world transforms of their nodes.
    ///
    /// # Errors
    /// A joint outside of the scene, or inverse bind matrices that are missing or damaged.
    pub(super) fn skins(&self, document: &Document) -> Result<Skins, FileError> {
        let rows: HashMap<usize, usize> =
            self.worlds.iter().enumerate().map(|(row, (node, _))| (*node, row)).collect();
        let used: Vec<usize> = self.places.iter().filter_map(|place| place.skin).collect();
        let skins = document.skins().map(|skin| {
            let index = skin.index();
            if !used.contains(&index) {
                return Ok(Vec::new());
            }
            let accessor = skin.inverse_bind_matrices();
            let default = accessor.is_none().then_some(Mat4::IDENTITY);
            self.check("inverse bind matrices", accessor, &[DataType::F32], &[Dimensions::Mat4])?;
            let reader = skin.reader(|_| Some(&self.blob));
            let inverse = reader.read_inverse_bind_matrices().into_iter().flatten();
            let inverse: Vec<Mat4> = inverse.map(|matrix| Mat4::from_cols_array_2d(&matrix)).collect();
            let joints = skin.joints().enumerate().map(|(place, joint)| {
                let row = *rows.get(&joint.index()).ok_or_else(|| {
                    self.wrong(format!("joint {place} of skin {index} is not in the scene"))
                })?;
                let missing =
                    || self.wrong(format!("skin {index} has no inverse bind matrix for joint {place}"));
                let inverse = inverse.get(place).copied().or(default).ok_or_else(missing)?;
                let matrix = self.worlds[row].1 * inverse;
                if !matrix.is_finite() {
                    return Err(self.wrong(format!("joint {place} of skin {index} is not finite")));
                }
                Ok((row as u32, matrix))
            });
            joints.collect()
        });
        skins.collect()
    }

    /// Skin weights of a primitive's positions, with bones as indices into `joints`.
    ///
    /// # Errors
    /// Missing or damaged weights, naming the position.
    pub(super) fn weights(
        &self,
        primitive: &Primitive,
        positions: usize,
        joints: &[(u32, Mat4)],
    ) -> Result<Vec<Weights>, FileError> {
        let [found, shares] = [Semantic::Joints(0), Semantic::Weights(0)].map(|name| primitive.get(&name));
        if primitive.get(&Semantic::Joints(1)).is_some() {
            return Err(self.wrong(format!("a primitive has more than {BONES} joints for a position")));
        }
        for (accessor, what) in [(&found, "joints"), (&shares, "weights")] {
            let count = accessor.as_ref().map_or(0, gltf::Accessor::count);
            if count != positions {
                let message = format!("a primitive with a skin has {count} {what} for {positions} positions");
                return Err(self.wrong(message));
            }
        }
        self.check("joints", found, &[DataType::U8, DataType::U16], &[Dimensions::Vec4])?;
        self.check("weights", shares, &[DataType::U8, DataType::U16, DataType::F32], &[Dimensions::Vec4])?;
        let reader = primitive.reader(|_| Some(&self.blob));
        let rows = reader.read_joints(0).into_iter().flat_map(|joints| joints.into_u16());
        let shares = reader.read_weights(0).into_iter().flat_map(|weights| weights.into_f32());
        let weights = rows.zip(shares).enumerate().map(|(position, (rows, shares))| {
            let sum: f32 = shares.iter().sum();
            let are_shares = shares.iter().all(|share| *share >= 0.0) && (sum - 1.0).abs() <= LARGEST_ERROR;
            if !are_shares {
                let message =
                    format!("position {position} of a skin has the weights {shares:?}, which are not shares");
                return Err(self.wrong(message));
            }
            let mut weights = [(0, 0.0); BONES];
            let parts = weights.iter_mut().zip(rows).zip(shares).filter(|(_, share)| *share > 0.0);
            for ((to, row), share) in parts {
                if usize::from(row) >= joints.len() {
                    let message =
                        format!("position {position} refers to joint {row} of a skin of {}", joints.len());
                    return Err(self.wrong(message));
                }
                *to = (u32::from(row), share / sum);
            }
            Ok(weights)
        });
        weights.collect()
    }
}

/// A position after linear blend skinning.
pub fn moved(p: Vec3, weights: &Weights, joints: &[(u32, Mat4)]) -> Vec3 {
    let moving = weights.iter().filter(|(_, share)| *share > 0.0);
    moving.map(|(row, share)| *share * joints[*row as usize].1.transform_point3(p)).sum()
}
