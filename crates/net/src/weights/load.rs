//! Filling networks from a weight file.

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Device, Tensor, TensorData};

use super::file::{WeightFile, not_finite};
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
            prefix,
            device,
            path: Vec::new(),
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
    prefix: &'a str,
    device: &'a Device,
    /// Component of the checkpoint's key and container type, per open module.
    path: Vec<(String, String)>,
    problems: Vec<String>,
    failure: Option<WeightsError>,
}

/// Burn's path component → the checkpoint's, empty if it has none.
fn component(name: &str, container: &str) -> String {
    match name {
        // Burn's normalisation layers.
        "gamma" => "weight".into(),
        "beta" => "bias".into(),
        // Variants of the head.
        "Dpt" if container.starts_with("Enum:") => "dpt".into(),
        "Linear" if container.starts_with("Enum:") => String::new(),
        // Entries of a PyTorch `Sequential`.
        _ => name.strip_prefix("at_").unwrap_or(name).to_owned(),
    }
}

impl Loader<'_> {
    fn name(&self) -> String {
        let parts: Vec<&str> =
            self.path.iter().map(|(part, _)| part.as_str()).filter(|p| !p.is_empty()).collect();
        format!("{}{}", self.prefix, parts.join("."))
    }

    /// Values and PyTorch shape of the tensor at the current path.
    fn read<const D: usize>(&mut self) -> Option<Tensor<D>> {
        let name = self.name();
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

    /// Whether the current parameter is the weight of a Burn `Linear`, which is the transpose of PyTorch's.
    fn is_linear_weight(&self) -> bool {
        self.path.last().is_some_and(|(name, container)| name == "weight" && container == "Struct:Linear")
    }
}

impl ModuleMapper for Loader<'_> {
    fn enter_module(&mut self, name: &str, container_type: &str) {
        self.path.push((component(name, container_type), container_type.to_owned()));
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let expected = param.lazy_shape();
        let linear = self.is_linear_weight();
        let Some(tensor) = self.read::<D>() else {
            return param;
        };
        let tensor = if linear { tensor.swap_dims(0, 1) } else { tensor };
        assert_eq!(tensor.shape(), expected, "{}: schema and network disagree", self.name());
        let id = param.id;
        param.transform_for_load(tensor, id)
    }
}
