//! The rasteriser against the f64 oracle.

use std::ops::{Range, RangeInclusive};

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DMat3, DVec2, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use snapsnap_ops::host;
use snapsnap_splat::reference::{self, Cutoff, Scene};
use snapsnap_splat::{Camera, Gaussians, MAX_SIDE, RenderOptions, RigidTransform, SplatError, render};

use super::{Case, Found, all_finite, apart, tracked, worst};
use crate::geometry::double;

/// Mean, rotation (w first), scales, opacity, colour.
type Row = [f32; 14];

/// Limits of errors by rounding to f32. Largest errors on flex, ndarray and lavapipe: 7.9e-7 and 4.2e-6.
const VALUES: f64 = 2e-6;
const GRADIENTS: f64 = 1e-5;
/// Smaller gradients count as 0.
const SMALLEST: f64 = 1e-30;

/// Norms of quaternions that count as rotations.
const QUATERNIONS: RangeInclusive<f32> = 1e-6..=1e18;

/// All cases of the rasteriser (docs/method.md, "Stability cases").
pub fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    let camera = camera(32, 24, 30.0);
    let mut add = |input: String, holds: &str, rows: Vec<Row>, camera: Camera| {
        let run = move |device: &Device| against_oracle(&rows, &camera, device);
        cases.push(case(&input, holds, GRADIENTS, run));
    };
    let shaped = |scales: [f32; 3]| changed(1..3, |row| row[7..10].copy_from_slice(&scales));
    let equal = "as the oracle, forward and backward";
    for ratio in [1e2_f32, 1e3, 1e5, 1e7] {
        let short = 0.3 / ratio;
        add(format!("needles 1:{ratio:.0e}"), equal, shaped([0.3, short, short]), camera);
        add(format!("discs 1:{ratio:.0e}"), equal, shaped([0.3, 0.3, short]), camera);
    }
    // As in files of 2D Gaussians.
    add("discs without thickness".into(), equal, shaped([0.3, 0.3, 0.0]), camera);
    for scale in [1e-8_f32, 1e-4, 1.0, 1e2, 1e4] {
        add(format!("all scales {scale:.0e} m"), equal, shaped([scale; 3]), camera);
    }
    for opacity in [0.0_f32, 1e-7, 1.0 - 1e-7, 1.0] {
        let rows = changed(2..3, |row| row[10] = opacity);
        add(format!("opacity {opacity:?}"), equal, rows, camera);
    }
    let names = ["0", "1e-20", "1e-5", "1e15", "1e20", "−1 (signs flipped)"];
    for (name, norm) in names.into_iter().zip([0.0_f32, 1e-20, 1e-5, 1e15, 1e20, -1.0]) {
        let rows = changed(2..3, |row| {
            let before = row[3..7].iter().map(|q| q * q).sum::<f32>().sqrt();
            row[3..7].iter_mut().for_each(|q| *q *= norm / before);
        });
        let left_out = "left out (below 1e-6 it is no rotation, beyond 1e18 no number), gradient 0; the others as the oracle without it";
        let holds = if QUATERNIONS.contains(&norm.abs()) { equal } else { left_out };
        add(format!("quaternion of norm {name}"), holds, rows, camera);
    }
    let names = ["at", "just before", "just beyond", "behind the camera"];
    for (name, z) in names.into_iter().zip([0.2_f32, 0.2 - 1e-6, 0.2 + 1e-6, -1.0]) {
        let rows = changed(2..3, |row| row[2] = z);
        let name = if z < 0.0 { name.to_owned() } else { format!("{name} the near plane") };
        add(name, "left out where the oracle leaves it out", rows, camera);
    }
    for distance in [1e-3_f32, 1.0, 1e3, 1e6] {
        // The scales grow with the distance, so that the size in the picture is constant.
        let far = |row: &mut Row| {
            row[2] = distance;
            row[7..10].iter_mut().for_each(|s| *s *= distance / 2.0);
        };
        add(format!("{distance:.0e} m away"), equal, changed(2..3, far), camera);
    }
    for focal in [1.0, 30.0, 1e4, 1e6] {
        let holds = "as the oracle: the picture's size on the sensor does not matter";
        // The distance grows with the focal length, so that the picture stays full.
        let rows = changed(0..6, |row| row[2] *= ((focal / 30.0) as f32).max(0.2));
        add(format!("focal length {focal:.0e} px"), holds, rows, self::camera(32, 24, focal));
    }
    add("image of 1×1".into(), equal, six(), self::camera(1, 1, 1.0));
    let far = 1e5;
    let mut far_camera = camera;
    far_camera.world_to_camera.translation.x = -f64::from(far);
    let holds = "as the oracle: positions are what f32 holds there (8 mm apart), nothing is lost beyond that";
    let rows = changed(0..6, |row| row[0] += far);
    add("scene and camera 1e5 m from the origin".into(), holds, rows, far_camera);
    let holds = "as the oracle; gradients finite, and zero behind the closed pixel";
    cases.push(case("10,000 opaque Gaussians on one pixel", holds, 0.0, many_on_one_pixel));
    let holds =
        "as the oracle in a patch, or refused for want of memory; more than the largest side is refused";
    cases.push(case("image of 8192×8192, and beyond the largest side", holds, 0.0, largest_image));
    cases
}

