//! Stage 1: the point predictor is trained on the true points of its views
//! (docs/method.md, "Losses of stage 1").

use std::sync::Arc;

use burn::tensor::Device;
use glam::Vec3;
use image::RgbImage;
use serde::{Deserialize, Serialize};
use snapsnap_data::dataset::Folder;
use snapsnap_data::sample::{Stage1, Stage1Batch, Stage1Item};
use snapsnap_net::config::Config;
use snapsnap_net::network::{PointMap, View};
use snapsnap_net::steps::Record;
use snapsnap_net::{Prediction, Window};
use snapsnap_ops::host;

use crate::Result;
use crate::config::TrainConfig;
use crate::data::Data;
use crate::details;
use crate::networks::Networks;
use crate::points::losses;
use crate::ranks::Ranks;
use crate::task::{Moment, Part, Task, Validation};
use snapsnap_eval::points::{Pair, normal_error, point_errors};
use snapsnap_eval::preview::{grid, heat, picture};

/// Samples of a preview.
const PREVIEWS: usize = 2;
/// Error in metres that is white in previews.
const WORST: f32 = 0.2;

/// Index of a view, its points `[H,W,3]` and its confidences `[H,W]`.
type Map = (usize, Vec<f32>, Vec<f32>);

/// The training of the point predictor.
pub struct PointTask {
    config: TrainConfig,
    networks: Config,
    data: Data<Stage1Item>,
    /// With gradients.
    device: Device,
}

impl PointTask {
    /// A training on these data sets and a device with gradients.
    ///
    /// # Errors
    /// [`TrainError`](crate::TrainError) if a data set cannot be used with this config.
    pub fn new(folders: &[Arc<Folder>], config: &TrainConfig, device: &Device) -> Result<Self> {
        Ok(Self {
            config: config.clone(),
            networks: config.networks(),
            data: Data::new(folders, config, &config.samples(), Stage1::new)?,
            device: device.clone(),
        })
    }

    /// Predictions for people in the box `extent`.
    fn predict(&self, networks: &Networks, batch: &Stage1Batch, extent: Option<Window>) -> Prediction {
        let predictor = networks.predictor.as_ref().expect("stage 1 trains the predictor");
        let images = batch.images.clone();
        Prediction::new(predictor, &self.networks, images, &batch.masks, extent, &mut Record::default())
    }

    /// Predicted maps of a sample on the whole canvas.
    fn maps(&self, networks: &Networks, item: &Stage1Item) -> Vec<Map> {
        let batch = Stage1Batch::new(vec![item.clone()], &self.device.clone().inner());
        let prediction = self.predict(networks, &batch, Window::around_person(&item.masks, item.side));
        let maps = prediction.pasted(&self.networks.network);
        let read = |(view, map): (View, PointMap)| (view as usize, host(map.points), host(map.conf));
        maps.into_iter().map(read).collect()
    }
}

impl Task for PointTask {
    type Item = Stage1Item;
    const STAGE: u32 = 1;

    fn data(&self) -> &Data<Stage1Item> {
        &self.data
    }

    fn name(item: &Stage1Item) -> &str {
        &item.name
    }

    fn extent(&self, items: &[Stage1Item]) -> Option<Window> {
        let extents = items.iter().filter_map(|item| Window::around_person(&item.masks, item.side));
        extents.reduce(|all, extent| all.united(&extent))
    }

    fn losses(&self, networks: &Networks, items: Vec<Stage1Item>, at: Moment) -> Result<Vec<Part>> {
        let batch = Stage1Batch::new(items, &self.device);
        let weights = &self.config.stage1;
        if weights.only_details {
            let predictor = networks.predictor.as_ref().expect("stage 1 trains the predictor");
            let seed = self.config.training.seed;
            return Ok(details::losses(predictor, &self.networks, weights, &batch, seed, &at));
        }
        let prediction = self.predict(networks, &batch, at.extent);
        Ok(losses(&prediction, &batch.points, &batch.valid, weights.relief_weight))
    }

    fn validate(&self, networks: &Networks, ranks: &Ranks) -> Result<Option<Validation>> {
        if self.data.count == 0 {
            return Ok(None);
        }
        let all = self.data.validated(ranks, |errors: &mut Errors, item| {
            errors.add(&item, &self.maps(networks, &item), self.networks.network.conf_threshold);
            Ok(())
        })?;
        Ok(Some(all.iter().fold(Errors::default(), |sum, errors| sum.plus(errors)).validation()))
    }

