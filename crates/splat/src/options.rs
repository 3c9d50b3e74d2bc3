//! Options of a render: constants of the rasteriser, background, optional outputs.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// Side of the square image tiles that share one list of splats, in pixels.
pub const TILE: usize = 16;
/// Largest image side; keeps pixel coordinates exact in f32 and tile numbers in 32 bits.
pub const MAX_SIDE: u32 = 32_768;
/// A splat is skipped at a pixel where its α is below this.
pub const MIN_ALPHA: f32 = 1.0 / 255.0;
/// A pixel is closed by the first splat that would bring its transmittance below this; the splat is not drawn.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;

/// Options of a render. Start from a preset and change fields.
#[derive(Debug, Clone)]
pub struct RenderOptions {
    /// Largest α of a single splat, above 0 and below 1 − [`MIN_TRANSMITTANCE`]. Bounds 1/(1 − α) in the gradient.
    pub max_alpha: f32,
    /// Added to both diagonal entries of the projected covariance, in square pixels: a splat never gets thinner than
    /// a pixel's own footprint. Above 0, at most 1e6.
    pub blur: f32,
    /// Gaussians whose centre is at this camera depth (metres, above 0) or nearer are left out.
    pub near: f32,
    /// Multiply opacity by √(det Σ'_raw / det Σ'), which keeps the total weight of a splat that the blur enlarges.
    pub antialiased: bool,
    /// Render the depth channel as well; otherwise it costs nothing.
    pub depth: bool,
    /// Colour `[3]` behind the Gaussians; differentiable. `None` is black and costs nothing.
    pub background: Option<Tensor<1>>,
    /// Largest number of pairs of a splat and a 16×16 tile: per view on the CPU, per view on average on a GPU. The
    /// time of a render depends on this number. A render with more pairs is refused before drawing.
    pub max_intersections: u64,
}

impl RenderOptions {
    /// Constants of the original 3D Gaussian splatting rasteriser, with which the published weights were trained.
    pub fn inria() -> Self {
        Self {
            max_alpha: 0.99,
            blur: 0.3,
            near: 0.2,
            antialiased: false,
            depth: false,
            background: None,
            max_intersections: u64::MAX,
        }
    }

    /// Constants of gsplat 1.5.
    pub fn gsplat_1_5() -> Self {
        Self { max_alpha: 0.999, near: 0.01, ..Self::inria() }
    }
}

/// Presets of [`RenderOptions`], as configs and command lines name them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// [`RenderOptions::inria`].
    #[default]
    Inria,
    /// [`RenderOptions::gsplat_1_5`].
    Gsplat,
}

impl Preset {
    /// The options of this preset.
    pub fn options(self) -> RenderOptions {
        match self {
            Self::Inria => RenderOptions::inria(),
            Self::Gsplat => RenderOptions::gsplat_1_5(),
        }
    }
}
