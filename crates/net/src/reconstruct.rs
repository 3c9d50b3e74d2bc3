//! Two photographs on their canvases → Gaussians in the front camera's frame (docs/method.md).

use std::time::Duration;

use burn::tensor::{Device, Tensor};
use snapsnap_ops::gather::taken;
use snapsnap_splat::{Camera, Gaussians, RigidTransform};

use crate::config::{Config, RotationFrame, WorldFrame};
use crate::network::{PointPredictor, View};
use crate::painter::{Origin, Painted, Painter};
use crate::photograph::Photograph;
use crate::points::Points;
use crate::precision::Precision;
use crate::predict::Prediction;
use crate::regressor::Regressor;
use crate::steps::{Record, Step};
use crate::weights::{WeightFile, WeightsError};

/// Gaussians in the front camera's frame, and the intermediate results.
pub struct Reconstruction {
    /// Views that were computed, in the order of the Gaussians.
    pub views: Vec<View>,
    /// Points and confidences.
    pub points: Points,
    /// Per view, `[S, S]`: whether the pixel became a Gaussian.
    pub valid: Vec<Vec<bool>>,
    /// Pseudo images of the sides' maps `[3, S, S]` in [−1, 1], −1 where there is no point.
    pub side_images: Vec<Vec<f32>>,
    /// View after view, row-major, in the front camera's frame; then the Gaussians that close the top.
    pub gaussians: Gaussians,
    /// The pixel of each Gaussian.
    pub origins: Vec<Origin>,
    /// Pixels and Gaussians that were left out because they were not finite, or farther away than 1e30 m.
    pub lost: usize,
    /// Steps that ran, and steps that were left out, with reasons.
    pub steps: Vec<Step>,
    /// Time per module, with the device synchronised before and after each.
    pub times: Vec<(&'static str, Duration)>,
}

impl Reconstruction {
    /// The Gaussians in the configured world frame.
    pub fn in_world(&self, config: &Config) -> Gaussians {
        let camera_to_world = match config.world_frame() {
            WorldFrame::Upright => {
                Camera::orbit_at_yaw_degrees(0.0, config.network.resolution as u32).world_to_camera.inverse()
            }
            // As in the published demo: the determinant is −1, so the person is mirrored.
            WorldFrame::Mirrored => RigidTransform {
                rotation: glam::DMat3::from_diagonal(glam::DVec3::NEG_ONE),
                translation: glam::DVec3::new(0.0, 0.0, 2.0),
            },
        };
        placed(config, self.gaussians.clone(), &camera_to_world)
    }

    /// Leaves Gaussians out that hang off the person's surface. `is_on` says of each whether it is on the surface.
    pub fn drop_off_surface(&mut self, is_on: &[bool]) {
        for (origin, _) in self.origins.iter().zip(is_on).filter(|(_, is_on)| !**is_on) {
            if let Some(view) = origin.view {
                self.valid[view as usize][origin.pixel as usize] = false;
            }
        }
        let keep: Vec<i32> = (0..is_on.len()).filter(|row| is_on[*row]).map(|row| row as i32).collect();
        self.gaussians = rows(&self.gaussians, &keep);
        self.origins = keep.iter().map(|row| self.origins[*row as usize]).collect();
        self.steps.push(Step::OffSurface { gaussians: is_on.len() - keep.len() });
    }
}

/// Some of the Gaussians, by their numbers.
pub fn rows(of: &Gaussians, rows: &[i32]) -> Gaussians {
    let pick = |tensor: &Tensor<2>| taken(tensor.clone(), rows);
    Gaussians {
        means: pick(&of.means),
        rotations: pick(&of.rotations),
        scales: pick(&of.scales),
        opacities: pick(&of.opacities.clone().unsqueeze_dim(1)).squeeze_dim(1),
        colors: pick(&of.colors),
    }
}

/// Moves Gaussians from the front camera's frame to the world. `mode.rotation_frame` decides about quaternions.
pub fn placed(config: &Config, gaussians: Gaussians, camera_to_world: &RigidTransform) -> Gaussians {
    match config.rotation_frame() {
        RotationFrame::Camera => gaussians.transformed(camera_to_world),
        RotationFrame::World => gaussians.with_means_transformed(camera_to_world),
    }
}

/// The networks of one weight file on one device.
pub struct Reconstructor {
    config: Config,
    predictor: PointPredictor,
    regressors: Vec<Regressor>,
    side_colors: bool,
    device: Device,
}

impl Reconstructor {
    /// Loads both parts of `weights`, with the config with which the file was opened.
    ///
    /// # Errors
    /// [`WeightsError`] if a part is absent or a value is not finite.
    pub fn load(weights: &WeightFile, device: &Device) -> Result<Self, WeightsError> {
        Ok(Self {
            config: weights.config.clone(),
            predictor: weights.point_predictor(device)?,
            regressors: weights.regressors(device)?,
            side_colors: true,
            device: device.clone(),
        })
    }

    /// Leaves the unseen sides out, with their heads, colours and Gaussians, for scenes of many photographs.
    pub fn without_sides(mut self) -> Self {
        self.predictor = self.predictor.without_sides();
        self
    }

    /// Computes the point predictor's layers in another precision.
    pub fn in_precision(mut self, precision: Precision) -> Self {
        self.predictor = precision.lower(self.predictor);
        self
    }

    /// Leaves the colours of the unseen sides out: the regressor gets −1 instead.
    pub fn without_side_colors(mut self) -> Self {
        self.side_colors = false;
        self
    }

    /// The config in force.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Turns a front and a back photograph into Gaussians. `stage` gets the name of each module before it runs.
    ///
    /// # Panics
    /// If a photograph's arrays do not have the canvas size.
    pub fn reconstruct(&self, photographs: [&Photograph; 2], stage: &dyn Fn(&'static str)) -> Reconstruction {
        let network = &self.config.network;
        let side = network.resolution;
        for (photo, name) in photographs.iter().zip(["front", "back"]) {
            let sizes = [photo.rgb.len(), photo.mask.len(), photo.valid.len()];
            let expected = [3 * side * side, side * side, side * side];
            assert_eq!(sizes, expected, "{name} photograph on a canvas of {side}²");
        }
        let mut record = Record::new(&self.device, stage);
        let prediction =
            Prediction::of_pair(&self.predictor, &self.config, photographs, &self.device, &mut record);
        let mut points = record.timed("canvas", |_| Points::new(prediction.pasted(network)));
        let painter = Painter {
            config: &self.config,
            regressors: &self.regressors,
            photographs,
            views: 0..4,
            side_colors: self.side_colors,
        };
        let Painted { gaussians, origins, valid, side_images, lost } =
            painter.gaussians(&mut points, &self.device, &mut record);
        let Record { steps, times, .. } = record;
        let views = self.predictor.views().to_vec();
        Reconstruction { views, points, valid, side_images, gaussians, origins, lost, steps, times }
    }
}
