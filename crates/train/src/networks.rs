//! The trained networks: the point predictor, the regressors, or both. Parameters have the names of checkpoints.

use std::collections::BTreeMap;

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_net::config::Precision;
use snapsnap_net::network::PointPredictor;
use snapsnap_net::regressor::Regressor;
use snapsnap_net::weights::schema::SIDE;
use snapsnap_net::weights::{NamedMapper, NamedVisitor, ParameterPath, map_named, visit_named};
use snapsnap_ops::host;

/// Networks whose parameters are trained.
#[derive(Module, Debug, Default)]
pub struct Networks {
    /// The point predictor, if it is trained.
    pub predictor: Option<PointPredictor>,
    /// The regressors, if they are trained: one for all views, or one for front and back and one for the sides.
    pub regressors: Vec<Regressor>,
}

/// A parameter.
pub(crate) struct Parameter {
    /// The checkpoint's name.
    pub name: String,
    pub shape: Vec<usize>,
    /// Whether the checkpoint contains the transpose of this matrix.
    is_transposed: bool,
    pub values: Tensor<1>,
}

/// One row of values per parameter, by the checkpoint's names.
pub type Rows = BTreeMap<String, Tensor<1>>;

impl Networks {
    /// The same networks, of which only the parameters whose names begin with `part` are trained.
    pub fn with_trained(self, part: &str) -> Self {
        struct Freeze<'a>(&'a str);
        impl NamedMapper for Freeze<'_> {
            fn map<const D: usize>(
                &mut self,
                path: &ParameterPath,
                param: Param<Tensor<D>>,
            ) -> Param<Tensor<D>> {
                param.set_require_grad(path.name().starts_with(self.0))
            }
        }
        self.map(&mut Freeze(part))
    }

    /// Visits all parameters.
    pub fn visit(&self, visitor: &mut impl NamedVisitor) {
        if let Some(predictor) = &self.predictor {
            visit_named(predictor, "", visitor);
        }
        for (regressor, prefix) in self.regressors.iter().zip(["", SIDE]) {
            visit_named(regressor, prefix, visitor);
        }
    }

    /// Changes all parameters.
    pub fn map(self, mapper: &mut impl NamedMapper) -> Self {
        Self {
            predictor: self.predictor.map(|predictor| map_named(predictor, "", mapper)),
            regressors: (self.regressors.into_iter().zip(["", SIDE]))
                .map(|(regressor, prefix)| map_named(regressor, prefix, mapper))
                .collect(),
        }
    }

    /// The same networks with a predictor in this precision: its matrix products, its convolutions, and their
    /// intermediate results for the backward pass. Gradients flow back to these networks. Weights, moments and losses
    /// stay in 32 bits.
    pub fn in_precision(&self, precision: Precision) -> Self {
        let Self { predictor, regressors } = self.clone();
        Self { predictor: predictor.map(|predictor| precision.lower(predictor)), regressors }
    }

    /// All parameters with their values, without gradients.
    pub(crate) fn parameters(&self) -> Vec<Parameter> {
        struct Collect(Vec<Parameter>);
        impl NamedVisitor for Collect {
            fn visit<const D: usize>(&mut self, path: &ParameterPath, parameter: &Param<Tensor<D>>) {
                let values = parameter.val().without_autodiff();
                let shape = values.dims().to_vec();
                let values = values.reshape([-1]);
                let (name, is_transposed) = (path.name(), path.is_transposed());
                self.0.push(Parameter { name, shape, is_transposed, values });
            }
        }
        let mut collect = Collect(Vec::new());
        self.visit(&mut collect);
        collect.0
    }

    /// All values, without gradients.
    pub fn rows(&self) -> Rows {
        self.parameters().into_iter().map(|parameter| (parameter.name, parameter.values)).collect()
    }

    /// Shapes of all parameters.
    pub fn shapes(&self) -> BTreeMap<String, Vec<usize>> {
        self.parameters().into_iter().map(|parameter| (parameter.name, parameter.shape)).collect()
    }

    /// All values in the layout of checkpoints.
    pub fn checkpoint(&self) -> BTreeMap<String, Vec<f32>> {
        let stored = |Parameter { name, shape, is_transposed, values }: Parameter| match shape[..] {
            [rows, columns] if is_transposed => (name, host(values.reshape([rows, columns]).transpose())),
            _ => (name, host(values)),
        };
        self.parameters().into_iter().map(stored).collect()
    }

    /// The same networks with the values in `rows`, which may be on another device. Parameters without a
    /// row keep their values, and tracked parameters stay tracked.
    pub fn with_rows(self, rows: &Rows) -> Self {
        struct Replace<'a>(&'a Rows);
        impl NamedMapper for Replace<'_> {
            fn map<const D: usize>(
                &mut self,
                path: &ParameterPath,
                parameter: Param<Tensor<D>>,
            ) -> Param<Tensor<D>> {
                let Some(row) = self.0.get(&path.name()) else { return parameter };
                let (id, old, mapper) = parameter.consume();
                let device = old.clone().without_autodiff().device();
                let values = row.clone().to_device(&device).reshape(old.shape());
                let values = if old.device().is_autodiff() { values.autodiff() } else { values };
                Param::from_mapped_value(id, values.set_require_grad(old.is_require_grad()), mapper)
            }
        }
        self.map(&mut Replace(rows))
    }
}

/// A row of values on a device.
pub(crate) fn row(values: Vec<f32>, device: &Device) -> Tensor<1> {
    let count = values.len();
    Tensor::from_data(TensorData::new(values, [count]), device)
}

/// Rows with these names and lengths, whose values stand one after the other.
pub(crate) fn split(names: Vec<(String, usize)>, mut values: &[f32], device: &Device) -> Rows {
    let one = |(name, length)| {
        let own = values.split_off(..length).expect("as many values as were joined");
        (name, row(own.to_vec(), device))
    };
    names.into_iter().map(one).collect()
}

/// Rows on a device, in one transfer.
pub(crate) fn moved(rows: Rows, device: &Device) -> Rows {
    if rows.values().next().is_none_or(|first| first.device() == *device) {
        return rows;
    }
    let names = rows.iter().map(|(name, values)| (name.clone(), values.dims()[0])).collect();
    split(names, &host(Tensor::cat(rows.into_values().collect(), 0)), device)
}
