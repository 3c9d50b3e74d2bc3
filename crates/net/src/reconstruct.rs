//! The whole inference: two photographs on their canvas → Gaussians (docs/method.md).

use std::time::{Duration, Instant};

use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use snapsnap_ops::{has_kernels, host};
use snapsnap_splat::{Camera, Gaussians, RigidTransform};

use crate::config::{Config, Downsample, WorldFrame};
use crate::crop::Window;
use crate::gaussians::{
    CanvasView, Chosen, Part, assemble, photograph_colors, placed, regress, side_images, uncorrected,
};
use crate::hull::carve;
use crate::network::{Input, PointMap, PointPredictor, View};
use crate::precision::Precision;
use crate::regressor::{Limits, Regressor};
use crate::sides::EMPTY;
use crate::top::Top;
use crate::weights::{WeightFile, WeightsError};

/// One photograph on its square canvas of `resolution` pixels; row-major, side S.
#[derive(Debug, Clone)]
pub struct Photograph {
    /// `[3, S, S]`: colours in [−1, 1] times the mask; the background is 0.
    pub rgb: Vec<f32>,
    /// `[S, S]`: share of the person in each pixel, 0 to 1.
    pub mask: Vec<f32>,
    /// `[S, S]`: whether the pixel becomes a Gaussian.
    pub valid: Vec<bool>,
}

/// Gaussians in the front camera's frame, and the intermediate results.
pub struct Reconstruction {
    /// Views that were computed, in the order of the Gaussians.
    pub views: Vec<View>,
    /// Points in metres and confidences on the canvas, one view per batch entry.
    pub maps: PointMap,
    /// Per view, `[S, S]`: whether the pixel became a Gaussian.
    pub valid: Vec<Vec<bool>>,
    /// Pseudo images of the sides' maps `[3, S, S]` in [−1, 1], −1 where there is no point.
    pub side_images: Vec<Vec<f32>>,
    /// The Gaussians, view after view, row-major, in the front camera's frame; then those that close the top.
    pub gaussians: Gaussians,
    /// Pixels and Gaussians that were left out because they were not finite, or farther away than 1e30 m.
    pub lost: usize,
    /// The Gaussians among them.
    pub lost_gaussians: usize,
    /// Steps that ran, and steps that were left out, with reasons.
    pub plan: Vec<String>,
    /// Time per module, the device synchronised before and after each.
    pub times: Vec<(&'static str, Duration)>,
}

impl Reconstruction {
    /// How many of the first Gaussians are pixels of the front, and how many after them of the back. `[0, 0]` if Gaussians were left
    /// out, since the pixels of the others are not known then.
    pub fn photographed(&self) -> [usize; 2] {
        let count = |valid: &Vec<bool>| valid.iter().filter(|valid| **valid).count();
        if self.lost_gaussians > 0 {
            [0, 0]
        } else {
            [0, 1].map(|view| self.valid.get(view).map_or(0, count))
        }
    }

    /// The Gaussians in the configured world frame.
    pub fn in_world(&self, config: &Config) -> Gaussians {
        let gaussians = self.gaussians.clone();
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
        placed(config, gaussians, &camera_to_world)
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

    /// Leaves the colours of the unseen sides out: the regressor gets [`EMPTY`] instead.
    pub fn without_side_colors(mut self) -> Self {
        self.side_colors = false;
        self
    }

    /// The config in force.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Turns a front and a back photograph into Gaussians. `stage` is called with the name of each module before it runs.
    ///
    /// # Panics
    /// If a photograph's arrays do not have the canvas size.
    pub fn reconstruct(
        &self,
        front: &Photograph,
        back: &Photograph,
        stage: &dyn Fn(&'static str),
    ) -> Reconstruction {
        let side = self.config.network.resolution;
        for (photo, name) in [(front, "front"), (back, "back")] {
            let sizes = [photo.rgb.len(), photo.mask.len(), photo.valid.len()];
            assert_eq!(
                sizes,
                [3 * side * side, side * side, side * side],
                "{name} photograph on a canvas of {side}²"
            );
        }
        let mut run =
            Run { model: self, stage, side, lost_gaussians: 0, plan: Vec::new(), times: Vec::new() };
        run.reconstruct([front, back])
    }
}

struct Run<'a> {
    model: &'a Reconstructor,
    stage: &'a dyn Fn(&'static str),
    side: usize,
    /// Gaussians that are not finite.
    lost_gaussians: usize,
    plan: Vec<String>,
    times: Vec<(&'static str, Duration)>,
}

impl Run<'_> {
    fn timed<T>(&mut self, name: &'static str, work: impl FnOnce(&mut Self) -> T) -> T {
        (self.stage)(name);
        self.model.device.sync().expect("the device finishes its work");
        let start = Instant::now();
        let result = work(self);
        self.model.device.sync().expect("the device finishes its work");
        self.times.push((name, start.elapsed()));
        result
    }