/// A case of the rasteriser. A refused render is a failure.
fn case(
    input: &str,
    holds: &str,
    gradient_limit: f64,
    run: impl Fn(&Device) -> Result<Found, SplatError> + 'static,
) -> Case {
    let run = move |device: &Device| run(device).unwrap_or_else(|e| Found::broken(format!("refused: {e}")));
    Case::new("Splats", input, holds, [VALUES, gradient_limit], run)
}

fn camera(width: u32, height: u32, focal: f64) -> Camera {
    Camera {
        width,
        height,
        focal: DVec2::splat(focal),
        principal_point: DVec2::new(f64::from(width) / 2.0, f64::from(height) / 2.0),
        world_to_camera: RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
    }
}

/// Six Gaussians two metres before the camera.
fn six() -> Vec<Row> {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut one = || {
        let mut between = |low: f32, high: f32| random.random_range(low..high);
        let mut row = [0.0; 14];
        row[..3].copy_from_slice(&[between(-0.6, 0.6), between(-0.5, 0.5), between(1.5, 2.5)]);
        row[3..7].copy_from_slice(&[(); 4].map(|()| between(-1.0, 1.0)));
        row[7..10].copy_from_slice(&[(); 3].map(|()| between(0.1, 0.3)));
        row[10] = between(0.4, 0.9);
        row[11..].copy_from_slice(&[(); 3].map(|()| between(0.0, 1.0)));
        row
    };
    (0..6).map(|_| one()).collect()
}

/// The six Gaussians, of which `change` changes the rows `which`.
fn changed(which: Range<usize>, change: impl FnMut(&mut Row)) -> Vec<Row> {
    let mut rows = six();
    rows[which].iter_mut().for_each(change);
    rows
}

/// Gaussians of rows `[N, 14]`.
pub(crate) fn gaussians(rows: &Tensor<2>) -> Gaussians {
    let columns = |first: usize, count: usize| rows.clone().narrow(1, first, count);
    let opacities = columns(10, 1).squeeze_dim(1);
    Gaussians::new(columns(0, 3), columns(3, 4), columns(7, 3), opacities, columns(11, 3))
        .expect("14 columns")
}

fn scene(rows: &[Row]) -> Scene<f64> {
    Scene { gaussians: rows.iter().map(|row| row.map(f64::from)).collect(), background: [0.0; 3] }
}

