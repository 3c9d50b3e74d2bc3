//! Filling networks from a weight file.

use std::collections::HashMap;

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};

use super::WeightsError;
use super::file::{WeightFile, not_finite};
use super::init::draw;
use super::schema::{self, Part, SIDE, TensorSpec};
use crate::config::Config;
use crate::network::PointPredictor;
use crate::parameters::{NamedMapper, ParameterPath, map_named};
use crate::regressor::Regressor;

impl WeightFile {
    /// The point predictor with this file's weights.
    ///
    /// # Errors
    /// [`WeightsError`] if the part is absent, a read fails or a value is not finite.
    pub fn point_predictor(&self, device: &Device) -> Result<PointPredictor, WeightsError> {
        self.require(Part::PointPredictor)?;
        self.fill(PointPredictor::new(&self.config.network, device), "", device)
    }

    /// The regressors with this file's weights: one, or one for front and back and one for the sides.
    ///
    /// # Errors
    /// [`WeightsError`] if the part is absent, a read fails or a value is not finite.
    pub fn regressors(&self, device: &Device) -> Result<Vec<Regressor>, WeightsError> {
        self.require(Part::Regressor)?;
        ["", SIDE][..self.config.regressor.networks]
            .iter()
            .map(|prefix| self.fill(Regressor::new(device), prefix, device))
            .collect()
    }

    fn fill<M: Module>(&self, module: M, prefix: &str, device: &Device) -> Result<M, WeightsError> {
        let read = |name: &str| Ok((self.source.read_f32(name)?, self.source.tensors()[name].shape.clone()));
        fill(module, prefix, device, &self.path().display().to_string(), &read)
    }
}

/// A point predictor with the random weights that [`super::init()`] writes.
pub fn random_predictor(config: &Config, seed: u64, device: &Device) -> PointPredictor {
    random(config, seed, "", PointPredictor::new(&config.network, device), device)
}

/// Regressors with the random weights that [`super::init()`] writes.
pub fn random_regressors(config: &Config, seed: u64, device: &Device) -> Vec<Regressor> {
    ["", SIDE][..config.regressor.networks]
        .iter()
        .map(|prefix| random(config, seed, prefix, Regressor::new(device), device))
        .collect()
}

fn random<M: Module>(config: &Config, seed: u64, prefix: &str, module: M, device: &Device) -> M {
    let specs: HashMap<String, TensorSpec> =
        schema::tensors(config).into_iter().map(|spec| (spec.name.clone(), spec)).collect();
    let read = |name: &str| Ok((draw(&specs[name], seed), specs[name].shape.clone()));
    fill(module, prefix, device, "random weights", &read).expect("random weights are finite")
}

/// Values and PyTorch shape of a tensor.
type Read<'a> = &'a dyn Fn(&str) -> Result<(Vec<f32>, Vec<usize>), WeightsError>;

fn fill<M: Module>(
    module: M,
    prefix: &str,
    device: &Device,
    origin: &str,
    read: Read,
) -> Result<M, WeightsError> {
    let mut loader = Loader { source: read, device, problems: Vec::new(), failure: None };
    let module = map_named(module, prefix, &mut loader);
    let Loader { problems, failure, .. } = loader;
    match failure {
        Some(failure) => Err(failure),
        None if problems.is_empty() => Ok(module),
        None => Err(WeightsError::Tensors { origin: origin.to_owned(), problems }),
    }
}

struct Loader<'a> {
    source: Read<'a>,
    device: &'a Device,
    problems: Vec<String>,
    failure: Option<WeightsError>,
}

impl NamedMapper for Loader<'_> {
    fn map<const D: usize>(&mut self, path: &ParameterPath, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (name, expected) = (path.name(), param.lazy_shape());
        let (values, mut shape) = match (self.source)(&name) {
            Ok(read) => read,
            Err(e) => {
                self.failure.get_or_insert(e);
                return param;
            }
        };
        if let Some(problem) = not_finite(&name, &values) {
            self.problems.push(problem);
            return param;
        }
        if shape.is_empty() {
            shape.push(1); // δ is a scalar in the file and [1] here
        }
        let tensor = Tensor::<D>::from_data(TensorData::new(values, shape), self.device);
        let tensor = if path.is_transposed() { tensor.swap_dims(0, 1) } else { tensor };
        assert_eq!(tensor.shape(), expected, "{name}: schema and network disagree");
        let id = param.id;
        param.transform_for_load(tensor, id)
    }
}
