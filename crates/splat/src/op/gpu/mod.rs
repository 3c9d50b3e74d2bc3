//! The splatting operation as CubeCL kernels.

mod buffers;
mod scan;
mod sort;
