//! Parameters of the networks by their names in checkpoints.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;

/// The current place of a traversal through a module, as a key of a checkpoint.
pub struct ParameterPath<'a> {
    prefix: &'a str,
    /// Component of the key and container type, per entered module.
    open: Vec<(String, String)>,
}

/// Burn's path component → the key's component, empty if the key has none.
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

impl ParameterPath<'_> {
    fn enter(&mut self, name: &str, container: &str) {
        self.open.push((component(name, container), container.to_owned()));
    }

    /// Key of the current parameter.
    pub fn name(&self) -> String {
        let parts: Vec<&str> =
            self.open.iter().map(|(part, _)| part.as_str()).filter(|p| !p.is_empty()).collect();
        format!("{}{}", self.prefix, parts.join("."))
    }

    /// Kind of the module that holds the current parameter, as Burn names it.
    pub fn container(&self) -> &str {
        self.open.last().map_or("", |(_, container)| container)
    }

    /// Whether the current parameter is the weight of a Burn `Linear`, which is the transpose of PyTorch's.
    pub fn is_transposed(&self) -> bool {
        self.open.last().is_some_and(|(name, container)| name == "weight" && container == "Struct:Linear")
    }
}

/// A visitor of a module's parameters, by name.
pub trait NamedVisitor {
    /// One parameter.
    fn visit<const D: usize>(&mut self, path: &ParameterPath, parameter: &Param<Tensor<D>>);
}

/// A mapper of a module's parameters, by name.
pub trait NamedMapper {
    /// The new parameter in the place of `parameter`.
    fn map<const D: usize>(&mut self, path: &ParameterPath, parameter: Param<Tensor<D>>) -> Param<Tensor<D>>;
}

/// Calls a [`NamedVisitor`] or [`NamedMapper`] from Burn's traversals.
struct Traversal<'a, T> {
    path: ParameterPath<'a>,
    inner: &'a mut T,
}

impl<V: NamedVisitor> ModuleVisitor for Traversal<'_, V> {
    fn enter_module(&mut self, name: &str, container_type: &str) {
        self.path.enter(name, container_type);
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.open.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.inner.visit(&self.path, param);
    }
}

impl<M: NamedMapper> ModuleMapper for Traversal<'_, M> {
    fn enter_module(&mut self, name: &str, container_type: &str) {
        self.path.enter(name, container_type);
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.open.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        self.inner.map(&self.path, param)
    }
}

/// Visits every parameter of `module` in a fixed order. Names begin with `prefix`.
pub fn visit_named<M: Module>(module: &M, prefix: &str, visitor: &mut impl NamedVisitor) {
    let path = ParameterPath { prefix, open: Vec::new() };
    module.visit(&mut Traversal { path, inner: visitor });
}

/// Changes every parameter of `module` in the order of [`visit_named`]. Names begin with `prefix`.
pub fn map_named<M: Module>(module: M, prefix: &str, mapper: &mut impl NamedMapper) -> M {
    let path = ParameterPath { prefix, open: Vec::new() };
    module.map(&mut Traversal { path, inner: mapper })
}
