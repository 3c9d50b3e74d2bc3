//! Stage 1: the point predictor is trained on the true points of four views
//! (docs/method.md, "Losses of stage 1").

use std::sync::Arc;

use burn::data::dataloader::batcher::Batcher;
use burn::data::dataset::Dataset;
use burn::tensor::Device;
use image::RgbImage;
use snapsnap_data::dataset::{Folder, Split};
use snapsnap_data::sample::{Joined, Stage1, Stage1Batch, Stage1Batcher, Stage1Item};
use snapsnap_net::config::Config;
use snapsnap_net::network::{PointMap, View};
use snapsnap_ops::host;

use crate::TrainError;
use crate::config::TrainConfig;
use crate::fixed::{Fixed, check_resolution};
use crate::networks::Networks;
use crate::points::{Prediction, losses, predict};
use crate::task::{Moment, Part, Task, Validation};
use snapsnap_eval::points::{Pair, point_errors};
use snapsnap_eval::preview::{grid, heat, picture};

/// Samples of a preview.
const PREVIEWS: usize = 2;
/// Error in metres that is white in previews.
const WORST: f32 = 0.2;

/// The training of the point predictor.
pub struct PointTask {
    networks: Config,
    /// λ.
    confidence: f64,
    sets: Vec<Stage1>,
    validation: Fixed<Stage1Item>,
    /// Training devices, with gradients.
    devices: Vec<Device>,
    /// Device of validations.
    device: Device,
}

impl PointTask {
    /// A training on these data sets and devices. There must be at least one device, and devices must have gradients.
    ///
    /// # Errors
    /// [`TrainError`] if a data set cannot be used with this config.
    pub fn new(
        folders: &[Arc<Folder>],
        config: &TrainConfig,
        devices: &[Device],
    ) -> Result<Self, TrainError> {
        let mut sets = Vec::new();
        for folder in folders {
            check_resolution(folder, config)?;
            sets.push(Stage1::new(folder.clone(), Some(Split::Train), config.samples())?);
        }
        let validation = Fixed::new(folders, config, |folder, split, samples| {
            Ok(Box::new(Stage1::new(folder, split, samples)?))
        })?;
        Ok(Self {
            networks: config.networks(),
            confidence: config.stage1.confidence_weight,
            sets,
            validation,
            devices: devices.to_vec(),
            device: devices[0].clone().inner(),
        })
    }

    /// Number of samples of a validation.
    pub fn validation_samples(&self) -> usize {
        self.validation.count
    }

    fn predict(&self, networks: &Networks, batch: &Stage1Batch) -> Prediction {
        let predictor = networks.predictor.as_ref().expect("stage 1 trains the predictor");
        predict(predictor, &self.networks, batch.images.clone(), &batch.masks)
    }
}

impl Task for PointTask {
    type Item = Stage1Item;
    const STAGE: u32 = 1;

    fn samples(&self, pass: u64) -> Joined<Stage1Item> {
        let sets = self.sets.iter().map(|set| Box::new(set.with_epoch(pass)) as Box<dyn Dataset<_>>);
        Joined::new(sets.collect())
    }

    fn name(item: &Stage1Item) -> &str {
        &item.name
    }

    fn losses(
        &self,
        networks: &Networks,
        items: Vec<Stage1Item>,
        at: Moment,
    ) -> Result<Vec<Part>, TrainError> {
        let batch = Stage1Batcher.batch(items, &self.devices[at.device]);
        let losses = losses(&self.predict(networks, &batch), &batch.points, &batch.valid);
        Ok(vec![
            Part { name: "points", weight: 1.0, value: losses.regression },
            Part { name: "confidence", weight: self.confidence, value: losses.confidence },
        ])
    }

    fn validate(&self, networks: &Networks) -> Result<Option<Validation>, TrainError> {
        if self.validation.count == 0 {
            return Ok(None);
        }
        let mut errors = Errors::default();
        for index in self.validation.indices(self.validation.count) {
            let item = self.validation.get(index)?;
            let batch = Stage1Batcher.batch(vec![item.clone()], &self.device);
            errors.add(
                &item,
                &self.predict(networks, &batch).on_canvas(&self.networks.network, &batch.masks),
                self.networks.network.conf_threshold,
            );
        }
        Ok(Some(errors.validation()))
    }