    fn preview(&self, networks: &Networks) -> Result<Option<RgbImage>> {
        let mut rows: Vec<Vec<RgbImage>> = Vec::new();
        for item in self.data.validation(PREVIEWS) {
            let item = item?;
            let (side, area) = (item.side, item.side * item.side);
            let maps = self.maps(networks, &item);
            rows.resize(maps.len(), Vec::new());
            for ((view, points, conf), row) in maps.into_iter().zip(&mut rows) {
                let at = |points: &[f32], i: usize| Vec3::from_slice(&points[3 * i..]);
                let (true_points, valid) = item.truth(view).unwrap_or_default();
                let there = |i: usize| valid.get(i).is_some_and(|valid| *valid > 0.5);
                let truth = |i: usize| if there(i) { at(true_points, i) } else { Vec3::ZERO };
                let threshold = self.networks.network.conf_threshold;
                let seen =
                    |i: usize| if view < 2 { item.masks[view * area + i] > 0.5 } else { conf[i] > threshold };
                let photo = |i: usize| match view {
                    0 | 1 => [0, 1, 2].map(|c| item.images[(3 * view + c) * area + i] * 0.5 + 0.5),
                    _ => [1.0; 3],
                };
                let shown = |there: bool, p: Vec3| if there { place_color(p) } else { [0.0; 3] };
                let error = |i: usize| if there(i) { at(&points, i).distance(truth(i)) } else { 0.0 };
                row.extend([
                    picture([side; 2], photo),
                    picture([side; 2], |i| shown(seen(i), at(&points, i))),
                    picture([side; 2], |i| shown(there(i), truth(i))),
                    picture([side; 2], |i| heat(error(i), WORST)),
                ]);
            }
        }
        let names = networks.predictor.as_ref().map_or(&[][..], |predictor| predictor.views());
        let names: Vec<&str> = names.iter().map(|view| view.name()).collect();
        let note = format!("rows: {}; white errors: {:.0} cm or more", names.join(", "), 100.0 * WORST);
        Ok(grid(&rows, &["photo", "points", "truth", "error"], &note))
    }
}

/// Colour of a point in the front camera's frame. In the published cameras the body is two metres away.
fn place_color(p: Vec3) -> [f32; 3] {
    [p.x / 1.8 + 0.5, p.y / 1.8 + 0.5, (p.z - 2.0) / 0.8 + 0.5]
}

/// Distances between predicted and true points, as sums over people.
#[derive(Clone, Default, Serialize, Deserialize)]
struct Errors {
    /// Per view: number of people, mean distances in metres, and mean distances without each person's mean shift.
    views: [[f64; 3]; 6],
    /// Number of maps of photographs with normals, and their mean errors in degrees.
    normals: [f64; 2],
    /// Numbers of side pixels in the intersection and in the union of prediction and ground truth.
    overlap: [f64; 2],
}

impl Errors {
    fn add(&mut self, item: &Stage1Item, maps: &[Map], threshold: f32) {
        let area = item.side * item.side;
        let pairs: Vec<Pair> = maps
            .iter()
            .filter_map(|(view, points, _)| {
                let (truth, valid) = item.truth(*view)?;
                Some(Pair { view: *view, points, truth, valid })
            })
            .collect();
        for error in point_errors(&pairs) {
            let sums = &mut self.views[error.view];
            [1.0, error.mean, error.centred].iter().zip(sums).for_each(|(v, sum)| *sum += v);
        }
        for degrees in pairs.iter().take(2).filter_map(|pair| normal_error(pair, item.side)) {
            [1.0, degrees].iter().zip(&mut self.normals).for_each(|(v, sum)| *sum += v);
        }
        for (view, _, conf) in maps.iter().filter(|(view, ..)| (2..4).contains(view)) {
            for (conf, valid) in conf.iter().zip(&item.valid[*view * area..]) {
                let (seen, there) = (*conf > threshold, *valid > 0.5);
                self.overlap[0] += f64::from(u8::from(seen && there));
                self.overlap[1] += f64::from(u8::from(seen || there));
            }
        }
    }

    /// The sums over both groups of people.
    fn plus(mut self, other: &Self) -> Self {
        let own = self.views.as_flattened_mut().iter_mut().chain(&mut self.normals).chain(&mut self.overlap);
        let others = other.views.as_flattened().iter().chain(&other.normals).chain(&other.overlap);
        own.zip(others).for_each(|(sum, value)| *sum += value);
        self
    }

    fn validation(&self) -> Validation {
        const NAMES: [[&str; 2]; 6] = [
            ["front_mm", "front_centred_mm"],
            ["back_mm", "back_centred_mm"],
            ["right_mm", "right_centred_mm"],
            ["left_mm", "left_centred_mm"],
            ["right_second_mm", "right_second_centred_mm"],
            ["left_second_mm", "left_second_centred_mm"],
        ];
        let mut figures = Vec::new();
        let (mut sum, mut count) = (0.0, 0.0);
        for (view, (names, [people, error, centred])) in NAMES.iter().zip(self.views).enumerate() {
            if people > 0.0 {
                figures.extend([(names[0], 1e3 * error / people), (names[1], 1e3 * centred / people)]);
                // Second surfaces are no part of the score.
                if view < 4 {
                    sum += 1e3 * error / people;
                    count += 1.0;
                }
            }
        }
        if self.normals[0] > 0.0 {
            figures.push(("normals_degrees", self.normals[1] / self.normals[0]));
        }
        if self.overlap[1] > 0.0 {
            figures.push(("sides_iou", self.overlap[0] / self.overlap[1]));
        }
        let mean = sum / f64::max(count, 1.0);
        figures.insert(0, ("points_mm", mean));
        Validation { score: mean, figures }
    }
}
