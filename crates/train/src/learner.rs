//! Steps of a training: samples → loss → gradients → weights. This module writes no files.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use burn::data::dataset::Dataset;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use snapsnap_data::sample::{Batches, Loader};
use snapsnap_ops::host;

use crate::config::TrainConfig;
use crate::ema::Average;
use crate::identity::Identity;
use crate::networks::{Networks, Rows};
use crate::optimizer::Optimizer;
use crate::ranks::Ranks;
use crate::task::{Moment, Task};
use crate::{Result, TrainError, gradients};

/// Largest norm of all gradients together, as published. Larger gradients are scaled down to it.
const MAX_NORM: f64 = 1.0;
/// Batches that are loaded in advance.
const PREFETCH: usize = 2;

/// Progress of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
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
    pub ranks: &'a Ranks,
    /// With gradients.
    device: &'a Device,
    /// Number of values of each parameter.
    lengths: BTreeMap<String, usize>,
    /// Number of samples of a pass.
    in_pass: usize,
    /// This rank's parts of the batches of the current pass, and the number of the next one since the beginning of the
    /// run.
    open: Option<(Batches<T::Item>, u64)>,
}

/// Reason of a skipped step, with its samples.
pub(crate) type Skipped = String;

impl<'a, T: Task> Learner<'a, T> {
    /// The beginning of a run. `networks` are on `device`, which has gradients.
    pub fn new(
        task: &'a T,
        config: &'a TrainConfig,
        networks: Networks,
        device: &'a Device,
        ranks: &'a Ranks,
    ) -> Self {
        let share = config.training.ema_decay;
        let lengths = networks.shapes().into_iter().map(|(name, shape)| (name, shape.iter().product()));
        Self {
            task,
            config,
            average: (share > 0.0).then(|| Average { decay: share, rows: networks.rows() }),
            optimizer: config.optimizer.init(config.mode.compat),
            lengths: lengths.collect(),
            networks,
            progress: Progress { stage: T::STAGE, ..Progress::default() },
            ranks,
            device,
            in_pass: task.data().pass(0).len(),
            open: None,
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

    /// Whether all ranks train the same networks on the same data, in the same number of steps.
    ///
    /// # Errors
    /// [`TrainError::Unsuitable`] if not.
    pub fn compare(&self, identity: &Identity) -> Result<()> {
        if self.ranks.size == 1 {
            return Ok(());
        }
        let mut hash = Sha256::new();
        for values in self.networks.checkpoint().values() {
            values.iter().for_each(|value| hash.update(value.to_le_bytes()));
        }
        // A run may change these keys between sessions, but all ranks need the same values.
        let t = &self.config.training;
        let times = [t.steps, t.validate_every, t.checkpoint_every, t.preview_every];
        let own = (identity.clone(), times, format!("{:x}", hash.finalize()), self.ranks.host.clone());
        let all = self.ranks.gather(&own);
        let (first, times, hash, host) = &all[0];
        for (rank, (there, other_times, other_hash, other_host)) in all.iter().enumerate() {
            let mut differences = first.differences(there).concat();
            if times != other_times {
                differences.push("the numbers of steps differ".to_owned());
            }
            if differences.is_empty() && hash != other_hash {
                differences.push("the weights differ: ranks need processors or cards of one kind".to_owned());
            }
            if !differences.is_empty() {
                let differences = differences.join("; ");
                let message =
                    format!("rank {rank} on {other_host} differs from rank 0 on {host}: {differences}");
                return Err(TrainError::Unsuitable(message));
            }
        }
        Ok(())
    }

    /// Makes one step. Returns its values for the log, or the reason why it was skipped. A skipped step counts as well.
    ///
    /// # Errors
    /// [`TrainError`] if the training cannot continue.
    pub fn step(&mut self) -> Result<Result<BTreeMap<String, f64>, Skipped>> {
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

    fn update(&mut self, step: u64) -> Result<Result<BTreeMap<String, f64>, Skipped>> {
        let (items, first, count) = match self.load(step) {
            Ok(loaded) => loaded,
            // The reason names the damaged file.
            Err(why) => return Ok(Err(why)),
        };
        let share = items.len() as f64 / count as f64;
        let names: Vec<String> = items.iter().map(|item| T::name(item).to_owned()).collect();
        // The whole batch decides on the window.
        let extents = self.ranks.gather(&self.task.extent(&items)).into_iter().flatten();
        let extent = extents.reduce(|all, extent| all.united(&extent));
        let (made, failed) = match self.losses(items, Moment { step, first, extent }, share) {
            // A scene that the rasteriser refuses costs the step, not the run.
            Err(TrainError::Splat(e)) => (Err(e.to_string()), None),
            Err(e) => (Err(String::new()), Some(e)),
            Ok(made) => (made, None),
        };
        self.ranks.agree(failed)?;
        let (own, sum) = match made {
            Ok((values, gradients)) => (Ok(values), gradients),
            Err(why) => (Err(of_samples(&why, &names)), Rows::new()),
        };
        let everywhere = match self.ranks.gather(&own).into_iter().collect::<Result<Vec<_>, Skipped>>() {
            Ok(everywhere) => everywhere,
            Err(why) => return Ok(Err(why)),
        };
        if everywhere.iter().all(BTreeMap::is_empty) {
            return Ok(Err(self.everywhere("the point predictor finds no pixel of a person", names)));
        }
        let mut values = BTreeMap::<String, f64>::new();
        for (name, value) in everywhere.into_iter().flatten() {
            *values.entry(name).or_default() += value;
        }
        let since = Instant::now();
        let device = self.optimizer.device(self.device.clone().inner());
        let sum = gradients::reduce(self.ranks, sum, &self.lengths, &device);
        if self.ranks.size > 1 {
            values.insert("reduce_ms".to_owned(), 1e3 * since.elapsed().as_secs_f64());
        }
        let norm = gradients::norm(&sum);
        let Some(factor) = gradients::clip_factor(norm, MAX_NORM) else {
            return Ok(Err(self.everywhere("a gradient is not finite", names)));
        };
        let share = self.config.schedule.share(step as usize, self.config.training.steps);
        let rows = self.optimizer.step(share, &self.networks, sum, factor);
        self.networks = std::mem::take(&mut self.networks).with_rows(&rows);
        if let Some(average) = &mut self.average {
            average.update(step, rows);
        }
        values.insert("rate".to_owned(), share * self.config.optimizer.rate);
        values.insert("norm".to_owned(), norm);
        Ok(Ok(values))
    }

    /// A reason that concerns the samples of all ranks. `names` are this rank's samples.
    fn everywhere(&self, why: &str, names: Vec<String>) -> Skipped {
        of_samples(why, &self.ranks.gather(&names).concat())
    }

    /// Losses and gradients of a part of a batch, times the part's share of the batch.
    fn losses(&self, items: Vec<T::Item>, at: Moment, share: f64) -> Result<Made> {
        let nothing = Ok((BTreeMap::new(), Rows::new()));
        // There may be more ranks than samples in the last batch of a pass.
        if items.is_empty() {
            return Ok(nothing);
        }
        let parts =
            self.task.losses(&self.networks.in_precision(self.config.training.precision), items, at)?;
        if parts.is_empty() {
            return Ok(nothing);
        }
        let read = host(Tensor::cat(parts.iter().map(|part| part.value.clone()).collect(), 0));
        let (mut values, mut total) = (BTreeMap::new(), 0.0);
        for (part, value) in parts.iter().zip(read) {
            values.insert(part.name.to_owned(), share * f64::from(value));
            total += part.weight * f64::from(value);
        }
        values.insert("loss".to_owned(), share * total);
        if !total.is_finite() {
            return Ok(Err("the loss is not finite".to_owned()));
        }
        let weighted = parts.into_iter().map(|part| part.value * (part.weight * share)).collect();
        let mut tracked = Tensor::cat(weighted, 0).sum().backward();
        Ok(Ok((values, gradients::collect(&self.networks, &mut tracked))))
    }

    /// Samples of this rank's part of a batch by its number since the beginning of the run, the number of the batch's
    /// samples that lower ranks have, and of all its samples; or the reason why any rank cannot load its part. The
    /// content of a batch follows from its number alone.
    fn load(&mut self, number: u64) -> Result<(Vec<T::Item>, usize, usize), Skipped> {
        let (t, ranks) = (&self.config.training, self.ranks);
        let per_pass = self.in_pass.div_ceil(t.batch).max(1) as u64;
        let (pass, place) = (number / per_pass, (number % per_pass) as usize);
        let mut open = self.open.take().filter(|(_, next)| *next == number && place > 0);
        let (batches, next) = open.get_or_insert_with(|| {
            let loader = Loader::<T::Item> {
                dataset: Arc::new(self.task.data().pass(pass)),
                batch: t.batch,
                workers: t.workers,
                prefetch: PREFETCH,
                // The published code takes people in order.
                shuffle: (!self.config.mode.compat).then_some(t.seed),
                part: [ranks.rank, ranks.size],
            };
            (loader.batches(pass, place), number)
        });
        *next += 1;
        let made = batches.next().ok_or_else(|| "the data ended early".to_owned());
        let made = made.and_then(|items| items.map_err(|e| e.to_string()));
        self.open = open;
        let reasons = ranks.gather(&made.as_ref().err().cloned());
        if let Some(why) = reasons.into_iter().flatten().next() {
            return Err(why);
        }
        let count = t.batch.min(self.in_pass - place * t.batch);
        Ok((made?, ranks.share(count).start, count))
    }
}

fn of_samples(why: &str, names: &[String]) -> Skipped {
    format!("{why} (samples: {})", names.join("; "))
}

/// Result of a batch: the loss and its parts by name, none if no sample shows a person; and the gradients. Or the reason
/// why the step is skipped, without its samples.
type Made = Result<(BTreeMap<String, f64>, Rows), String>;