/// Compares a render and its gradients with the oracle. The oracle does not get Gaussians whose quaternion is no
/// rotation, for which it would compute 0/0.
fn against_oracle(rows: &[Row], camera: &Camera, device: &Device) -> Result<Found, SplatError> {
    let options = RenderOptions { depth: true, ..RenderOptions::inria() };
    let norm = |row: &Row| row[3..7].iter().map(|q| f64::from(*q).powi(2)).sum::<f64>().sqrt() as f32;
    let kept: Vec<usize> = (0..rows.len()).filter(|i| QUATERNIONS.contains(&norm(&rows[*i]))).collect();
    let scene = scene(&kept.iter().map(|i| rows[*i]).collect::<Vec<_>>());
    let expected = reference::render(&scene, camera, &options, Cutoff::Hard);
    let banded = reference::banded(&scene, camera, &options);
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut weights = || [(); 5].map(|()| f64::from(random.random_range(-1.0_f32..1.0)));
    let mut upstream: Vec<[f64; 5]> = expected.iter().map(|_| weights()).collect();
    // Pixels at which rounding may change a cut-off are not compared.
    upstream.iter_mut().zip(&banded).filter(|(_, banded)| **banded).for_each(|(u, _)| *u = [0.0; 5]);

    let tracked = tracked(rows.concat(), [rows.len(), 14], device);
    let rendered = render(&gaussians(&tracked), std::slice::from_ref(camera), &options)?;
    let depth = rendered.depth.clone().expect("an option");
    let parts = [rendered.color.clone(), rendered.alpha.clone().unsqueeze_dim(3), depth.unsqueeze_dim(3)];
    let image = Tensor::cat(parts.to_vec(), 3);
    let weights: Vec<f32> = upstream.iter().flatten().map(|u| *u as f32).collect();
    let weights = Tensor::<4>::from_data(TensorData::new(weights, image.dims()), &image.device());
    let gradients = (image.clone() * weights).sum().backward();
    let got = host(image);
    // Errors of depths are relative to the distance of the scene.
    let reach = scene.gaussians.iter().map(|g| g[2].abs()).fold(1.0, f64::max);
    let compared = got.chunks_exact(5).zip(&expected).zip(&banded).filter(|(_, banded)| !**banded);
    let off = compared.flat_map(|((found, expected), _)| {
        let errors = found.iter().zip(*expected).enumerate();
        errors.map(|(c, (f, e))| apart(*f, e) / if c == 4 { reach } else { 1.0 })
    });
    let value = worst(off);
    let of_oracle = reference::gradient(&scene, camera, &options, Cutoff::Hard, &upstream).gaussians;
    let Some(found) = tracked.grad(&gradients).map(host) else {
        return Ok(Found::broken("no gradient"));
    };
    // Errors are relative to the same Gaussian's gradient, since others may be far larger. All its parameters count
    // together in their own units, since terms may cancel to rounding errors (the rotation of a ball).
    let of_row = |(row, found): (usize, &Row)| {
        let (expected, units) = match kept.iter().position(|k| *k == row) {
            Some(place) => (of_oracle[place], std::array::from_fn(|i| unit(&rows[row], i, camera))),
            // Omitted Gaussians have no gradient in any unit.
            None => ([0.0; 14], [1.0; 14]),
        };
        let off = worst((0..14).map(|i| apart(found[i], expected[i]) * units[i]));
        let size = (0..14).map(|i| expected[i].abs() * units[i]).fold(0.0, f64::max);
        off / size.max(SMALLEST)
    };
    let gradient = found.as_chunks().0.iter().enumerate().map(of_row).fold(0.0, f64::max);
    let share = banded.iter().filter(|b| **b).count();
    let note = format!("{share} of {} pixels lie at a cut-off and are not compared", banded.len());
    let note = if share > 0 { note } else { String::new() };
    Ok(Found { value: Some(value), gradient: Some(gradient), note, ..Found::default() }
        .must(share < banded.len(), "nothing could be compared"))
}

