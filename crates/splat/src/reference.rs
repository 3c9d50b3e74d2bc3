//! The reference of the splatting operation: every Gaussian at every pixel, in f64, without tiles and lists.
//!
//! It is slow and follows the formulas literally: Σ = R(q)·S²·R(q)ᵀ, Σ' = J·W·Σ·Wᵀ·Jᵀ + ε·I,
//! α = min(α_max, o·exp(−½·dᵀ·Σ'⁻¹·d)), front to back. Gradients come from dual numbers, not from formulas.

use std::ops::{Add, Div, Mul, Neg, Sub};

use rayon::prelude::*;

use crate::options::{MIN_ALPHA, MIN_TRANSMITTANCE};
use crate::{Camera, RenderOptions};

/// Number type of the reference: f64, f64 with derivatives, or f32 for comparison.
pub trait Number:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// A constant.
    fn new(value: f64) -> Self;
    /// The number without its derivatives.
    fn value(self) -> f64;
    /// eˣ.
    fn exp(self) -> Self;
    /// √x.
    fn sqrt(self) -> Self;
}

macro_rules! floats {
    ($($float:ty),*) => {$(
        impl Number for $float {
            fn new(value: f64) -> Self {
                value as $float
            }

            fn value(self) -> f64 {
                f64::from(self)
            }

            fn exp(self) -> Self {
                <$float>::exp(self)
            }

            fn sqrt(self) -> Self {
                <$float>::sqrt(self)
            }
        }
    )*};
}

// f32 only shows the accuracy of the plain formulas in single precision.
floats!(f32, f64);

/// A number and its derivatives with respect to `K` inputs.
#[derive(Clone, Copy, Debug)]
pub struct Dual<const K: usize> {
    value: f64,
    parts: [f64; K],
}

impl<const K: usize> Dual<K> {
    /// The number with derivatives `factor · self.parts`.
    fn chain(self, value: f64, factor: f64) -> Self {
        Self { value, parts: self.parts.map(|p| factor * p) }
    }

    fn with(self, other: Self, value: f64, f: f64, g: f64) -> Self {
        Self { value, parts: std::array::from_fn(|k| f * self.parts[k] + g * other.parts[k]) }
    }
}

/// Operators: the value for operands of the values a and b, and its derivatives with respect to a and b.
macro_rules! operators {
    ($($operator:ident $name:ident |$a:ident, $b:ident| $value:expr, $by_a:expr, $by_b:expr;)*) => {$(
        impl<const K: usize> $operator for Dual<K> {
            type Output = Self;
            fn $name(self, other: Self) -> Self {
                let ($a, $b) = (self.value, other.value);
                self.with(other, $value, $by_a, $by_b)
            }
        }
    )*};
}

operators! {
    Add add |a, b| a + b, 1.0, 1.0;
    Sub sub |a, b| a - b, 1.0, -1.0;
    Mul mul |a, b| a * b, b, a;
    Div div |a, b| a / b, 1.0 / b, -(a / b) / b;
}

impl<const K: usize> Neg for Dual<K> {
    type Output = Self;
    fn neg(self) -> Self {
        self.chain(-self.value, -1.0)
    }
}

impl<const K: usize> Number for Dual<K> {
    fn new(value: f64) -> Self {
        Self { value, parts: [0.0; K] }
    }

    fn value(self) -> f64 {
        self.value
    }

    fn exp(self) -> Self {
        let e = self.value.exp();
        self.chain(e, e)
    }

    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        self.chain(root, if root > 0.0 { 0.5 / root } else { 0.0 })
    }
}

/// Gaussians and background, 14 numbers per Gaussian: mean (3), rotation (4, w first), scale (3), opacity, colour (3).
#[derive(Clone, Debug)]
pub struct Scene<T> {
    /// One Gaussian after another.
    pub gaussians: Vec<[T; 14]>,
    /// Colour behind the Gaussians.
    pub background: [T; 3],
}

impl<T: Copy> Scene<T> {
    fn map<U>(&self, mut f: impl FnMut(usize, T) -> U) -> Scene<U> {
        let mut index = 0;
        let mut next = |v| {
            index += 1;
            f(index - 1, v)
        };
        Scene {
            gaussians: self.gaussians.iter().map(|g| g.map(&mut next)).collect(),
            background: self.background.map(&mut next),
        }
    }
}

/// Red, green, blue, alpha (1 − T_final), depth (Σ t_z·α·T).
pub type Pixel<T> = [T; 5];

/// Cut-off of splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cutoff {
    /// As specified: skipped below α = 1/255, closed at T = 1e-4.
    Hard,
    /// For finite differences: α fades smoothly to zero between 1.5/255 and 0.5/255, and pixels never close.
    Smooth,
}