    fn reconstruct(&mut self, photos: [&Photograph; 2]) -> Reconstruction {
        let mut maps = self.point_maps(photos);
        let views: Vec<View> = self.model.predictor.views().to_vec();
        let (mut points, conf) =
            self.timed("reading back", |_| (host(maps.points.clone()), host(maps.conf.clone())));
        let area = self.side * self.side;
        let masks = photos.map(|photo| photo.valid.as_slice());
        if views.len() > 2 && self.model.config.network.hull_reach() > 0.0 {
            let carved = self.timed("silhouettes", |run| {
                let carved = carve(&run.model.config.network, masks, &mut points, &conf);
                if carved > 0 {
                    let data = TensorData::new(points.clone(), maps.points.dims());
                    maps.points = Tensor::from_data(data, &run.model.device);
                }
                carved
            });
            if carved > 0 {
                self.plan.push(format!("{carved} pixels of the sides moved into the silhouettes"));
            }
        }
        let Chosen { valid, lost, outside, between } =
            Chosen::new(&self.model.config.network, masks, &points, &conf);
        for (view, mask) in views.iter().zip(&valid) {
            let n = count(mask);
            self.plan.push(format!("{}: {n} of {area} pixels become Gaussians", view.name()));
        }
        if lost > 0 {
            self.plan.push(format!("{lost} pixels left out: their points are not finite"));
        }
        if outside > 0 {
            self.plan
                .push(format!("{outside} pixels of the sides left out: they lie outside of the silhouettes"));
        }

        if between > 0 {
            self.plan.push(format!("{between} pixels left out: their points hang between two surfaces"));
        }

        let colors =
            photos.map(|photo| photograph_colors(&self.model.config.regressor, &photo.rgb, &photo.mask));
        let colors = [0, 1].map(|view| &*colors[view]);
        let side_images = if views.len() > 2 && !self.model.side_colors {
            self.plan.push("side colours left out, as asked for".into());
            vec![vec![EMPTY; 3 * area]; views.len() - 2]
        } else if views.len() > 2 {
            self.timed("side colours", |_| side_images(colors, &points, &valid))
        } else {
            self.plan.push("side colours left out: there are no side heads".into());
            Vec::new()
        };

        // One value that is not finite would spoil the normalisation of a whole view.
        let usable = if points.iter().all(|v| v.is_finite()) {
            maps.points.clone()
        } else {
            let points: Vec<f32> = points.iter().map(|v| if v.is_finite() { *v } else { 0.0 }).collect();
            Tensor::from_data(TensorData::new(points, maps.points.dims()), &self.model.device)
        };
        let mut parts = self.regressed(colors, &side_images, &usable, &valid);
        if self.model.config.network.closed_top && views.len() > 2 {
            parts.extend(self.timed("closed top", |run| run.top(colors, &points, &valid)));
        }
        let gaussians = self.assembled(parts);
        let (plan, times) = (std::mem::take(&mut self.plan), std::mem::take(&mut self.times));
        let (lost, lost_gaussians) = (lost + self.lost_gaussians, self.lost_gaussians);
        Reconstruction { views, maps, valid, side_images, gaussians, lost, lost_gaussians, plan, times }
    }

    /// Point maps of all views on the canvas `[views, S, S]`, in metres.
    fn point_maps(&mut self, photos: [&Photograph; 2]) -> PointMap {
        let (config, net) = (&self.model.config, &self.model.predictor);
        let (side, factor) = (self.side, config.upsample_factor());
        let upload = |values: &[f32], channels: usize| {
            Tensor::<4>::from_data(
                TensorData::new(values.to_vec(), [1, channels, side, side]),
                &self.model.device,
            )
        };
        let window = self.predictor_window(photos);
        let (input, masks) = self.timed("input", |_| {
            let images = Tensor::cat(photos.map(|p| upload(&p.rgb, 3)).to_vec(), 0);
            let masks = Tensor::cat(photos.map(|p| upload(&p.mask, 1)).to_vec(), 0);
            (Input::new(config, images, masks.clone(), &window), masks)
        });
        let [_, channels, height, width] = input.images.dims();
        self.plan.push(format!(
            "point predictor: 2 photographs of {width}×{height} ({} of {window}{}), {} tokens each, {channels} channels",
            match config.downsample() {
                _ if factor == 1 => "as they are instead",
                Downsample::Area => "area means",
                Downsample::Nearest => "every first pixel",
            },
            if window == Window::whole(side) { "" } else { ", the person's window" },
            input.grid.tokens(),
        ));
        if input.grid.kept.is_some() {
            let all: usize = input.grid.size.iter().product();
            self.plan
                .push(format!("{} of {all} tokens left out: they show no person", all - input.grid.tokens()));
        }
        let images = input.images.clone();
        let encoded = self.timed("encoder", |_| net.encode(input));
        let decoded = self.timed("decoders", |_| net.decode(encoded));
        let heads = if net.has_side_heads() { "heads (4)" } else { "heads (2)" };
        let maps = self.timed(heads, |_| net.heads(&decoded));
        let maps = match maps.len() < net.views().len() {
            true => self.timed("completed sides", |_| net.complete(maps, &decoded, &images, &window)),
            false => maps,
        };
        self.timed("up-sampling", |_| {
            let enlarge = |(view, map): (View, PointMap)| {
                let mask = ((view as usize) < 2).then(|| masks.clone().narrow(0, view as usize, 1));
                let map = net.finished(config, view, map, &window, mask.as_ref());
                let map = map.pasted(&config.network, view, &window, mask.as_ref());
                (map.points, map.conf)
            };
            // On a CPU, each of these operations runs on one thread.
            let (points, conf): (Vec<_>, Vec<_>) = match has_kernels(&masks) {
                true => maps.into_par_iter().map(enlarge).unzip(),
                false => maps.into_iter().map(enlarge).unzip(),
            };
            PointMap { points: Tensor::cat(points, 0), conf: Tensor::cat(conf, 0) }
        })
    }

