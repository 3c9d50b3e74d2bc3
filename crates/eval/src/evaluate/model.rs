//! A variant of the model: photographs of a person → Gaussians in the data set's world.

use std::path::Path;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use snapsnap_data::sample::{PhotographChanges, Road, TestItem};
use snapsnap_net::config::{OPPOSITE, Precision, RotationFrame, WorldFrame};
use snapsnap_net::network::View;
use snapsnap_net::painter::Origin;
use snapsnap_net::steps::Step;
use snapsnap_net::weights::{WeightFile, WeightsError};
use snapsnap_net::{Photograph, Reconstructor, placed, rows};
use snapsnap_ops::host;
use snapsnap_photo::{Cutting, Frame, Person, Photographs, Restoration, Source as Picture, Told};
use snapsnap_splat::Gaussians;

use super::person::{degrees, photograph};
use crate::foreign::overlap;
use crate::geometry::procrustes;
use crate::statistics::mean;
use crate::variant::Variant;
use crate::{EvalError, Result};

/// The networks of a variant on a device.
pub struct Model {
    reconstructor: Reconstructor,
    /// Changes to the photographs that the model gets.
    pub photographs: PhotographChanges,
    /// What was loaded.
    pub variant: Variant,
}

/// The reconstruction of a person.
pub struct Made {
    /// In the data set's world.
    pub gaussians: Gaussians,
    /// Point maps `[S,S,3]` in the first photograph's frame, by the indices of their views in [`crate::points::VIEWS`].
    /// Empty for more than two photographs, and for placed photographs.
    pub maps: Vec<(usize, Vec<f32>)>,
    /// Number of pixels and Gaussians that were not finite and are left out.
    pub lost: usize,
    /// Mean overlap of the cut-outs and the true masks, if the networks cut the person out.
    pub masks: Option<f64>,
    /// From the photographs on their canvas to the Gaussians.
    pub time: Duration,
    /// Times of the modules, over all pairs of photographs.
    pub modules: Vec<(&'static str, Duration)>,
    /// The steps that ran, and the omitted ones with reasons.
    pub steps: Vec<Step>,
}

impl Model {
    /// Loads both networks of a variant, with the config of `weights`.
    ///
    /// # Errors
    /// [`WeightsError`] if a part is absent or a value is not finite.
    pub fn load(weights: &WeightFile, device: &Device, variant: &Variant) -> Result<Self, WeightsError> {
        let precision = variant.precision.unwrap_or_else(|| Precision::of_weights(&weights.config, device));
        let mut reconstructor = Reconstructor::load(weights, device)?.in_precision(precision);
        // Scenes of more than two photographs have no unseen sides.
        let is_pair = variant.inputs.as_ref().is_none_or(|inputs| inputs.len() <= 2);
        if !variant.sides.unwrap_or(is_pair) {
            reconstructor = reconstructor.without_sides();
        }
        if variant.side_colors == Some(false) {
            reconstructor = reconstructor.without_side_colors();
        }
        let photographs = variant.photographs.unwrap_or_default();
        Ok(Self { reconstructor, photographs, variant: variant.clone() })
    }

    /// Side of the canvas.
    pub fn side(&self) -> usize {
        self.reconstructor.config().network.resolution
    }

    /// Refuses cameras `found` degrees apart if the networks are for neighbours at another angle.
    fn check_pair(&self, found: f64) -> Result<()> {
        /// Largest deviation of a known camera, degrees.
        const MOST: f64 = 0.5;
        let expected = self.reconstructor.config().network.pair_degrees;
        if expected != OPPOSITE && (found - expected).abs() > MOST {
            return Err(EvalError::new(format!(
                "`views.inputs` are {found:.1}° apart, but `network.pair_degrees` of the weights is {expected}"
            )));
        }
        Ok(())
    }

