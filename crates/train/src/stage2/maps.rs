//! What a frozen point predictor made of photographs, kept on disk: where the same ones come again, it is read instead of
//! computed. (The published training does so, SNAPSNAP §5.2.)

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use burn::tensor::{Device, Tensor, TensorData};
use sha2::{Digest, Sha256};
use snapsnap_data::sample::Stage2Item;
use snapsnap_mesh::FileError;
use snapsnap_net::Window;
use snapsnap_net::network::{PointMap, PointPredictor, View};
use snapsnap_net::weights::{Source, WeightsError, write_tensors};
use snapsnap_ops::host;

use crate::TrainError;
use crate::config::TrainConfig;
use crate::networks::Networks;
use crate::points::Prediction;

/// Folder of one predictor's point maps, a file for each pair of photographs. Names follow from what the networks are, from
/// their weights and from the photographs, so that nothing in it can be out of date.
pub(super) struct Maps {
    folder: PathBuf,
}

impl Maps {
    /// Those of this predictor below `root`.
    ///
    /// # Errors
    /// [`TrainError::File`] if the folder cannot be made.
    pub fn new(root: &Path, config: &TrainConfig, predictor: &PointPredictor) -> Result<Self, TrainError> {
        let mut hash = Sha256::new();
        hash.update(config.networks().resolved().to_toml());
        hash.update(config.training.precision.name());
        let networks = Networks { predictor: Some(predictor.clone()), regressors: Vec::new() };
        for (name, values) in networks.checkpoint() {
            hash.update(name);
            update(&mut hash, &values);
        }
        let folder = root.join(name(hash));
        fs::create_dir_all(&folder).map_err(FileError::write(&folder))?;
        Ok(Self { folder })
    }

    /// The point maps of a sample's photographs: those that are there, or else what `predict` makes, which is kept. A file
    /// that is damaged is made again.
    ///
    /// # Errors
    /// [`WeightsError::Write`] if they cannot be written.
    pub fn of(
        &self,
        item: &Stage2Item,
        window: impl FnOnce() -> Window,
        device: &Device,
        predict: impl FnOnce() -> Prediction,
    ) -> Result<Prediction, WeightsError> {
        let mut hash = Sha256::new();
        update(&mut hash, &item.images);
        update(&mut hash, &item.masks);
        let path = self.folder.join(format!("{}.safetensors", name(hash)));
        if path.exists()
            && let Some(there) = read(&path, window(), device)
        {
            return Ok(there);
        }
        let prediction = predict();
        match write(&path, &prediction) {
            // Maps that are not finite are not kept; what becomes of them is the sample's affair.
            Err(WeightsError::Tensors { .. }) | Ok(()) => Ok(prediction),
            Err(e) => Err(e),
        }
    }
}

fn name(hash: Sha256) -> String {
    hash.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

fn update(hash: &mut Sha256, values: &[f32]) {
    /// Values that are turned into bytes at a time.
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
    let values = |i: usize| Ok(std::mem::take(&mut tensors[i]));
    write_tensors(path, "the point maps", HashMap::new(), names, values, &|_, _| ())
}

/// The maps of a file, if it is whole and of this window.
fn read(path: &Path, window: Window, device: &Device) -> Option<Prediction> {
    let source = Source::open(path).ok()?;
    let (h, w) = (window.rows.len(), window.columns.len());
    let mut maps = Vec::new();
    for view in View::ALL {
        let tensor = |what: &str, shape: &[usize]| {
            let key = format!("{}/{what}", view.name());
            let entry = source.tensors().get(&key)?;
            let values = (entry.shape == shape).then(|| source.read_f32(&key).ok())??;
            Some(TensorData::new(values, shape.to_vec()))
        };
        let there = source.tensors().contains_key(&format!("{}/points", view.name()));
        if !there && view as usize >= 2 {
            continue;
        }
        let (points, conf) = (tensor("points", &[1, h, w, 3])?, tensor("conf", &[1, h, w])?);
        maps.push((
            view,
            PointMap { points: Tensor::from_data(points, device), conf: Tensor::from_data(conf, device) },
        ));
    }
    Some(Prediction { window, maps })
}
