//! Gradient descent through the splatting operation: the fit of `examples/fit_gaussians.rs` on the device under test.

#[path = "../../../examples/fit_gaussians.rs"]
#[allow(dead_code, reason = "the example's own `main`")]
mod fit_gaussians;

use burn::tensor::Device;
use snapsnap_tests::{device, is_on_gpu};

use fit_gaussians::{Fit, STEPS, fit};

#[test]
fn random_gaussians_are_fitted_to_a_scene() {
    let Some(device) = device() else { return };
    let Fit { losses, before, after } = fit(&device, STEPS).expect("rendered");
    println!("unseen view: {before:.2} dB before, {after:.2} dB after {STEPS} steps");
    assert!(before < 21.0, "nothing to learn: {before} dB");
    assert!(after > 31.0, "{after} dB");
    if is_on_gpu() {
        let cpu = fit(&Device::flex(), STEPS).expect("rendered");
        let pairs = || losses.iter().zip(&cpu.losses);
        let worst = pairs().map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let relative = pairs().map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f32::max);
        println!(
            "against the CPU: loss within {worst:.1e}, relatively {relative:.1e}; {:.2} dB there",
            cpu.after
        );
        // Rounding errors grow with the steps. Both descents agree to 1e-3 of the first loss.
        assert!(worst < 1e-3 * cpu.losses[0] && (after - cpu.after).abs() < 0.3);
    }
}
