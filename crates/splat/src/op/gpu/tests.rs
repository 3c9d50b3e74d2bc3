use burn::tensor::{Device, DeviceKind, Tensor, TensorData};

use super::buffers::testing::with_buffers;
use crate::{Camera, Gaussians, RenderOptions, render};

/// Image, and gradients of means, rotations, scales, colours, opacities, background.
fn pass(device: &Device, options: &RenderOptions) -> Vec<Vec<f32>> {
    let device = device.clone().autodiff();
    let n = 500;
    let rows = |columns: usize, f: fn(usize, usize) -> f32| {
        let values: Vec<f32> = (0..n).flat_map(|i| (0..columns).map(move |k| f(i, k))).collect();
        Tensor::<2>::from_data(TensorData::new(values, [n, columns]), &device).require_grad()
    };
    let means = rows(3, |i, k| ((i * 7919 + k * 104_729) % 1000) as f32 / 1000.0 * 1.6 - [0.8, 0.0, 0.8][k]);
    let rotations = rows(4, |i, k| ((i * 31 + k * 17) % 19) as f32 - 9.3);
    let scales = rows(3, |i, k| 0.005 + 0.03 * (((i + 3 * k) % 7) as f32 / 7.0));
    let colors = rows(3, |i, k| ((i * 5 + k) % 11) as f32 / 11.0);
    let opacities = rows(1, |i, _| ((i * 7919 + 104_742) % 1000) as f32 / 1000.0);
    let background = Tensor::<2>::from_floats([[0.2, 0.4, 0.6]], &device).require_grad();
    let all = [&means, &rotations, &scales, &colors, &opacities, &background].map(Tensor::clone);
    let gaussians =
        Gaussians::new(means, rotations, scales, opacities.squeeze_dim(1), colors).expect("shapes");
    let options = RenderOptions { background: Some(background.squeeze_dim(0)), ..options.clone() };
    let cameras = Camera::orbit(3, 83, 61);
    let rendered = render(&gaussians, &cameras, &options).expect("rendered");
    let grads = (rendered.color.clone().square().sum() + rendered.alpha.sum()).backward();
    let gradients = all.map(|tensor| tensor.grad(&grads).expect("tracked").into_data());
    let results = std::iter::once(rendered.color.into_data()).chain(gradients);
    results.map(|values| values.try_into_vec().expect("f32")).collect()
}

/// In this test build every new buffer is filled with garbage first; nothing may rely on zeroed memory.
#[test]
fn kernels_agree_with_the_cpu_on_uninitialised_memory() {
    with_buffers(|_| {
        for (antialiased, depth) in [(false, false), (true, true)] {
            let options = RenderOptions { antialiased, depth, ..RenderOptions::inria() };
            let cpu = pass(&Device::flex(), &options);
            let gpu = pass(&Device::wgpu(DeviceKind::DefaultDevice), &options);
            for (what, (a, b)) in cpu.iter().zip(&gpu).enumerate() {
                assert_eq!(a.len(), b.len());
                let difference: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
                let norm: f64 = a.iter().map(|a| f64::from(*a).powi(2)).sum();
                // A pixel on a cut-off may fall on either side of it.
                assert!(
                    norm > 0.0 && difference.sqrt() < 3e-4 * norm.sqrt(),
                    "{what}: {difference} of {norm}"
                );
            }
        }
    });
}