    /// The photographs, placed on their canvases. [`Cutting::Given`] uses the data set's masks.
    fn canvases(&self, item: &TestItem, cutting: Cutting) -> Result<Photographs> {
        let (config, name) = (self.reconstructor.config(), Path::new(&item.subject));
        let knows_masks = cutting == Cutting::Given;
        let photographs = item.photographs.iter();
        let sources = photographs.map(|(rgb, mask)| Picture::pixels(name, rgb, knows_masks.then_some(mask)));
        let placement = Told::default().placement(config);
        Ok(snapsnap_photo::read(&sources.collect::<Vec<_>>(), cutting, self.side(), placement, None)?)
    }

    /// Gaussians of a person seen from the views `inputs`. Of more than two photographs, each and the next around the
    /// circle form a pair. Of a pair, the first photograph's Gaussians are kept, placed by its known camera.
    ///
    /// # Errors
    /// [`EvalError`] without a person or a Gaussian, and for more than two photographs on the road `user`.
    pub fn reconstruct(&self, item: &TestItem, inputs: &[usize]) -> Result<Made> {
        match self.photographs.road {
            Road::Canvas => {
                let canvases: Vec<_> =
                    (0..inputs.len()).map(|place| photograph(item, place, self.side())).collect();
                self.of_known_cameras(item, inputs, &canvases, None)
            }
            Road::Placed => {
                let Photographs { canvases, frames, .. } = self.canvases(item, Cutting::Given)?;
                self.of_known_cameras(item, inputs, &canvases, Some(&frames))
            }
            Road::User => self.of_user(item, inputs),
        }
    }

    /// The person of photographs with unknown masks and cameras, in the data set's world.
    fn of_user(&self, item: &TestItem, inputs: &[usize]) -> Result<Made> {
        let &[front, back] = inputs else {
            let message = "`photographs.road = \"user\"` is for a front and a back: `views.inputs`";
            return Err(EvalError::new(message));
        };
        let config = self.reconstructor.config();
        if config.world_frame() == WorldFrame::Mirrored || config.rotation_frame() == RotationFrame::World {
            let message =
                "`photographs.road = \"user\"` is for networks whose people are upright: `mode.compat`";
            return Err(EvalError::new(message));
        }
        self.check_pair(degrees(&item.cameras[back], &item.cameras[front]))?;
        let photographs = self.canvases(item, Cutting::All)?;
        let pairs = photographs.cutouts.iter().zip(&item.photographs);
        let overlaps: Vec<f64> = pairs.map(|((_, found), (_, truth))| overlap(found, truth)).collect();
        let start = Instant::now();
        let person = snapsnap_photo::person(&photographs, &self.reconstructor, &Told::default(), &|_| ());
        let Person { gaussians, made, .. } = person.map_err(EvalError::new)?;
        let time = start.elapsed();
        let cameras = [&item.cameras[front], &item.cameras[back]];
        let mappings = [0, 1].map(|i| &photographs.frames[i].mapping);
        let restoration = Restoration::to_cameras(cameras, mappings, self.side() as u32);
        let restored = restoration.person(made.gaussians.clone(), &made.origins);
        let restored = restored.transformed(&restoration.front.world_to_camera.inverse());
        let [from, onto] = [&gaussians, &restored].map(|person| host(person.means.clone()));
        let motion = procrustes(from.as_chunks().0, onto.as_chunks().0, true);
        let (gaussians, _) = self.thinned(gaussians, &made.origins, false);
        let gaussians = gaussians.scaled(motion.scale).transformed(&motion.rigid());
        let (lost, modules, steps) = (made.lost, made.times, made.steps);
        Ok(Made { gaussians, maps: Vec::new(), lost, masks: mean(&overlaps), time, modules, steps })
    }

