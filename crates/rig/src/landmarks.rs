//! A person's landmarks in 3D: the network that knows people looks at renders from several sides, and the rays of what it
//! sees meet at the landmark.

use burn::tensor::Tensor;
use glam::{DVec2, Mat3, Vec3};
use snapsnap_photo::segmenter::{Pose, SIDE, pose};
use snapsnap_splat::scene::Loaded;
use snapsnap_splat::{Camera, Orbit, RenderOptions, SplatError, render};

/// Landmarks of the network (docs/method.md, "Joints").
pub const LANDMARKS: usize = 33;
/// Yaws of the cameras, degrees from the front.
const YAWS: [f64; 8] = [0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0];
/// Side of a picture, and distance of the cameras, as multiples of the person's longer side.
const AROUND: f32 = 1.2;
const DISTANCE: f32 = 3.0;
/// Brightness behind the person.
const GREY: f32 = 150.0 / 255.0;
/// Probability above which the network sees a person.
const LIKELY: f32 = 0.5;
/// Distance between a ray and a landmark at which the ray has half of its weight, as a share of the person's longer side.
const REACH: f32 = 0.03;
/// Sum of the angles, radians, by which shoulders and hips are on the wrong side in a picture whose sides are exchanged.
const SWAPPED: f32 = 0.02;
/// Rounds of the weighted means.
const ROUNDS: usize = 8;

/// A landmark.
#[derive(Debug, Clone, Copy)]
pub struct Landmark {
    /// Metres in the world of the Gaussians.
    pub at: Vec3,
    /// Mean weight of the rays: near 1 where all views saw the landmark at this place.
    pub sure: f32,
}

/// What one view says of a landmark.
#[derive(Debug, Clone, Copy)]
struct Ray {
    /// Centre of the camera, and unit vector of the ray.
    from: Vec3,
    way: Vec3,
    /// Probability that the landmark is seen.
    seen: f32,
}

/// The landmarks of the person in a box of this centre and size. `None` if the network sees nobody from front and back.
///
/// # Errors
/// The errors of [`render`].
pub fn landmarks(scene: &Loaded, [centre, size]: [Vec3; 2]) -> Result<Option<Vec<Landmark>>, SplatError> {
    let length = size.max_element();
    let views: Result<Vec<_>, SplatError> =
        YAWS.iter().map(|yaw| view(scene, centre, length, *yaw)).collect();
    let views: Vec<Vec<Ray>> = views?.into_iter().filter_map(|(camera, rgb)| look(&camera, &rgb)).collect();
    if views.len() < 2 {
        return Ok(None);
    }
    let meet = |landmark: usize| {
        let rays: Vec<Ray> = views.iter().map(|rays| rays[landmark]).collect();
        meet(&rays, REACH * length)
    };
    Ok(Some((0..LANDMARKS).map(meet).collect()))
}

/// A camera and its picture, `[3, SIDE, SIDE]`, with the person as large as the network expects.
fn view(
    scene: &Loaded,
    centre: Vec3,
    length: f32,
    yaw_degrees: f64,
) -> Result<(Camera, Vec<f32>), SplatError> {
    let orbit = Orbit {
        centre: centre.as_dvec3(),
        radius: f64::from(DISTANCE * length),
        yaw_degrees,
        pitch_degrees: 0.0,
        focal: f64::from(DISTANCE / AROUND),
        ..Orbit::default()
    };
    let camera = Camera { principal_point: DVec2::splat(0.5 * SIDE as f64), ..orbit.camera(SIDE as u32) };
    let background = Some(Tensor::full([3], GREY, &scene.gaussians.device()));
    let options = RenderOptions { background, ..RenderOptions::inria() };
    let picture = render(&scene.seen_by(&camera)?, std::slice::from_ref(&camera), &options)?;
    let planes = picture.color.clamp(0.0, 1.0).permute([0, 3, 1, 2]).into_data().convert::<f32>();
    Ok((camera, planes.try_into_vec().expect("converted to f32 on the line above")))
}