/// A projected Gaussian.
struct Splat<T> {
    /// Row of the Gaussian.
    index: usize,
    centre: [T; 2],
    /// Σ'⁻¹: xx, xy, yy.
    conic: [T; 3],
    opacity: T,
    /// Red, green, blue, depth.
    values: [T; 4],
}

/// Renders `scene` into `camera`, row by row.
pub fn render<T: Number>(
    scene: &Scene<T>,
    camera: &Camera,
    options: &RenderOptions,
    cutoff: Cutoff,
) -> Vec<Pixel<T>> {
    pixels(scene, camera, options, cutoff, 0..camera.width * camera.height)
}

/// As [`render`], for the pixels `which` only, numbered row by row.
pub fn pixels<T: Number>(
    scene: &Scene<T>,
    camera: &Camera,
    options: &RenderOptions,
    cutoff: Cutoff,
    which: impl Iterator<Item = u32>,
) -> Vec<Pixel<T>> {
    let splats = splats(scene, camera, options);
    let pixel =
        |at: u32| composite(&splats, centre(at, camera), scene.background, options, cutoff, |_, _| ());
    which.map(pixel).collect()
}

/// All splats, front to back.
fn splats<T: Number>(scene: &Scene<T>, camera: &Camera, options: &RenderOptions) -> Vec<Splat<T>> {
    let rows = scene.gaussians.iter().enumerate();
    let mut splats: Vec<Splat<T>> = rows.filter_map(|(i, g)| splat(i, g, camera, options)).collect();
    // A stable sort: ties stay in input order.
    splats.sort_by(|a, b| a.values[3].value().total_cmp(&b.values[3].value()));
    splats
}

/// Centre of a pixel.
fn centre(at: u32, camera: &Camera) -> [f64; 2] {
    [f64::from(at % camera.width) + 0.5, f64::from(at / camera.width) + 0.5]
}

/// For each pixel, whether a cut-off (α = 1/255, T = 1e-4, α_max) is so close that f32 may decide differently.
pub fn banded(scene: &Scene<f64>, camera: &Camera, options: &RenderOptions) -> Vec<bool> {
    let with = |scale: f64| {
        let mut scene = scene.clone();
        scene.gaussians.iter_mut().for_each(|g| g[10] *= scale);
        contributors(&scene, camera, options)
    };
    // A relative change of every α, larger than its rounding error.
    let (less, more) = (with(1.0 - 1e-4), with(1.0 + 1e-4));
    less.into_iter().zip(more).map(|(a, b)| a != b).collect()
}

/// The splats that each pixel takes, and whether their α is clamped.
fn contributors(scene: &Scene<f64>, camera: &Camera, options: &RenderOptions) -> Vec<Vec<(usize, bool)>> {
    let splats = splats(scene, camera, options);
    let pixel = |at: u32| {
        let mut taken = Vec::new();
        let take = |index, is_clamped| taken.push((index, is_clamped));
        composite(&splats, centre(at, camera), scene.background, options, Cutoff::Hard, take);
        taken
    };
    (0..camera.width * camera.height).map(pixel).collect()
}

fn splat<T: Number>(index: usize, g: &[T; 14], camera: &Camera, options: &RenderOptions) -> Option<Splat<T>> {
    let [mx, my, mz, w, x, y, z, sx, sy, sz, opacity, red, green, blue] = *g;
    let n = T::new;
    let dot = |a: [T; 3], b: [T; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let world_to_camera = camera.world_to_camera;
    let row = |i: usize| world_to_camera.rotation.row(i).to_array().map(n);
    let rotation = [row(0), row(1), row(2)];
    let t: [T; 3] =
        std::array::from_fn(|i| dot(rotation[i], [mx, my, mz]) + n(world_to_camera.translation[i]));
    if t[2].value() <= f64::from(options.near) {
        return None;
    }

    let norm = (w * w + x * x + y * y + z * z).sqrt();
    let [w, x, y, z] = [w / norm, x / norm, y / norm, z / norm];
    let (one, two) = (n(1.0), n(2.0));
    let r = [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ];
    let squares = [sx * sx, sy * sy, sz * sz];
    let sigma: [[T; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|j| dot([r[i][0] * squares[0], r[i][1] * squares[1], r[i][2] * squares[2]], r[j]))
    });

    // Rows of J·W, with J linearised inside the image plus 15 % on either side.
    let clamped = |ratio: T, side: u32, focal: f64, principal: f64| {
        let side = f64::from(side);
        let (low, high) = ((-principal - 0.15 * side) / focal, (side - principal + 0.15 * side) / focal);
        if (low..=high).contains(&ratio.value()) { ratio } else { n(ratio.value().clamp(low, high)) }
    };
    let (f, c) = (camera.focal, camera.principal_point);
    let ratio_x = clamped(t[0] / t[2], camera.width, f.x, c.x);
    let ratio_y = clamped(t[1] / t[2], camera.height, f.y, c.y);
    let (jx, jy) = (n(f.x) / t[2], n(f.y) / t[2]);
    let jw_x: [T; 3] = std::array::from_fn(|k| jx * (rotation[0][k] - ratio_x * rotation[2][k]));
    let jw_y: [T; 3] = std::array::from_fn(|k| jy * (rotation[1][k] - ratio_y * rotation[2][k]));
    let between = |a: [T; 3], b: [T; 3]| {
        let sigma_b: [T; 3] = std::array::from_fn(|i| dot(sigma[i], b));
        dot(a, sigma_b)
    };
    let (raw_xx, xy, raw_yy) = (between(jw_x, jw_x), between(jw_x, jw_y), between(jw_y, jw_y));
    let blur = n(f64::from(options.blur));
    let (xx, yy) = (raw_xx + blur, raw_yy + blur);
    let determinant = xx * yy - xy * xy;
    let opacity = if options.antialiased {
        opacity * ((raw_xx * raw_yy - xy * xy) / determinant).sqrt()
    } else {
        opacity
    };
    Some(Splat {
        index,
        centre: [n(f.x) * t[0] / t[2] + n(c.x), n(f.y) * t[1] / t[2] + n(c.y)],
        conic: [yy / determinant, -xy / determinant, xx / determinant],
        opacity,
        values: [red, green, blue, t[2]],
    })
}

