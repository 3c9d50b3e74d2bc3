//! The state of a run in one file, written whole or not at all: weights, averages, the optimiser's state and the
//! progress. Everything random follows from the seed and the step.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use snapsnap_base::FileError;
use snapsnap_net::config::Precision;
use snapsnap_net::weights::{Source, not_finite, write_tensors};
use snapsnap_ops::host;

use crate::config::MAX_STEPS;
use crate::identity::Identity;
use crate::learner::{Learner, Progress};
use crate::networks::{Rows, row};
use crate::task::Task;
use crate::{Result, TrainError};

/// Metadata key of the record, as JSON.
const RECORD_KEY: &str = "snapsnap.training";

/// The metadata of a state. One key, since the order of several keys in a file is random.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Record {
    progress: Progress,
    run: Identity,
}

/// Writes the state of a run. After an error, the former file stays.
pub(crate) fn save<T: Task>(path: &Path, learner: &Learner<T>, identity: &Identity) -> Result<()> {
    let (mut rows, times) = learner.optimizer.record();
    let progress = Progress { times, ..learner.progress.clone() };
    let mut add = |kind: &str, new: Rows| {
        rows.extend(new.into_iter().map(|(name, row)| (format!("{kind}/{name}"), row)));
    };
    add("weight", learner.networks.rows());
    if let Some(average) = &learner.average {
        add("average", average.rows.clone());
    }
    let record = Record { progress, run: identity.clone() };
    let text = serde_json::to_string(&record).expect("plain numbers and text");
    let metadata = HashMap::from([(RECORD_KEY.to_owned(), text)]);
    let names = rows.iter().map(|(name, row)| (name.clone(), row.dims().to_vec())).collect();
    // Only one row at a time is copied to the host.
    let rows: Vec<_> = rows.into_values().collect();
    let values = |i: usize| Ok(host(rows[i].clone()));
    let what = "the state of the training";
    Ok(write_tensors(path, what, metadata, names, Precision::F32, values, &|_, _| ())?)
}

/// Restores a learner of the same networks from the state of a run, and returns the run's identity.
pub(crate) fn load<T: Task>(path: &Path, learner: &mut Learner<T>, device: &Device) -> Result<Identity> {
    let wrong = |message: String| TrainError::from(FileError::unsuitable(path, message));
    let source = Source::open(path)?;
    let text = source.metadata.get(RECORD_KEY).ok_or_else(|| wrong("is no state of a training".into()))?;
    let Record { progress, run } =
        serde_json::from_str(text).map_err(|e| wrong(format!("{RECORD_KEY}: {e}")))?;
    if progress.stage != T::STAGE {
        return Err(wrong(format!("is of stage {}, not of stage {}", progress.stage, T::STAGE)));
    }
    if progress.step > MAX_STEPS || progress.skipped > progress.step {
        return Err(wrong(format!("is damaged: it tells of {} steps", progress.step)));
    }
    let read = |name: &String| Ok((name.clone(), source.read_f32(name)?));
    let mut rows = source.tensors().keys().map(read).collect::<Result<BTreeMap<_, _>>>()?;
    let has_averages = rows.keys().any(|key| key.starts_with("average/"));
    let shapes = learner.networks.shapes();
    for (key, values) in &rows {
        let shape = key.split_once('/').and_then(|(_, name)| shapes.get(name));
        if shape.is_none_or(|shape| shape.iter().product::<usize>() != values.len()) {
            return Err(wrong(format!("{key} does not fit the configured networks")));
        }
        if let Some(problem) = not_finite(key, values) {
            return Err(wrong(problem));
        }
    }
    let mut take = |kind: &str| -> Result<Rows> {
        let one = |name: &String| {
            let values = rows.remove(&format!("{kind}/{name}"));
            let values = values.ok_or_else(|| wrong(format!("{kind}/{name} is missing")))?;
            Ok((name.clone(), row(values, device)))
        };
        shapes.keys().map(one).collect()
    };
    let weights = take("weight")?;
    if let Some(average) = &mut learner.average {
        // A run that had no averages begins them with its weights, as a new run does.
        average.rows = if has_averages { take("average")? } else { weights.clone() };
    }
    learner.networks = std::mem::take(&mut learner.networks).with_rows(&weights);
    learner.optimizer.restore(&learner.networks, &mut rows, &progress.times, device);
    learner.progress = progress;
    Ok(run)
}
