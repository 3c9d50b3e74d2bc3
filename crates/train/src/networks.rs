//! The networks of a training: the point predictor, the regressors, or both, with one set of names.

use std::collections::BTreeMap;

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};
use snapsnap_net::network::PointPredictor;
use snapsnap_net::regressor::Regressor;
use snapsnap_net::weights::schema::SIDE;
use snapsnap_net::weights::{NamedMapper, NamedVisitor, map_named, visit_named};
use snapsnap_ops::host;

/// Networks whose parameters are trained.
#[derive(Debug, Clone, Default)]
pub struct Networks {
    /// The point predictor, if it is trained.
    pub predictor: Option<PointPredictor>,
    /// The regressors, if they are trained: one for all views, or one for front and back and one for the sides.
    pub regressors: Vec<Regressor>,
}

/// One row of values per parameter, by the checkpoint's names.
pub type Rows = BTreeMap<String, Tensor<1>>;

impl Networks {
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

    /// The same networks without gradients.
    pub fn valid(&self) -> Self {
        Self {
            predictor: self.predictor.as_ref().map(Module::valid),
            regressors: self.regressors.iter().map(Module::valid).collect(),
        }
    }

    /// The same networks on another device, with gradients if they have them here.
    pub fn fork(&self, device: &Device) -> Self {
        Self {
            predictor: self.predictor.clone().map(|predictor| predictor.fork(device)),
            regressors: self.regressors.iter().map(|regressor| regressor.clone().fork(device)).collect(),
        }
    }

    /// All values, without gradients.
    pub fn rows(&self) -> Rows {
        struct Collect(Rows);
        impl NamedVisitor for Collect {
            fn visit<const D: usize>(&mut self, name: &str, _: bool, parameter: &Param<Tensor<D>>) {
                self.0.insert(name.to_owned(), parameter.val().without_autodiff().reshape([-1]));
            }
        }
        let mut collect = Collect(Rows::new());
        self.visit(&mut collect);
        collect.0
    }

    /// The same networks with the values in `rows`. Other parameters keep their values.
    pub fn with_rows(self, rows: &Rows) -> Self {
        struct Replace<'a>(&'a Rows);
        impl NamedMapper for Replace<'_> {
            fn map<const D: usize>(&mut self, name: &str, values: Tensor<D>) -> Tensor<D> {
                match self.0.get(name) {
                    Some(row) => row.clone().reshape(values.shape()),
                    None => values,
                }
            }
        }
        self.map(&mut Replace(rows))
    }

    /// Shapes of all parameters.
    pub fn shapes(&self) -> BTreeMap<String, Vec<usize>> {
        struct Collect(BTreeMap<String, Vec<usize>>);
        impl NamedVisitor for Collect {
            fn visit<const D: usize>(&mut self, name: &str, _: bool, parameter: &Param<Tensor<D>>) {
                self.0.insert(name.to_owned(), parameter.dims().to_vec());
            }
        }
        let mut collect = Collect(BTreeMap::new());
        self.visit(&mut collect);
        collect.0
    }

    /// All values in the layout of checkpoints.
    pub fn checkpoint(&self) -> BTreeMap<String, Vec<f32>> {
        struct Collect(BTreeMap<String, Vec<f32>>);
        impl NamedVisitor for Collect {
            fn visit<const D: usize>(
                &mut self,
                name: &str,
                is_transposed: bool,
                parameter: &Param<Tensor<D>>,
            ) {
                let tensor = parameter.val().without_autodiff();
                let tensor = if is_transposed { tensor.swap_dims(0, 1) } else { tensor };
                self.0.insert(name.to_owned(), host(tensor));
            }
        }
        let mut collect = Collect(BTreeMap::new());
        self.visit(&mut collect);
        collect.0
    }
}

/// A row of values on a device.
pub(crate) fn row(values: Vec<f32>, device: &Device) -> Tensor<1> {
    let count = values.len();
    Tensor::from_data(TensorData::new(values, [count]), device)
}