/// The unit of a parameter: for means the largest scale, at least half a pixel; for rotations the largest component.
fn unit(row: &Row, parameter: usize, camera: &Camera) -> f64 {
    let largest = |values: &[f32]| values.iter().fold(0.0_f64, |most, v| most.max(f64::from(v.abs())));
    match parameter {
        0..3 => {
            let depth = camera.world_to_camera.apply(double([row[0], row[1], row[2]])).z.abs();
            largest(&row[7..10]).max(0.5 * depth / camera.focal.x)
        }
        3..7 => largest(&row[3..7]),
        7..10 => f64::from(row[parameter]),
        _ => 1.0,
    }
}

/// Ten thousand nearly opaque Gaussians, one behind the other.
fn many_on_one_pixel(device: &Device) -> Result<Found, SplatError> {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let row = |i: i32| {
        let mut row = [0.0; 14];
        row[2] = 1.0 + i as f32 * 1e-3;
        (row[3], row[10]) = (1.0, 1.0);
        row[7..10].fill(0.05);
        row[11..].copy_from_slice(&[(); 3].map(|()| random.random::<f32>()));
        row
    };
    let rows: Vec<Row> = (0..10_000).map(row).collect();
    let camera = camera(9, 9, 10.0);
    let options = RenderOptions::inria();
    let tracked = tracked(rows.concat(), [rows.len(), 14], device);
    let rendered = render(&gaussians(&tracked), std::slice::from_ref(&camera), &options)?;
    let gradients = rendered.color.clone().sum().backward();
    let got = host(rendered.color);
    let scene = scene(&rows);
    let expected = reference::render(&scene, &camera, &options, Cutoff::Hard);
    let banded = reference::banded(&scene, &camera, &options);
    let compared = got.chunks_exact(3).zip(&expected).zip(&banded).filter(|(_, banded)| !**banded);
    let off = compared.flat_map(|((found, expected), _)| [0, 1, 2].map(|c| apart(found[c], expected[c])));
    let value = worst(off);
    let gradient = host(tracked.grad(&gradients).expect("tracked"));
    // The pixel in the middle of the Gaussians closes at once, pixels at their rim after hundreds of Gaussians.
    let behind = &gradient[gradient.len() / 10 * 9..];
    let most = worst(behind.iter().map(|v| f64::from(v.abs())));
    Ok(Found { value: Some(value), gradient: Some(most), ..Found::default() }
        .must(all_finite(&gradient), "a gradient is not finite"))
}

/// The largest accepted image, compared in a patch. One pixel more is refused.
fn largest_image(device: &Device) -> Result<Found, SplatError> {
    let options = RenderOptions::inria();
    let rows = six();
    let gaussians = gaussians(&Tensor::from_data(TensorData::new(rows.concat(), [rows.len(), 14]), device));
    let beyond = camera(MAX_SIDE + 1, 8, 30.0);
    let refused = render(&gaussians, &[beyond], &options).is_err();
    let large = camera(8192, 8192, 8000.0);
    let (x, y) = (4300_u32, 4000_u32);
    let color = match render(&gaussians, &[large], &options) {
        Ok(rendered) => rendered.color,
        Err(e @ (SplatError::Memory { .. } | SplatError::TooManyIntersections { .. })) => {
            return Ok(Found::skipped(format!("refused: {e}")));
        }
        Err(e) => return Err(e),
    };
    const SIDE: u32 = 12;
    let part = color.narrow(1, y as usize, SIDE as usize).narrow(2, x as usize, SIDE as usize);
    let got = host(part);
    let which = (y..y + SIDE).flat_map(|row| (x..x + SIDE).map(move |column| row * 8192 + column));
    let expected = reference::pixels(&scene(&rows), &large, &options, Cutoff::Hard, which);
    let off = got.iter().zip(expected.iter().flat_map(|&[r, g, b, ..]| [r, g, b])).map(|(f, e)| apart(*f, e));
    Ok(Found { value: Some(worst(off)), ..Found::default() }
        .must(refused, "a side beyond the largest was accepted"))
}