    /// A person from photographs on their canvases, with known cameras. Placed photographs have `frames`.
    fn of_known_cameras(
        &self,
        item: &TestItem,
        inputs: &[usize],
        photographs: &[Photograph],
        frames: Option<&[Frame]>,
    ) -> Result<Made> {
        let side = self.side();
        let start = Instant::now();
        let count = if inputs.len() == 2 { 1 } else { inputs.len() };
        let (mut parts, mut maps, mut lost) = (Vec::new(), Vec::new(), 0);
        let (mut modules, mut steps) = (Vec::<(&'static str, Duration)>::new(), Vec::new());
        for first in 0..count {
            let second = (first + 1) % inputs.len();
            let camera = &item.cameras[inputs[first]];
            self.check_pair(degrees(&item.cameras[inputs[second]], camera))?;
            let pair = [&photographs[first], &photographs[second]];
            let made = snapsnap_photo::reconstruct(&self.reconstructor, pair, &|_| ());
            let mut to_world = camera.world_to_camera.inverse();
            // With several pairs, the second photograph is the first photograph of the next pair.
            let (mut gaussians, origins) = self.thinned(made.gaussians.clone(), &made.origins, count > 1);
            if let Some(frames) = frames {
                // With several pairs, the second photograph shows a neighbouring view, not the back.
                let (other, back) =
                    if count == 1 { (item.cameras[inputs[1]], 1) } else { (camera.turned(180.0), first) };
                let mappings = [first, back].map(|i| &frames[i].mapping);
                let restoration = Restoration::to_cameras([camera, &other], mappings, side as u32);
                gaussians = restoration.person(gaussians, &origins);
                to_world = restoration.front.world_to_camera.inverse();
            }
            parts.push(placed(self.reconstructor.config(), gaussians, &to_world));
            lost += made.lost;
            for (name, time) in &made.times {
                match modules.iter_mut().find(|(module, _)| module == name) {
                    Some((_, sum)) => *sum += *time,
                    None => modules.push((*name, *time)),
                }
            }
            // Pixels of placed photographs have no ground truth.
            if count == 1 && frames.is_none() {
                let of_view = made.points.host.chunks_exact(3 * side * side).map(<[f32]>::to_vec);
                maps = made.views.iter().map(|view| *view as usize).zip(of_view).collect();
            }
            // All pairs run the same steps.
            if first == 0 {
                steps = made.steps;
            }
        }
        if count > 1 {
            steps.insert(0, Step::Pairs { pairs: count });
        }
        let gaussians = Gaussians::joined(&parts);
        gaussians.device().sync().expect("the device finishes its work");
        let time = start.elapsed();
        if gaussians.is_empty() {
            return Err(no_gaussian());
        }
        Ok(Made { gaussians, maps, lost, masks: None, time, modules, steps })
    }

    /// The Gaussians that stride, least opacity and `only_front` (the first photograph's) keep, and their origins.
    fn thinned(&self, person: Gaussians, origins: &[Origin], only_front: bool) -> (Gaussians, Vec<Origin>) {
        let Variant { stride, min_opacity, .. } = self.variant;
        let (stride, min_opacity) = (stride.unwrap_or(1), min_opacity.unwrap_or(0.0));
        if stride == 1 && min_opacity <= 0.0 && !only_front {
            return (person, origins.to_vec());
        }
        let (side, opacities) = (self.side(), host(person.opacities.clone()));
        let is_kept = |row: &usize| {
            let Origin { view, pixel } = origins[*row];
            let on_grid =
                [pixel as usize / side, pixel as usize % side].iter().all(|at| at.is_multiple_of(stride));
            on_grid && opacities[*row] >= min_opacity && !(only_front && view != Some(View::Front))
        };
        let keep: Vec<i32> = (0..origins.len()).filter(is_kept).map(|row| row as i32).collect();
        let kept = keep.iter().map(|row| origins[*row as usize]).collect();
        let gaussians = rows(&person, &keep);
        (Gaussians { scales: gaussians.scales * stride as f64, ..gaussians }, kept)
    }
}

pub(super) fn no_gaussian() -> EvalError {
    EvalError::new("no Gaussian came out")
}