/// Composites a pixel. `take` is called for each splat that the pixel takes: its index, and whether its α is clamped.
fn composite<T: Number>(
    splats: &[Splat<T>],
    pixel: [f64; 2],
    background: [T; 3],
    options: &RenderOptions,
    cutoff: Cutoff,
    mut take: impl FnMut(usize, bool),
) -> Pixel<T> {
    let n = T::new;
    let (least, closed) = (f64::from(MIN_ALPHA), f64::from(MIN_TRANSMITTANCE));
    let mut sums = [n(0.0); 4];
    let mut transmittance = n(1.0);
    for splat in splats {
        let d = [n(pixel[0]) - splat.centre[0], n(pixel[1]) - splat.centre[1]];
        let [xx, xy, yy] = splat.conic;
        let form = d[0] * d[0] * xx + n(2.0) * d[0] * d[1] * xy + d[1] * d[1] * yy;
        let mut alpha = splat.opacity * (n(-0.5) * form).exp();
        let is_clamped = alpha.value() > f64::from(options.max_alpha);
        if is_clamped {
            alpha = n(f64::from(options.max_alpha));
        }
        match cutoff {
            Cutoff::Hard if alpha.value() < least => continue,
            Cutoff::Hard => {}
            Cutoff::Smooth => {
                let at = (alpha - n(0.5 * least)) / n(least);
                if at.value() <= 0.0 {
                    continue;
                }
                if at.value() < 1.0 {
                    alpha = alpha * at * at * (n(3.0) - n(2.0) * at);
                }
            }
        }
        let next = transmittance * (n(1.0) - alpha);
        if cutoff == Cutoff::Hard && next.value() < closed {
            break;
        }
        take(splat.index, is_clamped);
        let weight = alpha * transmittance;
        for (sum, value) in sums.iter_mut().zip(splat.values) {
            *sum = *sum + value * weight;
        }
        transmittance = next;
    }
    for (sum, color) in sums.iter_mut().zip(background) {
        *sum = *sum + color * transmittance;
    }
    let [red, green, blue, depth] = sums;
    [red, green, blue, n(1.0) - transmittance, depth]
}

/// Gradient of Σ ⟨pixel, `upstream`⟩ with respect to every number of `scene`.
pub fn gradient(
    scene: &Scene<f64>,
    camera: &Camera,
    options: &RenderOptions,
    cutoff: Cutoff,
    upstream: &[[f64; 5]],
) -> Scene<f64> {
    /// Inputs per pass.
    const K: usize = 10;
    let inputs = 14 * scene.gaussians.len() + 3;
    let pass = |first: usize| {
        let seeded = scene.map(|index, value| {
            let parts = std::array::from_fn(|k| f64::from(u8::from(first + k == index)));
            Dual::<K> { value, parts }
        });
        let mut sum = [0.0; K];
        for (pixel, upstream) in render(&seeded, camera, options, cutoff).iter().zip(upstream) {
            for (channel, weight) in pixel.iter().zip(upstream) {
                sum.iter_mut().zip(channel.parts).for_each(|(s, p)| *s += weight * p);
            }
        }
        sum
    };
    let passes: Vec<[f64; K]> = (0..inputs.div_ceil(K)).into_par_iter().map(|i| pass(i * K)).collect();
    let gradient = passes.concat();
    scene.map(|index, _| gradient[index])
}
