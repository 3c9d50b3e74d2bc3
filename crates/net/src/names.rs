//! Parameters of the networks by their names in checkpoints.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;

/// The place of a traversal in a module, as the checkpoint's key.
pub(crate) struct Path<'a> {
    prefix: &'a str,
    /// Component of the key and container type, per open module.
    open: Vec<(String, String)>,
}

/// Burn's path component → the checkpoint's, empty if it has none.
fn component(name: &str, container: &str) -> String {
    match name {
        // Burn's normalisation layers.
        "gamma" => "weight".into(),
        "beta" => "bias".into(),
        // Variants of the body and of the head.
        "body" => String::new(),
        "Transformer" if container.starts_with("Enum:") => "dust3r".into(),
        "Convolution" if container.starts_with("Enum:") => "unet".into(),
        "Dpt" if container.starts_with("Enum:") => "dpt".into(),
        "Linear" if container.starts_with("Enum:") => String::new(),
        // Entries of a PyTorch `Sequential`.
        _ => name.strip_prefix("at_").unwrap_or(name).to_owned(),
    }
}

impl<'a> Path<'a> {
    pub(crate) fn new(prefix: &'a str) -> Self {
        Self { prefix, open: Vec::new() }
    }

    pub(crate) fn enter(&mut self, name: &str, container: &str) {
        self.open.push((component(name, container), container.to_owned()));
    }

    pub(crate) fn leave(&mut self) {
        self.open.pop();
    }

    pub(crate) fn name(&self) -> String {
        let parts: Vec<&str> =
            self.open.iter().map(|(part, _)| part.as_str()).filter(|p| !p.is_empty()).collect();
        format!("{}{}", self.prefix, parts.join("."))
    }

    /// Kind of the module that holds the current parameter, as Burn names it.
    pub(crate) fn container(&self) -> &str {
        self.open.last().map_or("", |(_, container)| container)
    }

    /// Whether the current parameter is the weight of a Burn `Linear`, which is the transpose of PyTorch's.
    pub(crate) fn is_transposed(&self) -> bool {
        self.open.last().is_some_and(|(name, container)| name == "weight" && container == "Struct:Linear")
    }
}

/// A visitor of a module's parameters, by name.
pub trait NamedVisitor {
    /// One parameter. `is_transposed`: the checkpoint has the transpose of this matrix.
    fn visit<const D: usize>(&mut self, name: &str, is_transposed: bool, parameter: &Param<Tensor<D>>);
}

/// Visits every parameter of `module`, whose names begin with `prefix`, in a fixed order.
pub fn visit_named<M: Module>(module: &M, prefix: &str, visitor: &mut impl NamedVisitor) {
    struct Adapter<'a, V> {
        path: Path<'a>,
        visitor: &'a mut V,
    }
    impl<V: NamedVisitor> ModuleVisitor for Adapter<'_, V> {
        fn enter_module(&mut self, name: &str, container_type: &str) {
            self.path.enter(name, container_type);
        }

        fn exit_module(&mut self, _name: &str, _container_type: &str) {
            self.path.leave();
        }

        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            self.visitor.visit(&self.path.name(), self.path.is_transposed(), param);
        }
    }
    module.visit(&mut Adapter { path: Path::new(prefix), visitor });
}

/// A mapper of a module's parameters, by name.
pub trait NamedMapper {
    /// One parameter's values; neither tracked nor on a device with gradients.
    fn map<const D: usize>(&mut self, name: &str, values: Tensor<D>) -> Tensor<D>;
}

/// Changes every parameter of `module`, whose names begin with `prefix`, in the order of [`visit_named`]. Tracked parameters
/// stay tracked.
pub fn map_named<M: Module>(module: M, prefix: &str, mapper: &mut impl NamedMapper) -> M {
    struct Adapter<'a, V> {
        path: Path<'a>,
        mapper: &'a mut V,
    }
    impl<V: NamedMapper> ModuleMapper for Adapter<'_, V> {
        fn enter_module(&mut self, name: &str, container_type: &str) {
            self.path.enter(name, container_type);
        }

        fn exit_module(&mut self, _name: &str, _container_type: &str) {
            self.path.leave();
        }

        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            let (id, tensor, mapper) = param.consume();
            let (tracked, strategy) = (tensor.is_require_grad(), tensor.gradient_checkpointing_strategy());
            let values = self.mapper.map(&self.path.name(), tensor.without_autodiff());
            let values = match strategy {
                Some(strategy) => values.autodiff().with_gradient_checkpointing_strategy(strategy),
                None => values,
            };
            Param::from_mapped_value(id, values.set_require_grad(tracked), mapper)
        }
    }
    module.map(&mut Adapter { path: Path::new(prefix), mapper })
}
