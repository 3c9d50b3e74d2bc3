//! Steps of a training: samples → loss → gradients → weights. This module writes no files.

use std::collections::BTreeMap;
use std::panic::resume_unwind;
use std::thread;

use burn::data::dataset::Dataset;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};
use snapsnap_data::sample::{Batches, Loader};
use snapsnap_ops::host;

use crate::config::TrainConfig;
use crate::ema::Average;
use crate::networks::{Networks, Rows};
use crate::optimizer::Optimizer;
use crate::precision::{LossScale, Precision, lower};
use crate::task::{Moment, Task};
use crate::{TrainError, gradients};

/// Progress of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Stage of the training, 1 or 2.
    pub stage: u32,
    /// Steps so far, including skipped ones.
    pub step: u64,
    /// Steps that were skipped because a loss or gradient was not finite, or because a sample could not be read.
    pub skipped: u64,
    /// Skipped steps since the last one that was made.
    pub skipped_in_a_row: u64,
    /// Step of the best validation, and the bits of its score, since decimals might round it.
    pub best: Option<(u64, u64)>,
    /// Step after which the final validation and preview were made; 0 before.
    #[serde(default)]
    pub shown: u64,
    /// Scale of the loss, in f16.
    pub loss_scale: Option<LossScale>,
    /// Number of AdamW's steps by parameter.
    pub times: BTreeMap<String, u64>,
}

/// A training's networks, optimiser and progress.
pub(crate) struct Learner<'a, T: Task> {
    pub task: &'a T,
    pub config: &'a TrainConfig,
    pub networks: Networks,
    pub average: Option<Average>,
    pub optimizer: Optimizer,
    pub progress: Progress,
    /// Training devices, with gradients.
    devices: &'a [Device],
    samples: Samples<'a, T>,
}

/// Reason of a skipped step, with its samples.
pub(crate) type Skipped = String;

impl<'a, T: Task> Learner<'a, T> {
    /// The beginning of a run. `networks` are on the first device.
    pub fn new(task: &'a T, config: &'a TrainConfig, networks: Networks, devices: &'a [Device]) -> Self {
        let share = config.training.ema_decay;
        Self {
            task,
            config,
            average: (share > 0.0).then(|| Average::new(share, networks.rows())),
            optimizer: config.optimizer.init(),
            networks,
            progress: Progress { stage: T::STAGE, ..Progress::default() },
            devices,
            samples: Samples::new(task, config),
        }
    }

    /// The averaged networks, or the networks themselves, without gradients.
    pub fn averaged(&self) -> Networks {
        let networks = self.networks.valid();
        match &self.average {
            Some(average) => networks.with_rows(&average.rows),
            None => networks,
        }
    }

    /// Makes one step. Returns its values for the log, or the reason why it was skipped. A skipped step counts as well.
    ///
    /// # Errors
    /// [`TrainError`] if the training cannot continue.
    pub fn step(&mut self) -> Result<Result<BTreeMap<String, f64>, Skipped>, TrainError> {
        let step = self.progress.step;
        let made = self.update(step)?;
        self.progress.step += 1;
        if made.is_ok() {
            self.progress.skipped_in_a_row = 0;
        } else {
            self.progress.skipped += 1;
            self.progress.skipped_in_a_row += 1;
        }
        Ok(made)
    }

    fn update(&mut self, step: u64) -> Result<Result<BTreeMap<String, f64>, Skipped>, TrainError> {
        let t = &self.config.training;
        let scale = &mut self.progress.loss_scale;
        *scale = (self.config.precision() == Precision::F16).then(|| scale.unwrap_or_default());
        let scale = scale.map_or(1.0, |scale| scale.factor);
        let (mut sum, mut values) = (Rows::new(), BTreeMap::<String, f64>::new());
        let mut all: Vec<String> = Vec::new();
        let skipped = |why: &str, all: &[String]| Ok(Err(format!("{why} (samples: {})", all.join("; "))));
        for batch in 0..t.accumulate {
            let items = match self.samples.get(step * t.accumulate as u64 + batch as u64) {
                Ok(items) => items,
                // The reason names the damaged file.
                Err(why) => return Ok(Err(why)),
            };
            all.extend(items.iter().map(|item| T::name(item).to_owned()));
            let at = Moment { step, batch: batch as u64, device_index: 0 };
            let how = How { precision: self.config.precision(), scale, share: 1.0 / t.accumulate as f64 };
            let made = match on_devices(self.task, &self.networks, self.devices, items, at, how) {
                // A scene that the rasteriser refuses costs the sample, not the run.
                Err(TrainError::Splat(e)) => return skipped(&e.to_string(), &all),
                made => made?,
            };
            if made.values.is_empty() {
                return skipped("no pixel is part of a person, as the point predictor sees it", &all);
            }
            for (name, value) in &made.values {
                *values.entry((*name).to_owned()).or_default() += value;
            }
            match made.gradients {
                Some(gradients) => gradients::add(&mut sum, gradients),
                None => return skipped("the loss is not finite", &all),
            }
        }
        let norm = gradients::norm(&sum);
        let clipped = gradients::clip_factor(norm, t.clip);
        if let Some(scale) = &mut self.progress.loss_scale {
            scale.update(clipped.is_some());
        }
        let Some(factor) = clipped else {
            return skipped("a gradient is not finite", &all);
        };
        let share = self.config.schedule.share(step as usize, t.steps);
        let networks = std::mem::take(&mut self.networks);
        self.networks = self.optimizer.step(share, networks, sum, factor);
        if let Some(average) = &mut self.average {
            average.update(step, self.networks.rows());
        }
        values.insert("rate".to_owned(), share * self.config.optimizer.rate);
        values.insert("norm".to_owned(), norm);
        Ok(Ok(values))
    }
}

