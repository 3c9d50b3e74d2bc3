//! Differences of the renderer from the f64 oracle.

use burn::tensor::Tensor;
use snapsnap_ops::host;
use snapsnap_splat::reference::{self, Cutoff, Scene};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use crate::Result;

/// Largest α of a splat in the oracle without cut-offs.
const WHOLE: f32 = 0.999_99;

/// Largest differences of a colour in a view: between renderer and oracle with the same cut-offs, and between oracles
/// with and without cut-offs. Without cut-offs pixels never close, and splats fade smoothly and may be opaque.
pub(super) fn errors(gaussians: &Gaussians, camera: &Camera, options: &RenderOptions) -> Result<(f64, f64)> {
    let got = host(render(gaussians, std::slice::from_ref(camera), options)?.color);
    let Gaussians { means, rotations, scales, opacities, colors } = gaussians.clone();
    let rows = host(Tensor::cat(vec![means, rotations, scales, opacities.unsqueeze_dim(1), colors], 1));
    let rows = rows.as_chunks().0.iter().map(|row| row.map(f64::from));
    let scene = Scene { gaussians: rows.collect(), background: [0.0; 3] };
    let hard = reference::render(&scene, camera, options, Cutoff::Hard);
    let whole = RenderOptions { max_alpha: WHOLE, ..options.clone() };
    let smooth = reference::render(&scene, camera, &whole, Cutoff::Smooth);
    let (mut rounding, mut cutoffs) = (0.0_f64, 0.0_f64);
    for ((hard, smooth), got) in hard.iter().zip(&smooth).zip(got.chunks_exact(3)) {
        for ((hard, smooth), got) in hard.iter().zip(smooth).zip(got) {
            rounding = rounding.max((f64::from(*got) - hard).abs());
            cutoffs = cutoffs.max((hard - smooth).abs());
        }
    }
    Ok((rounding, cutoffs))
}
