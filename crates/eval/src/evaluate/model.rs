//! A variant of the model: photographs of a person → Gaussians in the data set's world.

use std::time::{Duration, Instant};

use burn::tensor::{Device, Int, Tensor, TensorData};
use snapsnap_data::photo::Mapping;
use snapsnap_data::sample::{Handling, Restoration, TestItem};
use snapsnap_net::config::{OPPOSITE, PrecisionChoice};
use snapsnap_net::gaussians::placed;
use snapsnap_net::weights::{WeightFile, WeightsError};
use snapsnap_net::{Reconstruction, Reconstructor};
use snapsnap_ops::host;
use snapsnap_splat::Gaussians;

use super::person::{degrees, photograph};
use crate::EvalError;
use crate::variant::Variant;

/// The networks of a variant on a device.
pub struct Model {
    reconstructor: Reconstructor,
    stride: usize,
    min_opacity: f32,
    /// Changes to its photographs.
    pub photographs: Handling,
}

/// The reconstruction of a person.
pub struct Made {
    /// In the data set's world.
    pub gaussians: Gaussians,
    /// Point maps `[S,S,3]` in the first photograph's frame, by the indices of their views in [`crate::points::VIEWS`].
    /// Empty for more than two photographs, and for placed ones.
    pub maps: Vec<(usize, Vec<f32>)>,
    /// Number of pixels and Gaussians that were not finite and are left out.
    pub lost: usize,
    /// From the photographs on their canvas to the Gaussians.
    pub time: Duration,
    /// Times of the modules, over all pairs of photographs.
    pub modules: Vec<(&'static str, Duration)>,
    /// The steps that ran, and the omitted ones with reasons.
    pub plan: Vec<String>,
}

impl Model {
    /// Loads both networks of a variant, whose config is that of `weights`.
    ///
    /// # Errors
    /// [`WeightsError`] if a part is absent or a value is not finite.
    pub fn load(weights: &WeightFile, device: &Device, variant: &Variant) -> Result<Self, WeightsError> {
        let precision =
            variant.precision.unwrap_or(PrecisionChoice::Auto).of_weights(&weights.config, device);
        let mut reconstructor = Reconstructor::load(weights, device)?.in_precision(precision);
        // Scenes of more than two photographs have no unseen sides.
        let is_pair = variant.inputs.as_ref().is_none_or(|inputs| inputs.len() <= 2);
        if !variant.sides.unwrap_or(is_pair) {
            reconstructor = reconstructor.without_sides();
        }
        if variant.side_colors == Some(false) {
            reconstructor = reconstructor.without_side_colors();
        }
        Ok(Self {
            reconstructor,
            stride: variant.stride.unwrap_or(1),
            min_opacity: variant.min_opacity.unwrap_or(0.0),
            photographs: variant.photographs.unwrap_or_default(),
        })
    }

    /// Side of the canvas.
    pub fn side(&self) -> usize {
        self.reconstructor.config().network.resolution
    }

    /// Refuses cameras `found` degrees apart for networks of neighbours.
    fn check_pair(&self, found: f64) -> Result<(), EvalError> {
        /// Largest deviation of a known camera, degrees.
        const MOST: f64 = 0.5;
        let expected = self.reconstructor.config().network.pair_degrees;
        if expected != OPPOSITE && (found - expected).abs() > MOST {
            return Err(EvalError::Empty(format!(
                "`views.inputs` are {found:.1}° apart, but `network.pair_degrees` of the weights is {expected}"
            )));
        }
        Ok(())
    }

