//! The native half of the Python package `snapsnap`, whose Python half is in `crates/python/snapsnap`. Arrays cross the
//! border as bytes, so that no NumPy is needed to build it; the Python half checks and shapes them.
#![cfg(feature = "python")]

mod arrays;
mod mesh;
mod people;
mod rasterize;
mod work;

use pyo3::prelude::*;

/// `snapsnap._native`.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::arrays::{orbit, read, write};
    #[pymodule_export]
    use super::mesh::{Mesh, mesh};
    #[pymodule_export]
    use super::people::{Networks, reconstruct};
    #[pymodule_export]
    use super::rasterize::{Tape, rasterize};
    #[pymodule_export]
    use super::work::InputError;
    use super::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        snapsnap::set_up();
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }

    /// Runs the command line. `program` starts this package as a program.
    #[pyfunction]
    fn main(py: Python<'_>, program: Vec<std::ffi::OsString>, arguments: Vec<std::ffi::OsString>) -> u8 {
        py.detach(|| snapsnap::main(&program, arguments))
    }
}
