//! The differentiable rasteriser.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use burn::tensor::{Tensor, TensorData};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::PyByteArray;
use snapsnap_ops::host;
use snapsnap_splat::{Gaussians, Preset, Rendered, render};

use crate::arrays::{Arrays, bytes, cameras, floats, gaussians, tensor};
use crate::work::{run, unsuitable};

/// What the backward pass of a render needs. It is used once.
#[pyclass(frozen)]
pub struct Tape(Mutex<Option<Forward>>);

struct Forward {
    inputs: Gaussians,
    background: Option<Tensor<1>>,
    rendered: Rendered,
}

#[pymethods]
impl Tape {
    /// Gradients of the sum of all outputs, each multiplied by its gradient: of means, rotations, scales, opacities,
    /// colours and background.
    fn backward<'py>(
        &self,
        py: Python<'py>,
        color: PyBackedBytes,
        alpha: PyBackedBytes,
        depth: Option<PyBackedBytes>,
    ) -> PyResult<[Option<Bound<'py, PyByteArray>>; 6]> {
        let forward = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        let forward = forward.ok_or_else(|| PyRuntimeError::new_err("the gradients were taken already"))?;
        let gradients = run(py, move |_| {
            let Forward { inputs, background, rendered } = forward;
            let weighed = |output: Tensor<1>, gradient: &[u8]| {
                let data = TensorData::new(floats(gradient), output.dims());
                (output.clone() * Tensor::from_data(data, &output.device())).sum()
            };
            let [views, height, width, _] = rendered.color.dims();
            let pixels = views * height * width;
            let mut sum = weighed(rendered.color.reshape([3 * pixels]), &color)
                + weighed(rendered.alpha.reshape([pixels]), &alpha);
            if let Some((output, gradient)) = rendered.depth.zip(depth) {
                sum = sum + weighed(output.reshape([pixels]), &gradient);
            }
            let gradients = sum.backward();
            let Gaussians { means, rotations, scales, opacities, colors } = &inputs;
            Ok([
                means.grad(&gradients).map(host),
                rotations.grad(&gradients).map(host),
                scales.grad(&gradients).map(host),
                opacities.grad(&gradients).map(host),
                colors.grad(&gradients).map(host),
                background.and_then(|background| background.grad(&gradients)).map(host),
            ])
        })?;
        Ok(gradients.map(|values| values.map(|values| bytes(py, &values))))
    }
}

/// Number of views, height, width; colour, alpha and depth; and the tape if gradients are wanted.
type Output<'py> = (
    [usize; 3],
    Bound<'py, PyByteArray>,
    Bound<'py, PyByteArray>,
    Option<Bound<'py, PyByteArray>>,
    Option<Tape>,
);

/// Renders Gaussians into the cameras of a JSON text or of a file.
#[pyfunction]
#[pyo3(signature = (arrays, *, cameras_json, cameras_path, background, preset, antialiased, depth, device, gradients))]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
pub fn rasterize<'py>(
    py: Python<'py>,
    arrays: Arrays,
    cameras_json: Option<String>,
    cameras_path: Option<PathBuf>,
    background: Option<PyBackedBytes>,
    preset: String,
    antialiased: bool,
    depth: bool,
    device: String,
    gradients: bool,
) -> PyResult<Output<'py>> {
    let (forward, color, alpha, depth) = run(py, move |_| {
        let preset = match &*preset {
            "inria" => Preset::Inria,
            "gsplat" => Preset::Gsplat,
            _ => return Err(unsuitable("preset", "must be inria or gsplat")),
        };
        let device = snapsnap::device::choose_for_one(&device)?;
        let device = if gradients { device.autodiff() } else { device };
        let Gaussians { means, rotations, scales, opacities, colors } = gaussians(&arrays, &device)?;
        let inputs = Gaussians {
            means: means.set_require_grad(gradients),
            rotations: rotations.set_require_grad(gradients),
            scales: scales.set_require_grad(gradients),
            opacities: opacities.set_require_grad(gradients),
            colors: colors.set_require_grad(gradients),
        };
        let background = background.map(|color| tensor(&color, 3, &device).squeeze_dim::<1>(0));
        let background = background.map(|color| color.set_require_grad(gradients));
        let cameras = cameras(cameras_json.as_deref(), cameras_path.as_deref())?;
        let mut options = preset.options();
        (options.antialiased, options.depth) = (antialiased, depth);
        options.background.clone_from(&background);
        let rendered = render(&inputs, &cameras, &options)?;
        let (color, alpha) = (host(rendered.color.clone()), host(rendered.alpha.clone()));
        let depth = rendered.depth.clone().map(host);
        Ok((Forward { inputs, background, rendered }, color, alpha, depth))
    })?;
    let [views, height, width, _] = forward.rendered.color.dims();
    let tape = gradients.then(|| Tape(Mutex::new(Some(forward))));
    let depth = depth.map(|values| bytes(py, &values));
    Ok(([views, height, width], bytes(py, &color), bytes(py, &alpha), depth, tape))
}
