//! Cameras and options of one call of the operation, and its counts, as plain host data.

use super::splat::{FATES, Uniforms};
use crate::linear::{Mat3, Vec3};
use crate::options::{MIN_TRANSMITTANCE, RenderOptions, TILE};
use crate::projection::View;
use crate::{Camera, SplatError};

/// Numbers of visible and of culled Gaussians, summed over the views of a render.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Gaussians that reach the centre of at least one pixel.
    pub visible: u64,
    /// Depth t_z at most `near`.
    pub near: u64,
    /// No pixel's centre within reach.
    pub outside: u64,
    /// Opacity (after antialiasing) below 1/255.
    pub transparent: u64,
    /// A quaternion shorter than 1e-6, a projected quantity beyond ±1e18, or a determinant that is not positive.
    pub degenerate: u64,
    /// A parameter that is NaN, infinite, or beyond ±1e18.
    pub invalid: u64,
    /// Pairs of a splat and a 16×16 tile that it reaches. The run time grows with them.
    pub intersections: u64,
}

impl Counts {
    /// `fates` has the number of Gaussians of each fate, in the order of the constants in [`super::splat`].
    pub(super) fn new(fates: [u64; FATES], intersections: u64) -> Self {
        let [visible, near, outside, transparent, degenerate, invalid] = fates;
        Self { visible, near, outside, transparent, degenerate, invalid, intersections }
    }
}

/// Channels of an image: red, green, blue, alpha, and depth if asked for.
pub fn channels(depth: bool) -> usize {
    if depth { 5 } else { 4 }
}

/// The cameras of one call, in the form that the kernels use, and its options.
#[derive(Debug, Clone)]
pub struct Job {
    pub(super) views: Vec<View>,
    pub(super) width: usize,
    pub(super) height: usize,
    /// Without the background: the operation renders over black.
    pub(super) options: RenderOptions,
}

impl Job {
    pub(crate) fn new(cameras: &[Camera], options: &RenderOptions) -> Result<Self, SplatError> {
        let first = cameras.first().ok_or(SplatError::NoCamera)?;
        for (index, camera) in cameras.iter().enumerate() {
            camera.check().map_err(|problem| SplatError::Camera { index, problem })?;
            if (camera.width, camera.height) != (first.width, first.height) {
                let problem = format!(
                    "its image is {}×{}, the first camera's is {}×{}; render different sizes in separate calls",
                    camera.width, camera.height, first.width, first.height
                );
                return Err(SplatError::Camera { index, problem });
            }
        }
        let RenderOptions { max_alpha, blur, near, .. } = *options;
        let check = |field, holds: bool, allowed| {
            if holds { Ok(()) } else { Err(SplatError::Option { field, allowed }) }
        };
        // With a larger limit, a single clamped splat would close the pixel without being drawn.
        let largest = 1.0 - MIN_TRANSMITTANCE;
        check("max_alpha", max_alpha > 0.0 && max_alpha < largest, "within (0, 0.9999)")?;
        check("blur", blur > 0.0 && blur <= 1e6, "positive and at most 1e6 square pixels")?;
        check("near", near > 0.0 && near.is_finite(), "positive and finite")?;
        Ok(Self {
            views: cameras.iter().map(view).collect(),
            width: first.width as usize,
            height: first.height as usize,
            options: RenderOptions { background: None, ..options.clone() },
        })
    }

    /// Channels of the image.
    pub(super) fn channels(&self) -> usize {
        channels(self.options.depth)
    }

    /// Sizes and constants of a call with `n` Gaussians.
    pub(super) fn uniforms(&self, n: usize) -> Uniforms {
        Uniforms {
            n,
            views: self.views.len(),
            width: self.width as u32,
            height: self.height as u32,
            tiles_x: self.tiles_x() as u32,
            tiles: (self.tiles_x() * self.tiles_y()) as u32,
            near: self.options.near,
            blur: self.options.blur,
            max_alpha: self.options.max_alpha,
        }
    }

    pub(super) fn tiles_x(&self) -> usize {
        self.width.div_ceil(TILE)
    }

    pub(super) fn tiles_y(&self) -> usize {
        self.height.div_ceil(TILE)
    }
}

fn view(camera: &Camera) -> View {
    let r = camera.world_to_camera.rotation;
    let row = |i: usize| {
        let v = r.row(i);
        Vec3 { x: v.x as f32, y: v.y as f32, z: v.z as f32 }
    };
    let centre = camera.centre();
    let high = centre.as_vec3();
    let low = (centre - high.as_dvec3()).as_vec3();
    // The image borders, as t_x/t_z or t_y/t_z, plus 15 % of the image on either side.
    let limits = |side: u32, focal: f64, principal: f64| {
        let margin = 0.15 * f64::from(side);
        ((-(principal + margin) / focal) as f32, ((f64::from(side) - principal + margin) / focal) as f32)
    };
    let (x_min, x_max) = limits(camera.width, camera.focal.x, camera.principal_point.x);
    let (y_min, y_max) = limits(camera.height, camera.focal.y, camera.principal_point.y);
    View {
        rotation: Mat3 { r0: row(0), r1: row(1), r2: row(2) },
        centre: Vec3 { x: high.x, y: high.y, z: high.z },
        centre_rest: Vec3 { x: low.x, y: low.y, z: low.z },
        fx: camera.focal.x as f32,
        fy: camera.focal.y as f32,
        cx: camera.principal_point.x as f32,
        cy: camera.principal_point.y as f32,
        x_min,
        x_max,
        y_min,
        y_max,
    }
}
