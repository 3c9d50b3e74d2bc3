//! Differences of the renderer from the f64 oracle.

use snapsnap_ops::host;
use snapsnap_splat::reference::{self, Cutoff, Scene};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use crate::EvalError;

/// Largest α of a splat without cut-offs.
const WHOLE: f32 = 0.999_99;

/// Largest differences of a colour in a view: of the renderer from the oracle with the same cut-offs, and of that
/// oracle from one without cut-offs, whose pixels never close, and whose splats fade smoothly and may be opaque.
pub(super) fn errors(
    gaussians: &Gaussians,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<(f64, f64), EvalError> {
    let got = host(render(gaussians, std::slice::from_ref(camera), options)?.color);
    let scene = scene(gaussians);
    let hard = reference::render(&scene, camera, options, Cutoff::Hard);
    let whole = RenderOptions { max_alpha: WHOLE, ..options.clone() };
    let smooth = reference::render(&scene, camera, &whole, Cutoff::Smooth);
    let (mut rounding, mut cutoffs) = (0.0_f64, 0.0_f64);
    for (i, (hard, smooth)) in hard.iter().zip(&smooth).enumerate() {
        for c in 0..3 {
            rounding = rounding.max((f64::from(got[3 * i + c]) - hard.color[c]).abs());
            cutoffs = cutoffs.max((hard.color[c] - smooth.color[c]).abs());
        }
    }
    Ok((rounding, cutoffs))
}

/// The oracle's form of Gaussians, over black.
fn scene(gaussians: &Gaussians) -> Scene<f64> {
    let double = |values: Vec<f32>| values.into_iter().map(f64::from).collect::<Vec<_>>();
    let means = double(host(gaussians.means.clone()));
    let rotations = double(host(gaussians.rotations.clone()));
    let scales = double(host(gaussians.scales.clone()));
    let opacities = double(host(gaussians.opacities.clone()));
    let colors = double(host(gaussians.colors.clone()));
    let one = |i: usize| {
        let mut numbers = [0.0; 14];
        numbers[..3].copy_from_slice(&means[3 * i..3 * i + 3]);
        numbers[3..7].copy_from_slice(&rotations[4 * i..4 * i + 4]);
        numbers[7..10].copy_from_slice(&scales[3 * i..3 * i + 3]);
        numbers[10] = opacities[i];
        numbers[11..].copy_from_slice(&colors[3 * i..3 * i + 3]);
        numbers
    };
    Scene { gaussians: (0..opacities.len()).map(one).collect(), background: [0.0; 3] }
}
