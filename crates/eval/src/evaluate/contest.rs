//! Contestants of an evaluation: the model, its variants and the baselines.

use std::time::Duration;

use burn::tensor::Device;
use snapsnap_data::sample::{PhotographChanges, TestItem};
use snapsnap_net::Photograph;
use snapsnap_photo::joints_on;
use snapsnap_splat::{Camera, Gaussians};

use super::baselines::{billboard, true_points};
use super::config::{MetricsSection, ViewsSection};
use super::model::{Model, no_gaussian};
use super::person::{People, Points, nearest_view, photograph, points};
use super::sides::side_points;
use super::surface::Truth;
use crate::foreign::Palette;
use crate::geometry::{ALIGNED, Align, double, icp, opaque_centres, thinned};
use crate::parts::{PartError, part_errors};
use crate::points::{Pair, PointError, point_errors};
use crate::{EvalError, Result};

/// Azimuths of the right and the left side, degrees from the first photograph.
const SIDES: [f64; 2] = [90.0, 270.0];

/// The role of a contestant in a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Kind {
    /// The model under test.
    #[default]
    Model,
    /// A variant, which is compared with the model person by person.
    Other,
    /// A method without networks.
    Baseline,
}

/// A model or a baseline.
pub enum Contestant {
    /// The model under test or a variant of it, with its name in reports.
    Model(String, Kind, Box<Model>),
    /// The photographs as flat cut-outs.
    Billboard(Device),
    /// Ground-truth points in the photographs' colours.
    TruePoints(Device),
}

/// Errors of a person's points in each view, and on the parts of the photographs.
pub type PointErrors = (Vec<PointError>, Vec<PartError>);

/// A contestant's result for a person.
pub struct Shown {
    /// World frame.
    pub gaussians: Gaussians,
    /// Errors of the predicted points, or why they could not be measured.
    pub points: Result<PointErrors, String>,
    /// Number of pixels and Gaussians that were not finite.
    pub lost: usize,
    /// Mean overlap of the cut-outs and the true masks, if the networks cut the person out.
    pub masks: Option<f64>,
    /// Colours of photographs with a background of their own.
    pub palette: Option<Palette>,
    /// Time of the reconstruction.
    pub time: Option<Duration>,
    /// Rotation in degrees, shift of the middle in cm and scale of the alignment, if there was one.
    pub aligned: Option<[f64; 3]>,
}

impl Contestant {
    /// The name in reports.
    pub(super) fn name(&self) -> &str {
        match self {
            Self::Model(name, ..) => name,
            Self::Billboard(_) => "billboard",
            Self::TruePoints(_) => "true_points",
        }
    }

    /// The role in the report.
    pub(super) fn kind(&self) -> Kind {
        if let Self::Model(_, kind, _) = self { *kind } else { Kind::Baseline }
    }

    /// How the contestant's pictures are rendered.
    pub(super) fn views(&self, views: &ViewsSection) -> ViewsSection {
        if let Self::Model(.., model) = self { views.of(&model.variant) } else { views.clone() }
    }