/// The rays of the landmarks in a picture: means of the picture and of its mirror image.
fn look(camera: &Camera, rgb: &[f32]) -> Option<Vec<Ray>> {
    let from = camera.centre().as_vec3();
    let turn = camera.world_to_camera.rotation.transpose().as_mat3();
    let mut mirrored = rgb.to_vec();
    mirrored.chunks_exact_mut(SIDE).for_each(<[f32]>::reverse);
    let looks = [(rgb, false), (&mirrored, true)].map(|(rgb, is_mirrored)| {
        let Pose { landmarks, presence, .. } = pose(rgb);
        let probability = |logit: f32| 1.0 / (1.0 + (-logit).exp());
        let ray = |row: usize| {
            let [x, y, _, visible, present] = landmarks[if is_mirrored { opposite(row) } else { row }];
            let x = if is_mirrored { SIDE as f32 - x } else { x };
            let at = (DVec2::new(x.into(), y.into()) - camera.principal_point) / camera.focal;
            let way = (turn * at.as_vec2().extend(1.0)).normalize();
            Ray { from, way, seen: probability(visible).min(probability(present)) }
        };
        let rays: Vec<Ray> = (0..LANDMARKS).map(ray).collect();
        // The person faces +z, so the left is towards +x. The network sometimes takes a front for a back.
        let across: f32 = [11, 23].iter().map(|left| (rays[*left].way - rays[left + 1].way).x).sum();
        let is_swapped = across < -SWAPPED;
        let row = |row: usize| rays[if is_swapped { opposite(row) } else { row }];
        (presence >= LIKELY).then(|| (0..LANDMARKS).map(row).collect::<Vec<_>>())
    });
    let [Some(plain), Some(mirrored)] = looks else { return None };
    let mean =
        |(a, b): (&Ray, &Ray)| Ray { way: (a.way + b.way).normalize(), seen: a.seen.min(b.seen), ..*a };
    Some(plain.iter().zip(&mirrored).map(mean).collect())
}

/// The landmark of the other side of the body. The nose is 0; each eye has three landmarks.
fn opposite(row: usize) -> usize {
    match row {
        0 => 0,
        1..=3 => row + 3,
        4..=6 => row - 3,
        _ => row + 2 * (row % 2) - 1,
    }
}

/// The point nearest to all rays: least squares, with weights that fall with a ray's distance.
fn meet(rays: &[Ray], reach: f32) -> Landmark {
    let mut weights: Vec<f32> = rays.iter().map(|ray| ray.seen + 1e-3).collect();
    let mut at = Vec3::ZERO;
    for _ in 0..ROUNDS {
        let (mut matrix, mut sum) = (Mat3::ZERO, Vec3::ZERO);
        for (ray, weight) in rays.iter().zip(&weights) {
            let w = ray.way;
            let across = Mat3::IDENTITY - Mat3::from_cols(w * w.x, w * w.y, w * w.z);
            matrix += *weight * across;
            sum += *weight * (across * ray.from);
        }
        at = (matrix.as_dmat3().inverse() * sum.as_dvec3()).as_vec3();
        for (ray, weight) in rays.iter().zip(&mut weights) {
            let distance = (at - ray.from).reject_from_normalized(ray.way).length();
            *weight = (ray.seen + 1e-3) / (1.0 + (distance / reach).powi(2));
        }
    }
    Landmark { at, sure: weights.iter().sum::<f32>() / rays.len() as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_ray_in_eight_that_misses_moves_no_landmark() {
        let truth = Vec3::new(0.2, 1.1, -0.1);
        let rays = YAWS.map(|yaw| {
            let (sin, cos) = yaw.to_radians().sin_cos();
            let from = Vec3::new(5.0 * sin as f32, 1.0, 5.0 * cos as f32);
            let miss = if yaw == 90.0 { Vec3::new(0.0, 0.4, 0.3) } else { Vec3::ZERO };
            Ray { from, way: (truth + miss - from).normalize(), seen: 0.9 }
        });
        let Landmark { at, sure } = meet(&rays, 0.05);
        assert!(at.distance(truth) < 0.003 && (0.7..0.9).contains(&sure), "{at} {sure}");
        let none = rays.map(|ray| Ray { seen: 0.0, ..ray });
        assert!(meet(&none, 0.05).sure < 1e-2);
    }
}