    /// Gaussians of a person seen from the views `inputs`. With more than two photographs, each and the next around the
    /// circle form a pair, of which the first one's Gaussians are kept (both photographs' if some were left out), in the frame of its
    /// known camera.
    ///
    /// # Errors
    /// [`EvalError::Empty`] if no Gaussian came out.
    pub fn reconstruct(&self, item: &TestItem, inputs: &[usize]) -> Result<Made, EvalError> {
        let side = self.side();
        let photographs: Vec<_> = (0..inputs.len()).map(|place| photograph(item, place, side)).collect();
        let start = Instant::now();
        let count = if inputs.len() == 2 { 1 } else { inputs.len() };
        let (mut parts, mut maps, mut lost) = (Vec::new(), Vec::new(), 0);
        let (mut modules, mut plan) = (Vec::<(&'static str, Duration)>::new(), Vec::new());
        for first in 0..count {
            let pair = [&photographs[first], &photographs[(first + 1) % inputs.len()]];
            let camera = &item.cameras[inputs[first]];
            self.check_pair(degrees(&item.cameras[inputs[(first + 1) % inputs.len()]], camera))?;
            let mut made = self.reconstructor.reconstruct(pair[0], pair[1], &|_| ());
            let mut to_world = camera.world_to_camera.inverse();
            let mut scale = 1.0;
            let is_placed = item.mappings[first] != Mapping::AS_IT_IS;
            if is_placed {
                // The second of more than two photographs is a neighbour, and shows no back.
                let opposite = camera.turned(180.0);
                let second = if count == 1 {
                    (&item.cameras[inputs[1]], &item.mappings[1])
                } else {
                    (&opposite, &item.mappings[first])
                };
                let restoration = Restoration::new([camera, second.0], [&item.mappings[first], second.1]);
                made.gaussians = restoration.person(made.gaussians.clone(), made.photographed());
                (scale, to_world) = (restoration.scale, restoration.front.world_to_camera.inverse());
            }
            if count > 1 && made.lost_gaussians == 0 {
                // The second photograph is the first one of the next pair.
                let [first, _] = made.photographed();
                made.gaussians = first_rows(made.gaussians, first);
                made.valid.truncate(1);
            }
            let gaussians = self.thinned(&made, side).scaled(scale);
            parts.push(placed(self.reconstructor.config(), gaussians, &to_world));
            lost += made.lost;
            for (name, time) in &made.times {
                match modules.iter_mut().find(|(module, _)| module == name) {
                    Some((_, sum)) => *sum += *time,
                    None => modules.push((*name, *time)),
                }
            }
            // All pairs have one plan.
            if first == 0 {
                plan.clone_from(&made.plan);
            }
            // Pixels of placed photographs have no ground truth.
            if count == 1 && !is_placed {
                let points = host(made.maps.points.clone());
                let of_view = points.chunks_exact(3 * side * side).map(<[f32]>::to_vec);
                maps = made.views.iter().map(|view| *view as usize).zip(of_view).collect();
            }
        }
        if count > 1 {
            plan.insert(0, format!("{count} pairs of photographs, the first one"));
        }
        let gaussians = joined(parts);
        gaussians.device().sync().expect("the device finishes its work");
        let time = start.elapsed();
        if gaussians.is_empty() {
            return Err(no_gaussian());
        }
        Ok(Made { gaussians, maps, lost, time, modules, plan })
    }

    /// The Gaussians after the variant's stride and least opacity.
    fn thinned(&self, made: &Reconstruction, side: usize) -> Gaussians {
        let Self { stride, min_opacity, .. } = *self;
        let gaussians = made.gaussians.clone();
        if stride == 1 && min_opacity <= 0.0 {
            return gaussians;
        }
        let pixels: Vec<usize> =
            made.valid.iter().flat_map(|valid| (0..valid.len()).filter(|i| valid[*i])).collect();
        // The last Gaussians may close the top, and belong to no pixel. If some were lost, no pixel is known.
        let on_grid = |row: usize| match pixels.get(row).filter(|_| made.lost_gaussians == 0) {
            Some(pixel) => [pixel / side, pixel % side].iter().all(|at| at.is_multiple_of(stride)),
            None => row.is_multiple_of(stride * stride),
        };
        let opacities = host(gaussians.opacities.clone());
        let keep = (0..gaussians.len()).filter(|row| on_grid(*row) && opacities[*row] >= min_opacity);
        let keep: Vec<i64> = keep.map(|row| row as i64).collect();
        let n = keep.len();
        let keep = Tensor::<1, Int>::from_data(TensorData::new(keep, [n]), &gaussians.device());
        let rows = |of: Tensor<2>| of.select(0, keep.clone());
        Gaussians {
            means: rows(gaussians.means),
            rotations: rows(gaussians.rotations),
            scales: rows(gaussians.scales) * stride as f64,
            opacities: gaussians.opacities.select(0, keep.clone()),
            colors: rows(gaussians.colors),
        }
    }
}

/// The first `count` Gaussians.
fn first_rows(gaussians: Gaussians, count: usize) -> Gaussians {
    let Gaussians { means, rotations, scales, opacities, colors } = gaussians;
    let rows = |of: Tensor<2>| of.narrow(0, 0, count);
    Gaussians {
        means: rows(means),
        rotations: rows(rotations),
        scales: rows(scales),
        opacities: opacities.narrow(0, 0, count),
        colors: rows(colors),
    }
}

pub(super) fn no_gaussian() -> EvalError {
    EvalError::Empty("no Gaussian came out".into())
}

/// All Gaussians of several sets.
pub fn joined(parts: Vec<Gaussians>) -> Gaussians {
    let rows = |of: fn(&Gaussians) -> &Tensor<2>| {
        Tensor::cat(parts.iter().map(|part| of(part).clone()).collect(), 0)
    };
    Gaussians {
        means: rows(|part| &part.means),
        rotations: rows(|part| &part.rotations),
        scales: rows(|part| &part.scales),
        opacities: Tensor::cat(parts.iter().map(|part| part.opacities.clone()).collect(), 0),
        colors: rows(|part| &part.colors),
    }
}
