//! A frozen point predictor. Its point maps may be kept on disk, where they are read instead of computed if the same
//! photographs come again. (The published training does so.)

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use burn::tensor::{Device, Tensor, TensorData};
use sha2::{Digest, Sha256};
use snapsnap_base::FileError;
use snapsnap_base::config::Schema;
use snapsnap_data::sample::Stage2Item;
use snapsnap_net::Window;
use snapsnap_net::config::Config;
use snapsnap_net::network::{PointMap, PointPredictor, View};
use snapsnap_net::weights::{Source, WeightsError, write_tensors};
use snapsnap_ops::host;

use crate::TrainError;
use crate::config::TrainConfig;
use crate::networks::Networks;
use crate::points::{Prediction, predict, window};
use crate::precision::{Precision, lower};

/// Metadata key of the checksum of a file's values.
const CHECKSUM: &str = "snapsnap.checksum";

/// A predictor without gradients.
pub(super) struct Frozen {
    pub networks: Networks,
    /// The predictor in the training's precision.
    lowered: PointPredictor,
    precision: Precision,
    /// Point maps on disk, if configured.
    maps: Option<Maps>,
}

impl Frozen {
    /// `predictor` has no gradients.
    pub fn new(config: &TrainConfig, predictor: PointPredictor) -> Self {
        let maps = config.stage2.point_map_cache.as_ref();
        let maps = maps.map(|folder| Maps::new(folder, &config.networks(), &predictor));
        let precision = config.precision();
        let networks = Networks { predictor: Some(predictor), regressors: Vec::new() };
        let lowered = lower(precision, &networks).predictor.expect("there is one");
        Self { networks, lowered, precision, maps }
    }

    /// Predicts the points of a sample's photographs on `device`, in a step or in a validation, which is in f32.
    pub fn predict(
        &self,
        config: &Config,
        item: &Stage2Item,
        is_step: bool,
        device: &Device,
    ) -> Result<Prediction, TrainError> {
        let (predictor, precision) = if is_step {
            (&self.lowered, self.precision)
        } else {
            (self.networks.predictor.as_ref().expect("set in `new`"), Precision::F32)
        };
        let made = || of_sample(predictor, config, item, device);
        match &self.maps {
            Some(maps) => maps.of(config, item, (device, precision), made),
            None => Ok(made()),
        }
    }
}

/// A predictor's point maps of one sample.
pub(super) fn of_sample(
    predictor: &PointPredictor,
    config: &Config,
    item: &Stage2Item,
    device: &Device,
) -> Prediction {
    let side = item.side;
    let images = TensorData::new(item.images.clone(), [1, 2, 3, side, side]);
    let masks = TensorData::new(item.masks.clone(), [1, 2, side, side]);
    let (images, masks) = (Tensor::from_data(images, device), Tensor::from_data(masks, device));
    predict(predictor, config, images, &masks)
}

/// Folder of one predictor's point maps, with a file for each pair of photographs. Names are hashes of the program's
/// version, the predictor's config and weights, the photographs, the device and the precision, so that outdated files
/// are never read.
struct Maps {
    folder: PathBuf,
    views: Vec<View>,
}

impl Maps {
    /// The folder of this predictor below `root`.
    fn new(root: &Path, config: &Config, predictor: &PointPredictor) -> Self {
        let mut hash = Sha256::new();
        hash.update(env!("CARGO_PKG_VERSION"));
        hash.update(config.resolved().to_toml());
        let networks = Networks { predictor: Some(predictor.clone()), regressors: Vec::new() };
        for (name, values) in networks.checkpoint() {
            hash.update(name);
            update(&mut hash, &values);
        }
        Self { folder: root.join(name(hash)), views: predictor.views().to_vec() }
    }

    /// The point maps of a sample's photographs in `precision` on `device`, read from their file or computed by
    /// `predict` and written. A damaged file is written again.
    fn of(
        &self,
        config: &Config,
        item: &Stage2Item,
        (device, precision): (&Device, Precision),
        predict: impl FnOnce() -> Prediction,
    ) -> Result<Prediction, TrainError> {
        let mut hash = Sha256::new();
        hash.update(format!("{device:?} {}", precision.name()));
        update(&mut hash, &item.images);
        update(&mut hash, &item.masks);
        let path = self.folder.join(format!("{}.safetensors", name(hash)));
        if path.exists() {
            let window = window(config, &item.masks, item.side);
            if let Some(there) = read(&path, &self.views, window, device) {
                return Ok(there);
            }
        }
        let prediction = predict();
        fs::create_dir_all(&self.folder).map_err(FileError::write(&self.folder))?;
        match write(&path, &prediction) {
            // Maps that are not finite are not written. The step reports them.
            Err(WeightsError::Tensors { .. }) | Ok(()) => Ok(prediction),
            Err(e) => Err(e.into()),
        }
    }
}

fn name(hash: Sha256) -> String {
    hash.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

fn update(hash: &mut Sha256, values: &[f32]) {
    /// Values per update of the hash.
    const PART: usize = 1 << 16;
    for part in values.chunks(PART) {
        let bytes: Vec<u8> = part.iter().flat_map(|v| v.to_le_bytes()).collect();
        hash.update(bytes);
    }
}

fn write(path: &Path, prediction: &Prediction) -> Result<(), WeightsError> {
    let (mut names, mut tensors) = (Vec::new(), Vec::new());
    for (view, map) in &prediction.maps {
        names.push((format!("{}/points", view.name()), map.points.dims().to_vec()));
        tensors.push(host(map.points.clone()));
        names.push((format!("{}/conf", view.name()), map.conf.dims().to_vec()));
        tensors.push(host(map.conf.clone()));
    }
    let metadata = HashMap::from([(CHECKSUM.to_owned(), checksum(&tensors))]);
    let values = |i: usize| Ok(std::mem::take(&mut tensors[i]));
    write_tensors(path, "the point maps", metadata, names, values, &|_, _| ())
}

fn checksum(tensors: &[Vec<f32>]) -> String {
    let mut hash = Sha256::new();
    tensors.iter().for_each(|values| update(&mut hash, values));
    name(hash)
}

/// The maps of a file, if it is intact and of these views and this window.
fn read(path: &Path, views: &[View], window: Window, device: &Device) -> Option<Prediction> {
    let source = Source::open(path).ok()?;
    let (h, w) = (window.rows.len(), window.columns.len());
    let mut tensors = Vec::new();
    for view in views {
        for (what, shape) in [("points", &[1, h, w, 3][..]), ("conf", &[1, h, w])] {
            let key = format!("{}/{what}", view.name());
            let there = source.tensors().get(&key)?.shape == shape;
            tensors.push(there.then(|| source.read_f32(&key).ok())??);
        }
    }
    if source.metadata.get(CHECKSUM) != Some(&checksum(&tensors)) {
        return None;
    }
    let mut tensors = tensors.into_iter();
    let mut next = || tensors.next().expect("two of each view");
    let map = |view: &View| {
        let points = Tensor::from_data(TensorData::new(next(), [1, h, w, 3]), device);
        let conf = Tensor::from_data(TensorData::new(next(), [1, h, w]), device);
        (*view, PointMap { points, conf })
    };
    let maps = views.iter().map(map).collect();
    Some(Prediction { window, maps, normals: None })
}