    /// The result for a person's photographs. `canvas` is the side of the baselines' canvas in pixels. Models are
    /// aligned with the truth as `metrics` says.
    ///
    /// # Errors
    /// [`EvalError`] if files cannot be read, no Gaussian came out, or there is no truth for an alignment.
    pub(super) fn prepare(
        &self,
        people: &People,
        row: usize,
        item: &TestItem,
        inputs: &[usize],
        canvas: usize,
        (metrics, truth): (&MetricsSection, Option<&Truth>),
    ) -> Result<Shown> {
        let plain = |gaussians: Gaussians| {
            if gaussians.is_empty() {
                return Err(no_gaussian());
            }
            let points = Ok(PointErrors::default());
            Ok(Shown { gaussians, points, lost: 0, masks: None, palette: None, time: None, aligned: None })
        };
        match self {
            Self::Model(.., model) => {
                let is_changed = model.photographs != PhotographChanges::default();
                let own = is_changed.then(|| people.item(row, inputs, &model.photographs)).transpose()?;
                let changed = own.as_ref().unwrap_or(item);
                let mut made = model.reconstruct(changed, inputs)?;
                let front = &changed.cameras[inputs[0]];
                let align = || aligned(&mut made.gaussians, &mut made.maps, metrics, truth, front);
                let aligned = (metrics.align != Align::None).then(align).transpose()?;
                // Pictures can be compared without errors of points.
                let points = errors(people, row, item, inputs, &made.maps, model.side());
                let has_background = model.photographs.has_background();
                Ok(Shown {
                    points: points.map_err(|e| e.to_string()),
                    lost: made.lost,
                    masks: made.masks,
                    palette: has_background.then(|| Palette::new(&changed.photographs, &item.photographs)),
                    time: Some(made.time),
                    aligned,
                    ..plain(made.gaussians)?
                })
            }
            Self::Billboard(device) => {
                let (photographs, valid) = on_canvas(item, inputs.len(), canvas);
                let cameras: Vec<_> = inputs.iter().map(|view| item.cameras[*view]).collect();
                plain(billboard(&photographs, &valid, canvas, &cameras, device))
            }
            Self::TruePoints(device) => {
                let mut views = inputs.to_vec();
                if inputs.len() == 2 {
                    views.extend(SIDES.map(|azimuth| nearest_view(&item.cameras, inputs[0], azimuth)));
                }
                let Some((points, there)) = points(&people.test, row, &views, item.side, canvas)? else {
                    let message = format!("views of {}² give no points on a canvas of {canvas}²", item.side);
                    return Err(EvalError::new(message));
                };
                let (photographs, mut valid) = on_canvas(item, inputs.len(), canvas);
                valid.resize(views.len(), vec![true; canvas * canvas]);
                for (valid, there) in valid.iter_mut().flatten().zip(there) {
                    *valid &= there > 0.5;
                }
                let front = &item.cameras[inputs[0]];
                plain(true_points(&photographs, &points, &valid, canvas, front, device))
            }
        }
    }
}

/// Aligns Gaussians (world frame) and point maps (frame of the `front` camera) with the truth, by the centres of
/// opaque Gaussians. Returns rotation in degrees, shift of the centres' mean in cm, and scale.
fn aligned(
    gaussians: &mut Gaussians,
    maps: &mut [(usize, Vec<f32>)],
    metrics: &MetricsSection,
    truth: Option<&Truth>,
    front: &Camera,
) -> Result<[f64; 3]> {
    let truth = truth.ok_or_else(|| EvalError::new("there is no ground truth to align with"))?;
    let centres = opaque_centres(gaussians, ALIGNED)?;
    let motion = icp(&centres, &thinned(&truth.points, 10 * ALIGNED), metrics.align == Align::Similarity)?;
    *gaussians = gaussians.clone().scaled(motion.scale).transformed(&motion.rigid());
    let (to_world, to_front) = (front.world_to_camera.inverse(), front.world_to_camera);
    for (_, points) in maps {
        // Pixels without a prediction have the point 0.
        for point in points.as_chunks_mut::<3>().0.iter_mut().filter(|point| **point != [0.0; 3]) {
            let moved = motion.apply(to_world.apply(double(*point)).as_vec3().to_array());
            *point = to_front.apply(double(moved)).as_vec3().to_array();
        }
    }
    Ok(motion.figures(&centres))
}

/// The photographs `[3,S,S]` on a canvas, and masks of the pixels that the person covers at least by half. These
/// pixels have the person's own colour.
fn on_canvas(item: &TestItem, count: usize, side: usize) -> (Vec<Vec<f32>>, Vec<Vec<bool>>) {
    // Stored colours are multiplied by the mask. Networks may have learned to undo this, baselines cannot.
    let own = |photo: Photograph| {
        let Photograph { mut rgb, mask, valid } = photo;
        for plane in rgb.chunks_exact_mut(mask.len()) {
            plane.iter_mut().zip(&mask).for_each(|(v, m)| *v = (*v / m.max(0.5)).clamp(-1.0, 1.0));
        }
        (rgb, valid)
    };
    (0..count).map(|place| own(photograph(item, place, side))).unzip()
}