    /// The window that the point predictor receives.
    fn predictor_window(&self, photos: [&Photograph; 2]) -> Window {
        let config = &self.model.config;
        let masks = photos.map(|photo| photo.mask.iter().map(|m| *m > 0.0).collect::<Vec<_>>());
        Window::of_predictor(
            config,
            Window::around(masks.iter().map(Vec::as_slice), config.network.resolution),
        )
    }

    /// Features of all valid pixels, view after view.
    fn regressed(
        &mut self,
        colors: [&[f32]; 2],
        side_images: &[Vec<f32>],
        points: &Tensor<4>,
        valid: &[Vec<bool>],
    ) -> Vec<Part> {
        let images: Vec<&[f32]> = colors.into_iter().chain(side_images.iter().map(Vec::as_slice)).collect();
        let mut parts = Vec::new();
        for (pair, what) in ["regressor (front, back)", "regressor (sides)", "regressor (second surfaces)"]
            .into_iter()
            .enumerate()
        {
            let pair_views = 2 * pair..(2 * pair + 2).min(images.len());
            if pair_views.is_empty() {
                continue;
            }
            let Some(person) = Window::around(valid[pair_views.clone()].iter().map(Vec::as_slice), self.side)
            else {
                self.plan.push(format!("{what} left out: no pixel of these views is valid"));
                continue;
            };
            let window = if self.model.config.crop() {
                person.padded(self.model.config.regressor.margin(), self.side)
            } else {
                Window::whole(self.side)
            };
            self.plan
                .push(format!("{what}: {window} of {0}×{0} pixels each, person's box {person}", self.side));
            let network = &self.model.regressors[pair.min(self.model.regressors.len() - 1)];
            let part = self.timed(what, |run| {
                let views: Vec<_> = pair_views
                    .clone()
                    .map(|v| CanvasView {
                        image: images[v],
                        points: points.clone().narrow(0, v, 1),
                        valid: &valid[v],
                    })
                    .collect();
                regress(network, &run.model.config, pair, &views, &window)
            });
            parts.extend(part);
        }
        parts
    }

    /// The surface between the upper edges of front and back.
    fn top(&mut self, colors: [&[f32]; 2], points: &[f32], valid: &[Vec<bool>]) -> Option<Part> {
        let (side, config) = (self.side, &self.model.config);
        let points = [0, 1].map(|view| &points[view * 3 * side * side..][..3 * side * side]);
        let top = Top::new(colors, points, [&valid[0], &valid[1]], side)?;
        self.plan.push(format!(
            "closed top: {} Gaussians between the upper edges of front and back",
            count(&top.valid)
        ));
        let points = Tensor::from_data(TensorData::new(top.points, [1, side, side, 3]), &self.model.device);
        let view = CanvasView { image: &top.image, points, valid: &top.valid };
        Some(uncorrected(&view, Limits::of(&config.regressor, 0)))
    }

    fn assembled(&mut self, parts: Vec<Part>) -> Gaussians {
        self.timed("activations", |run| {
            let (gaussians, lost) = assemble(&run.model.config, parts, &run.model.device);
            run.plan.push(format!("{} Gaussians", gaussians.len()));
            run.lost_gaussians = lost;
            if lost > 0 {
                run.plan.push(format!("{lost} Gaussians left out: their attributes are not finite"));
            }
            gaussians
        })
    }
}

fn count(mask: &[bool]) -> usize {
    mask.iter().filter(|v| **v).count()
}
