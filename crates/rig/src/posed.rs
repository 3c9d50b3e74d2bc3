//! People in another pose: linear blend skinning of meshes and Gaussians.

use burn::tensor::{Tensor, TensorData};
use glam::{Affine3A, Mat3A, Quat, Vec3, Vec3A};
use snapsnap_mesh::import::Weights;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_splat::Gaussians;

use crate::weights::Field;

/// The transform of a point with these weights.
fn blended(weights: &Weights, transforms: &[Affine3A]) -> Affine3A {
    let zero = Affine3A { matrix3: Mat3A::ZERO, translation: Vec3A::ZERO };
    let moving = weights.iter().filter(|(_, weight)| *weight > 0.0);
    moving.fold(zero, |sum, (bone, weight)| {
        let part = transforms[*bone as usize];
        Affine3A {
            matrix3: sum.matrix3 + *weight * part.matrix3,
            translation: sum.translation + *weight * part.translation,
        }
    })
}

/// Moves the positions of a mesh. `transforms` is by bone.
pub fn pose_mesh(mesh: &mut Mesh, weights: &[Weights], transforms: &[Affine3A]) {
    for (place, weights) in mesh.positions.iter_mut().zip(weights) {
        *place = blended(weights, transforms).transform_point3(*place);
    }
}

/// Moves Gaussians and turns them with their bones. Their sizes stay.
pub fn pose_gaussians(gaussians: &Gaussians, field: &Field, transforms: &[Affine3A]) -> Gaussians {
    let host = |tensor: Tensor<2>| -> Vec<f32> {
        tensor.into_data().convert::<f32>().try_into_vec().expect("converted to f32 on this very line")
    };
    let (mut means, mut rotations) = (host(gaussians.means.clone()), host(gaussians.rotations.clone()));
    for (mean, rotation) in means.as_chunks_mut::<3>().0.iter_mut().zip(rotations.as_chunks_mut::<4>().0) {
        let place = Vec3::from_array(*mean);
        let transform = blended(&field.at(place), transforms);
        *mean = transform.transform_point3(place).to_array();
        let [w, x, y, z] = *rotation;
        // The rotation nearest to the mean of rotations, but for a shear that is small beside theirs.
        let turned = (turn(&transform) * Quat::from_xyzw(x, y, z, w)).normalize();
        *rotation = [turned.w, turned.x, turned.y, turned.z];
    }
    let device = gaussians.device();
    let tensor = |values: Vec<f32>, width: usize| {
        let rows = values.len() / width;
        Tensor::from_data(TensorData::new(values, [rows, width]), &device)
    };
    Gaussians { means: tensor(means, 3), rotations: tensor(rotations, 4), ..gaussians.clone() }
}

/// The rotation of a mean of rotations: its columns, made orthonormal.
fn turn(transform: &Affine3A) -> Quat {
    let matrix = transform.matrix3;
    let x = matrix.x_axis.normalize_or(Vec3A::X);
    let y = matrix.y_axis.reject_from_normalized(x).normalize_or(x.any_orthonormal_vector());
    Quat::from_mat3a(&Mat3A::from_cols(x, y, x.cross(y)))
}