/// Errors of point maps at the pixels with ground truth. Each map has its view's index in [`crate::points::VIEWS`].
fn errors(
    people: &People,
    row: usize,
    item: &TestItem,
    inputs: &[usize],
    maps: &[(usize, Vec<f32>)],
    side: usize,
) -> Result<PointErrors> {
    // Pairs of more than two photographs have no common frame.
    if maps.is_empty() {
        return Ok(PointErrors::default());
    }
    let Some((photographed, there)) = points(&people.test, row, inputs, item.side, side)? else {
        return Ok(PointErrors::default());
    };
    let of_inputs = photographed.chunks_exact(3 * side * side).zip(there.chunks_exact(side * side));
    let mut truths: Vec<Points> =
        of_inputs.map(|(points, valid)| (points.to_vec(), valid.to_vec())).collect();
    for azimuth in SIDES {
        truths.push(side_points(&people.test, row, item, inputs[0], azimuth, side)?);
    }
    let with_truth = maps.iter().filter_map(|(view, points)| Some((*view, points, truths.get(*view)?)));
    let pairs = with_truth.map(|(view, points, (truth, valid))| Pair { view, points, truth, valid });
    let pairs: Vec<Pair> = pairs.collect();
    let photographed = pairs.iter().filter(|pair| pair.view < 2);
    let parts = photographed.flat_map(|pair| {
        let joints = joints_on(&photograph(item, pair.view, side));
        if joints.is_empty() { Vec::new() } else { part_errors(pair, &joints, side) }
    });
    Ok((point_errors(&pairs), parts.collect()))
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Tensor, TensorData};
    use glam::{DQuat, DVec3};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use snapsnap_ops::host;

    use super::*;
    use crate::stability::splats::gaussians;

    /// Alignment undoes a known similarity that moved Gaussians and maps by less than the distance of neighbours.
    #[test]
    fn aligned_models_lie_on_the_truth() {
        let front = Camera::orbit_at_yaw_degrees(0.0, 64);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let size = [0.6_f32, 1.8, 0.4];
        let cloud: Vec<[f32; 3]> =
            (0..2000).map(|_| size.map(|size| size * random.random_range(-0.5..0.5_f32))).collect();
        let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.004, -0.003, 0.002);
        let shift = DVec3::new(0.001, -0.002, 0.001);
        let place = |p: &[f32; 3]| (0.998 * (turn * double(*p)) + shift).as_vec3().to_array();
        let moved: Vec<[f32; 3]> = cloud.iter().map(place).collect();
        let seen = |points: &[[f32; 3]]| -> Vec<f32> {
            points.iter().flat_map(|p| front.world_to_camera.apply(double(*p)).as_vec3().to_array()).collect()
        };
        let truth = Truth { points: cloud.clone(), views: Vec::new() };
        for (align, most) in [(Align::Similarity, 1e-5), (Align::Rigid, 2e-3)] {
            let metrics = MetricsSection { align, ..MetricsSection::default() };
            let row =
                |[x, y, z]: &[f32; 3]| [*x, *y, *z, 1.0, 0.0, 0.0, 0.0, 0.01, 0.01, 0.01, 1.0, 0.5, 0.5, 0.5];
            let rows = TensorData::new(moved.iter().flat_map(row).collect::<Vec<f32>>(), [moved.len(), 14]);
            let mut gaussians = gaussians(&Tensor::from_data(rows, &Device::flex()));
            // The last pixel has no prediction.
            let mut maps = [(1, [seen(&moved), vec![0.0; 3]].concat())];
            let [degrees, _, scale] =
                aligned(&mut gaussians, &mut maps, &metrics, Some(&truth), &front).expect("aligned");
            let farthest =
                |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0_f32, f32::max);
            let apart = farthest(&host(gaussians.means.clone()), &cloud.concat());
            assert!(apart < most, "{align:?}: {apart} m");
            let map = &maps[0].1;
            assert!(farthest(map, &seen(&cloud)) < 2.0 * most, "{align:?}");
            assert_eq!(map[3 * moved.len()..], [0.0; 3]);
            let expected = if align == Align::Rigid { 1.0 } else { 1.0 / 0.998 };
            let turned = turn.to_axis_angle().1.to_degrees();
            assert!((scale - expected).abs() < 1e-5 && (degrees - turned).abs() < 0.01, "{degrees}° {scale}");
            let size = host(gaussians.scales.clone())[0];
            assert!((f64::from(size) - 0.01 * scale).abs() < 1e-6, "{size}");
            let nothing = aligned(&mut gaussians, &mut maps, &metrics, None, &front);
            assert!(nothing.is_err_and(|e| e.to_string().contains("no ground truth")));
        }
    }
}