/// Result of a batch: the loss and its parts by name, none if no sample shows a person; and the gradients, unless a
/// loss was not finite.
struct Made {
    values: BTreeMap<&'static str, f64>,
    gradients: Option<Rows>,
}

/// Numerical settings of a batch.
#[derive(Debug, Clone, Copy)]
struct How {
    precision: Precision,
    /// Factor of the loss, by which its gradients are divided.
    scale: f64,
    /// The batch's share of its step.
    share: f64,
}

/// Loss and gradients of a batch, times its share. Several devices compute equal parts of the batch at once, and the
/// first device averages losses and gradients. (Burn has collectives for CUDA only. Copies work on every device.)
fn on_devices<T: Task>(
    task: &T,
    networks: &Networks,
    devices: &[Device],
    mut items: Vec<T::Item>,
    at: Moment,
    how: How,
) -> Result<Made, TrainError> {
    if devices.len() == 1 {
        return on_device(task, networks, items, at, how);
    }
    let (all, size) = (items.len() as f64, items.len().div_ceil(devices.len()));
    let mut parts = Vec::new();
    while !items.is_empty() {
        let rest = items.split_off(size.min(items.len()));
        parts.push(std::mem::replace(&mut items, rest));
    }
    let made: Vec<Result<Made, TrainError>> = thread::scope(|scope| {
        let start = |(place, part): (usize, Vec<T::Item>)| {
            scope.spawn(move || {
                let (device, share) = (&devices[place], how.share * part.len() as f64 / all);
                let (at, how) = (Moment { device_index: place, ..at }, How { share, ..how });
                on_device(task, &networks.clone().fork(device), part, at, how)
            })
        };
        let threads: Vec<_> = parts.into_iter().enumerate().map(start).collect();
        let ended = threads.into_iter().map(|thread| thread.join().unwrap_or_else(|e| resume_unwind(e)));
        ended.collect()
    });
    let first = devices[0].clone().inner();
    let mut total = Made { values: BTreeMap::new(), gradients: Some(Rows::new()) };
    for made in made {
        let made = made?;
        for (name, value) in made.values {
            *total.values.entry(name).or_default() += value;
        }
        total.gradients = match (total.gradients.take(), made.gradients) {
            (Some(mut sum), Some(rows)) => {
                let there = rows.into_iter().map(|(name, row)| (name, row.to_device(&first)));
                gradients::add(&mut sum, there.collect());
                Some(sum)
            }
            _ => None,
        };
    }
    Ok(total)
}

fn on_device<T: Task>(
    task: &T,
    networks: &Networks,
    items: Vec<T::Item>,
    at: Moment,
    How { precision, scale, share }: How,
) -> Result<Made, TrainError> {
    let parts = task.losses(&lower(precision, networks), items, at)?;
    if parts.is_empty() {
        return Ok(Made { values: BTreeMap::new(), gradients: Some(Rows::new()) });
    }
    let read = host(Tensor::cat(parts.iter().map(|part| part.value.clone()).collect(), 0));
    let (mut values, mut total) = (BTreeMap::new(), 0.0);
    for (part, value) in parts.iter().zip(read) {
        values.insert(part.name, share * f64::from(value));
        total += part.weight * f64::from(value);
    }
    values.insert("loss", share * total);
    if !total.is_finite() {
        return Ok(Made { values, gradients: None });
    }
    let weighted = parts.into_iter().map(|part| part.value * (part.weight * share * scale)).collect();
    let mut tracked = Tensor::cat(weighted, 0).sum().backward();
    let mut rows = gradients::collect(networks, &mut tracked);
    if scale != 1.0 {
        rows.values_mut().for_each(|row| *row = row.clone() / scale);
    }
    Ok(Made { values, gradients: Some(rows) })
}

/// Batches of all passes.
struct Samples<'a, T: Task> {
    task: &'a T,
    config: &'a TrainConfig,
    /// Number of batches of a pass.
    per_pass: u64,
    /// The current pass, and the number of its next batch since the beginning of the run.
    open: Option<(Batches<T::Item>, u64)>,
}

impl<'a, T: Task> Samples<'a, T> {
    fn new(task: &'a T, config: &'a TrainConfig) -> Self {
        let per_pass = task.data().pass(0).len().div_ceil(config.training.batch).max(1) as u64;
        Self { task, config, per_pass, open: None }
    }

    /// A batch by its number since the beginning of the run, or the reason why it cannot be loaded. Its content follows
    /// from the number alone.
    fn get(&mut self, number: u64) -> Result<Vec<T::Item>, String> {
        let (pass, place) = (number / self.per_pass, number % self.per_pass);
        let mut open = self.open.take().filter(|(_, next)| *next == number && place > 0);
        let (batches, next) = open.get_or_insert_with(|| {
            let t = &self.config.training;
            let loader = Loader::new(self.task.data().pass(pass), t.batch, t.workers, t.prefetch);
            let loader = if t.shuffle { loader.shuffled(t.seed) } else { loader };
            (loader.batches(pass, place as usize), number)
        });
        *next += 1;
        let made = batches.next();
        self.open = open;
        made.ok_or("the data ended early")?.map_err(|e| e.to_string())
    }
}
