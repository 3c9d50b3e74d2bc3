//! Small scenes for the splatting operation, on a device and for the f64 oracle.

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DMat3, DVec2, DVec3};
use snapsnap_splat::reference::Scene;
use snapsnap_splat::{Camera, Counts, Gaussians, RenderOptions, RigidTransform, render};

use crate::values;

/// SplitMix64: the same numbers on every machine.
pub struct Random(pub u64);

impl Random {
    /// In [0, 1).
    pub fn uniform(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f32 / (1_u64 << 24) as f32
    }

    /// In [low, high).
    pub fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.uniform()
    }
}

/// Gaussians on the host: mean (3), rotation (4, w first), scale (3), opacity, colour (3).
#[derive(Clone, Debug)]
pub struct HostScene {
    /// One Gaussian after another.
    pub gaussians: Vec<[f32; 14]>,
    /// Colour of the background.
    pub background: [f32; 3],
}

/// A camera at the origin that looks along z, with its image's centre off the axis and unequal focal lengths.
pub fn forward_camera(width: u32, height: u32) -> Camera {
    let size = f64::from(width.max(height));
    Camera {
        width,
        height,
        focal: DVec2::new(1.1 * size, 1.05 * size),
        principal_point: DVec2::new(0.48 * f64::from(width), 0.53 * f64::from(height)),
        world_to_camera: RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
    }
}

/// Random Gaussians for [`forward_camera`]: in the image and beyond its border, 1 to 4 m away, opaque to faint.
pub fn random_scene(n: usize, seed: u64) -> HostScene {
    let mut r = Random(seed);
    let gaussian = |_| {
        let z = r.between(1.0, 4.0);
        let (x, y) = (z * r.between(-0.6, 0.6), z * r.between(-0.6, 0.6));
        let q: [f32; 4] = std::array::from_fn(|_| r.between(-1.0, 1.0));
        let s: [f32; 3] = std::array::from_fn(|_| z * (0.02 * r.between(0.0, 3.0).exp2()));
        let opacity = r.between(0.05, 1.0);
        let c: [f32; 3] = std::array::from_fn(|_| r.uniform());
        [x, y, z, q[0], q[1], q[2], q[3], s[0], s[1], s[2], opacity, c[0], c[1], c[2]]
    };
    HostScene { gaussians: (0..n).map(gaussian).collect(), background: [0.2, 0.5, 0.9] }
}

/// Result of a forward and a backward pass.
#[derive(Clone, Debug)]
pub struct Pass {
    /// `[V,H,W,5]`: red, green, blue, alpha, depth.
    pub image: Vec<f32>,
    /// In the order of [`HostScene::gaussians`].
    pub gradient: Vec<[f32; 14]>,
    /// ∂L/∂background.
    pub background: [f32; 3],
    /// Numbers of visible and of culled Gaussians.
    pub counts: Counts,
}

/// Tracked tensors of a scene.
pub struct Tracked {
    /// Means `[N,3]`, rotations `[N,4]`, scales `[N,3]`, colours `[N,3]`.
    pub rows: [Tensor<2>; 4],
    /// `[N]`.
    pub opacities: Tensor<1>,
    /// `[3]`.
    pub background: Tensor<1>,
}

impl Tracked {
    /// The tracked tensors as Gaussians.
    pub fn gaussians(&self) -> Gaussians {
        let [means, rotations, scales, colors] = self.rows.clone();
        Gaussians::new(means, rotations, scales, self.opacities.clone(), colors).expect("shapes")
    }
}

impl HostScene {
    /// The scene in f64, for the oracle.
    pub fn in_f64(&self) -> Scene<f64> {
        Scene {
            gaussians: self.gaussians.iter().map(|g| g.map(f64::from)).collect(),
            background: self.background.map(f64::from),
        }
    }

    fn columns(&self, first: usize, count: usize) -> TensorData {
        let values: Vec<f32> = self.gaussians.iter().flat_map(|g| g[first..first + count].to_vec()).collect();
        TensorData::new(values, [self.gaussians.len(), count])
    }

    /// The scene's tensors on `device`, tracked if it is an autodiff device.
    pub fn on(&self, device: &Device) -> Tracked {
        let rows = |first, count| {
            let tensor = Tensor::<2>::from_data(self.columns(first, count), device);
            if device.is_autodiff() { tensor.require_grad() } else { tensor }
        };
        let flat = |values: Vec<f32>| {
            let n = values.len();
            let tensor = Tensor::<1>::from_data(TensorData::new(values, [n]), device);
            if device.is_autodiff() { tensor.require_grad() } else { tensor }
        };
        Tracked {
            rows: [rows(0, 3), rows(3, 4), rows(7, 3), rows(11, 3)],
            opacities: flat(self.gaussians.iter().map(|g| g[10]).collect()),
            background: flat(self.background.to_vec()),
        }
    }

    /// Renders with depth, and differentiates Σ ⟨pixel channels, `upstream`⟩, upstream `[V,H,W,5]`.
    pub fn pass(
        &self,
        cameras: &[Camera],
        options: &RenderOptions,
        upstream: &[f32],
        device: &Device,
    ) -> Pass {
        let tracked = self.on(&device.clone().autodiff());
        let background = Some(tracked.background.clone());
        let options = RenderOptions { depth: true, background, ..options.clone() };
        let rendered = render(&tracked.gaussians(), cameras, &options).expect("rendered");
        let image = Tensor::cat(
            vec![
                rendered.color,
                rendered.alpha.unsqueeze_dim::<4>(3),
                rendered.depth.expect("asked for").unsqueeze_dim::<4>(3),
            ],
            3,
        );
        let upstream = TensorData::new(upstream.to_vec(), image.dims());
        let loss = (image.clone() * Tensor::<4>::from_data(upstream, &device.clone().autodiff())).sum();
        let grads = loss.backward();
        let rows = tracked.rows.each_ref().map(|t| values(t.grad(&grads).expect("tracked")));
        let opacities = values(tracked.opacities.grad(&grads).expect("tracked"));
        let background = values(tracked.background.grad(&grads).expect("tracked"));
        assert_eq!(opacities.len(), self.gaussians.len());
        let gradient = (0..self.gaussians.len())
            .map(|i| {
                let [means, rotations, scales, colors] = &rows;
                let mut all = [0.0; 14];
                all[..3].copy_from_slice(&means[3 * i..3 * i + 3]);
                all[3..7].copy_from_slice(&rotations[4 * i..4 * i + 4]);
                all[7..10].copy_from_slice(&scales[3 * i..3 * i + 3]);
                all[10] = opacities[i];
                all[11..].copy_from_slice(&colors[3 * i..3 * i + 3]);
                all
            })
            .collect();
        let background = [background[0], background[1], background[2]];
        Pass { image: values(image), gradient, background, counts: rendered.counts }
    }
}

/// Random weights for `pixels` pixels of five channels, in [−1, 1).
pub fn random_upstream(pixels: usize, seed: u64) -> Vec<f32> {
    let mut random = Random(seed);
    (0..5 * pixels).map(|_| random.between(-1.0, 1.0)).collect()
}