    fn preview(&self, networks: &Networks) -> Result<Option<RgbImage>, TrainError> {
        let mut rows: Vec<Vec<RgbImage>> = Vec::new();
        for (place, index) in self.validation.indices(PREVIEWS).enumerate() {
            let item = self.validation.get(index)?;
            let (side, area) = (item.side, item.side * item.side);
            let batch = Stage1Batcher.batch(vec![item.clone()], &self.device);
            let maps = self.predict(networks, &batch).on_canvas(&self.networks.network, &batch.masks);
            for (row, (view, map)) in maps.iter().enumerate() {
                let (points, conf) = (host(map.points.clone()), host(map.conf.clone()));
                let view = *view as usize;
                let truth = |i: usize| at(&item.points, view * area + i);
                let there = |i: usize| item.valid[view * area + i] > 0.5;
                let threshold = self.networks.network.conf_threshold;
                let seen =
                    |i: usize| if view < 2 { item.masks[view * area + i] > 0.5 } else { conf[i] > threshold };
                let photo = |i: usize| match view {
                    0 | 1 => [0, 1, 2].map(|c| item.images[(3 * view + c) * area + i] * 0.5 + 0.5),
                    _ => [1.0; 3],
                };
                let shown = |there: bool, p: [f32; 3]| if there { place_color(p) } else { [0.0; 3] };
                let error = |i: usize| if there(i) { distance(at(&points, i), truth(i)) } else { 0.0 };
                let pictures = [
                    picture(side, photo),
                    picture(side, |i| shown(seen(i), at(&points, i))),
                    picture(side, |i| shown(there(i), truth(i))),
                    picture(side, |i| heat(error(i), WORST)),
                ];
                if place == 0 {
                    rows.push(Vec::new());
                }
                if let Some(row) = rows.get_mut(row) {
                    row.extend(pictures);
                }
            }
        }
        Ok(grid(&rows))
    }
}

fn at(points: &[f32], i: usize) -> [f32; 3] {
    [points[3 * i], points[3 * i + 1], points[3 * i + 2]]
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>().sqrt()
}

/// Colour of a point in the front camera's frame. In the published cameras the body is two metres away.
fn place_color([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x / 1.8 + 0.5, y / 1.8 + 0.5, (z - 2.0) / 0.8 + 0.5]
}

/// Distances between predicted and true points, as sums over people.
#[derive(Default)]
struct Errors {
    /// Per view: number of people, mean distances in metres, and mean distances without each person's mean shift.
    views: [[f64; 3]; 4],
    /// Numbers of side pixels in the intersection and in the union of prediction and ground truth.
    overlap: [f64; 2],
}

impl Errors {
    fn add(&mut self, item: &Stage1Item, maps: &[(View, PointMap)], threshold: f32) {
        let area = item.side * item.side;
        let maps: Vec<_> = maps
            .iter()
            .map(|(view, map)| (*view as usize, host(map.points.clone()), host(map.conf.clone())))
            .collect();
        let pairs: Vec<Pair> = maps
            .iter()
            .map(|(view, points, _)| Pair {
                view: *view,
                points,
                truth: &item.points[3 * view * area..3 * (view + 1) * area],
                valid: &item.valid[view * area..(view + 1) * area],
            })
            .collect();
        for error in point_errors(&pairs) {
            let sums = &mut self.views[error.view];
            [1.0, error.mean, error.centred].iter().zip(sums).for_each(|(v, sum)| *sum += v);
        }
        for (view, _, conf) in maps.iter().filter(|(view, ..)| *view > 1) {
            for (conf, valid) in conf.iter().zip(&item.valid[*view * area..]) {
                let (seen, there) = (*conf > threshold, *valid > 0.5);
                self.overlap[0] += f64::from(u8::from(seen && there));
                self.overlap[1] += f64::from(u8::from(seen || there));
            }
        }
    }

    fn validation(&self) -> Validation {
        const NAMES: [[&str; 2]; 4] = [
            ["front_mm", "front_centred_mm"],
            ["back_mm", "back_centred_mm"],
            ["right_mm", "right_centred_mm"],
            ["left_mm", "left_centred_mm"],
        ];
        let mut figures = Vec::new();
        let (mut sum, mut count) = (0.0, 0.0);
        for (names, [people, error, centred]) in NAMES.iter().zip(self.views) {
            if people > 0.0 {
                figures.extend([(names[0], 1e3 * error / people), (names[1], 1e3 * centred / people)]);
                sum += 1e3 * error / people;
                count += 1.0;
            }
        }
        if self.overlap[1] > 0.0 {
            figures.push(("sides_iou", self.overlap[0] / self.overlap[1]));
        }
        let mean = sum / f64::max(count, 1.0);
        figures.insert(0, ("points_mm", mean));
        Validation { score: mean, figures }
    }
}
