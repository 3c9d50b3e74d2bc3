//! The differentiable render, the public interface of the splatting operation.

use std::sync::Arc;

use burn::backend::Dispatch;
use burn::tensor::{DType, Tensor};

use crate::op::{Counts, Job, SplatBackend, SplatInputs};
use crate::{Camera, Gaussians, RenderOptions, SplatError};

/// Result of [`render`].
#[derive(Debug, Clone)]
pub struct Rendered {
    /// `[V,H,W,3]`: Σ c·α·T + T_final·background.
    pub color: Tensor<4>,
    /// `[V,H,W]`: 1 − T_final.
    pub alpha: Tensor<3>,
    /// `[V,H,W]`, metres: Σ t_z·α·T, not divided by alpha. Only with [`RenderOptions::depth`].
    pub depth: Option<Tensor<3>>,
    /// Counts of visible and of culled Gaussians.
    pub counts: Counts,
}

/// Renders `gaussians` into `cameras`, all of one image size, by front-to-back alpha compositing of their elliptical
/// projections (EWA splatting; docs/method.md, "Splatting").
///
/// Differentiable in means, rotations, scales, opacities, colours and background. Untracked inputs cost nothing in
/// the backward pass. On one device, equal inputs give equal bits on every run, forward and backward; with a
/// background, a GPU's first run may differ in the last bits, since it tunes Burn's sums. A Gaussian whose parameters
/// are not finite or leave f32's range when projected is culled, counted, and gets a zero gradient.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};
///
/// let device = Device::flex().autodiff();
/// let colors = Tensor::<2>::ones([1, 3], &device).require_grad();
/// let gaussians = Gaussians::new(
///     Tensor::from_floats([[0.0, 0.85, 0.0]], &device),
///     Tensor::from_floats([[1.0, 0.0, 0.0, 0.0]], &device),
///     Tensor::full([1, 3], 0.1, &device),
///     Tensor::full([1], 0.9, &device),
///     colors.clone(),
/// )?;
/// let rendered = render(&gaussians, &Camera::orbit(4, 256, 256), &RenderOptions::inria())?;
/// let gradients = rendered.color.mean().backward();
/// assert!(colors.grad(&gradients).is_some());
/// assert_eq!(rendered.counts.visible, 4);
/// # Ok::<(), snapsnap_splat::SplatError>(())
/// ```
///
/// # Errors
/// [`SplatError::NoCamera`], [`SplatError::Camera`] for a camera that cannot be used, [`SplatError::Option`],
/// [`SplatError::Shape`] for tensors that do not fit together, [`SplatError::TooManyIntersections`] and
/// [`SplatError::Memory`] for more than the device can hold.
pub fn render(
    gaussians: &Gaussians,
    cameras: &[Camera],
    options: &RenderOptions,
) -> Result<Rendered, SplatError> {
    let job = Job::new(cameras, options)?;
    gaussians.check()?;
    if let Some(color) = options.background.as_ref().filter(|color| color.dims() != [3]) {
        let found = color.dims().to_vec();
        return Err(SplatError::Shape { field: "background", found, expected: vec![3] });
    }
    let inputs = SplatInputs {
        means: f32(&gaussians.means).into_dispatch(),
        rotations: f32(&gaussians.rotations).into_dispatch(),
        scales: f32(&gaussians.scales).into_dispatch(),
        opacities: f32(&gaussians.opacities).into_dispatch(),
        colors: f32(&gaussians.colors).into_dispatch(),
    };
    let output = <Dispatch as SplatBackend>::splat(inputs, Arc::new(job));
    let counts = output.counts?;
    let image: fn(_) -> Tensor<4> = Tensor::from_dispatch;
    let (mut color, alpha) = (image(output.color), image(output.alpha));
    // The operation renders over black.
    if let Some(background) = &options.background {
        let transmittance: Tensor<4> = 1.0 - alpha.clone();
        // Expanded, so that gradients are sums over one dimension after the other, not over all at once.
        color = color.clone() + transmittance * f32(background).reshape([1, 1, 1, 3]).expand(color.dims());
    }
    Ok(Rendered {
        color,
        alpha: alpha.squeeze_dim::<3>(3),
        depth: options.depth.then(|| image(output.depth).squeeze_dim::<3>(3)),
        counts,
    })
}

/// Casts to f32, in which the kernels compute for models of every precision.
fn f32<const D: usize>(tensor: &Tensor<D>) -> Tensor<D> {
    if tensor.dtype() == DType::F32 { tensor.clone() } else { tensor.clone().cast(DType::F32) }
}
