use burn::tensor::{Device, DeviceKind, Tensor, TensorData};

use super::buffers::testing::with_buffers;
use crate::{Camera, Gaussians, RenderOptions, render};

/// Image, and gradients of means, rotations, scales, colours, opacities, background.
fn pass(device: &Device, options: &RenderOptions) -> [Vec<f32>; 7] {
    let device = device.clone().autodiff();
    let n = 500;
    let rows = |columns: usize, f: fn(usize, usize) -> f32| {
        let values: Vec<f32> = (0..n).flat_map(|i| (0..columns).map(move |k| f(i, k))).collect();
        Tensor::<2>::from_data(TensorData::new(values, [n, columns]), &device).require_grad()
    };
    let noise = |i: usize, k: usize| ((i * 7919 + k * 104_729 + 13) % 1000) as f32 / 1000.0;
    let means = rows(3, |i, k| ((i * 7919 + k * 104_729) % 1000) as f32 / 1000.0 * 1.6 - [0.8, 0.0, 0.8][k]);
    let rotations = rows(4, |i, k| ((i * 31 + k * 17) % 19) as f32 - 9.3);
    let scales = rows(3, |i, k| 0.005 + 0.03 * (((i + 3 * k) % 7) as f32 / 7.0));
    let colors = rows(3, |i, k| ((i * 5 + k) % 11) as f32 / 11.0);
    let opacities: Vec<f32> = (0..n).map(|i| noise(i, 1)).collect();
    let opacities = Tensor::<1>::from_data(TensorData::new(opacities, [n]), &device).require_grad();
    let background = Tensor::<1>::from_floats([0.2, 0.4, 0.6], &device).require_grad();
    let all = [means.clone(), rotations.clone(), scales.clone(), colors.clone()];
    let gaussians = Gaussians::new(means, rotations, scales, opacities.clone(), colors).expect("shapes");
    let options = RenderOptions { background: Some(background.clone()), ..options.clone() };
    let cameras = Camera::orbit(3, 83, 61);
    let rendered = render(&gaussians, &cameras, &options).expect("rendered");
    let grads = (rendered.color.clone().square().sum() + rendered.alpha.sum()).backward();
    let vec = |tensor: Tensor<1>| -> Vec<f32> { tensor.into_data().try_into_vec().expect("f32") };
    let [m, r, s, c] = all.map(|t| vec(t.grad(&grads).expect("tracked").reshape([-1])));
    [
        vec(rendered.color.reshape([-1])),
        m,
        r,
        s,
        c,
        vec(opacities.grad(&grads).expect("tracked")),
        vec(background.grad(&grads).expect("tracked")),
    ]
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
