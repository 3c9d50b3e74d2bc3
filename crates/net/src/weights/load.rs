//! Filling networks from a weight file.

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Device, Tensor, TensorData};

use super::file::{WeightFile, not_finite};
use super::names::Path;
use super::schema::{Part, SIDE};
use super::{Source, WeightsError};
use crate::network::PointPredictor;
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
            .map(|prefix| self.fill(Regressor::new(&self.config.regressor, device), prefix, device))
            .collect()
    }

    fn fill<M: Module>(&self, module: M, prefix: &str, device: &Device) -> Result<M, WeightsError> {
        let mut loader = Loader {
            source: &self.source,
            device,
            path: Path::new(prefix),
            problems: Vec::new(),
            failure: None,
        };
        let module = module.map(&mut loader);
        if let Some(failure) = loader.failure {
            return Err(failure);
        }
        if loader.problems.is_empty() {
            return Ok(module);
        }
        Err(WeightsError::Tensors { origin: self.path().display().to_string(), problems: loader.problems })
    }
}

struct Loader<'a> {
    source: &'a Source,
    device: &'a Device,
    path: Path<'a>,
    problems: Vec<String>,
    failure: Option<WeightsError>,
}

impl Loader<'_> {
    /// Values and PyTorch shape of the tensor at the current path.
    fn read<const D: usize>(&mut self) -> Option<Tensor<D>> {
        let name = self.path.name();
        let values = match self.source.read_f32(&name) {
            Ok(values) => values,
            Err(e) => {
                self.failure.get_or_insert(e);
                return None;
            }
        };
        if let Some(problem) = not_finite(&name, &values) {
            self.problems.push(problem);
            return None;
        }
        let mut shape = self.source.tensors()[&name].shape.clone();
        if shape.is_empty() {
            shape.push(1); // δ is a scalar in the file and [1] here
        }
        Some(Tensor::from_data(TensorData::new(values, shape), self.device))
    }
}

impl ModuleMapper for Loader<'_> {
    fn enter_module(&mut self, name: &str, container_type: &str) {
        self.path.enter(name, container_type);
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.leave();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let expected = param.lazy_shape();
        let transposed = self.path.is_transposed();
        let Some(tensor) = self.read::<D>() else {
            return param;
        };
        let tensor = if transposed { tensor.swap_dims(0, 1) } else { tensor };
        assert_eq!(tensor.shape(), expected, "{}: schema and network disagree", self.path.name());
        let id = param.id;
        param.transform_for_load(tensor, id)
    }
}
