//! The enumerations of a config. A config names their variants in kebab case.

use burn::tensor::FloatDType;
use serde::{Deserialize, Serialize};

macro_rules! choices {
    ($($(#[$doc:meta])* $name:ident { $($(#[$vdoc:meta])* $variant:ident),+ $(,)? })+) => {$(
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum $name { $($(#[$vdoc])* $variant),+ }
    )+};
}

choices! {
    /// Kind of head.
    HeadKind {
        /// Convolutional head over four token maps.
        Dpt,
        /// One linear layer and a pixel shuffle.
        Linear,
    }

    /// Network between photographs and raw points.
    Body {
        /// DUSt3R: encoder, two decoders, a head per view (docs/method.md, "Point predictor").
        Transformer,
        /// A U-shaped convolutional network over both photographs, with attention at the coarsest level
        /// (docs/method.md, "Convolutional body").
        Convolution,
    }

    /// Reference point of predicted points (docs/method.md, "Ray anchors").
    Anchor {
        /// The front camera: direction and exponential distance, as published.
        None,
        /// The intersection of the pixel's nominal ray with the plane through the body's axis: metres over δ.
        Ray,
    }

    /// Fusion of the photographs' tokens into tokens of the unseen sides (docs/method.md, "Tokens of the sides").
    Fusion {
        /// Arithmetic mean at equal token positions.
        Mean,
        /// Both token maps stacked along the channels.
        Concat,
    }

    /// How the maps of the unseen sides are made.
    Sides {
        /// By heads of their own, beside the heads of the photographs.
        Predicted,
        /// From the points of both photographs, projected into the sides' cameras and completed
        /// (docs/method.md, "Completed sides").
        Completed,
    }

    /// Activation of the confidence channel (docs/method.md, "Points and confidence").
    ConfMode {
        /// 1 / (1 + e^−x), Snap-Snap.
        Sigmoid,
        /// 1 + e^x, DUSt3R.
        Exp,
    }

    /// Interpolation of points and confidences from the network's grid to the canvas.
    Upsample {
        /// Bilinear, blending body and background points across the silhouette.
        Bilinear,
        /// Bilinear, normalised by the mask: only body points are blended
        /// (docs/method.md, "Enlargement and delta").
        MaskAware,
    }

    /// Reference of the regressor's output (docs/method.md, "Attributes").
    RegressorStart {
        /// Fixed: at zero output a Gaussian has a size of 0.7 mm and opacity ½. Its colour is the network's output.
        Published,
        /// The point map and the picture: at zero output a Gaussian is round, its size is 0.3 times the distance of
        /// the neighbouring points, its opacity is 0.9 or more, and the network corrects its pixel's colour.
        Geometric,
    }

    /// Axes that predicted quaternions refer to.
    RotationFrame {
        /// The front camera's axes. Quaternions are rotated into the world with the means.
        Camera,
        /// World axes: quaternions are passed on unchanged.
        World,
    }

    /// Reduction of the canvas to the network's input.
    Downsample {
        /// The mean of each cell.
        Area,
        /// The first pixel of each cell.
        Nearest,
    }

    /// World frame of the PLY.
    WorldFrame {
        /// y up, metres, feet near y = 0, subject upright and facing +z: the training cameras' world.
        Upright,
        /// The published demo's diag(−1, −1, −1) about (0, 0, 2): a mirror image.
        Mirrored,
    }

    /// Float type of the point predictor's layers, and of weights in files.
    Precision {
        /// 24 bits of mantissa.
        F32,
        /// 8 bits of mantissa, the range of f32.
        Bf16,
        /// 11 bits of mantissa, up to 65,504. Not for trainings.
        F16,
    }
}

impl Precision {
    /// Name in configs.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::F16 => "f16",
        }
    }

    /// Burn's float type.
    pub fn dtype(self) -> FloatDType {
        match self {
            Self::F32 => FloatDType::F32,
            Self::Bf16 => FloatDType::BF16,
            Self::F16 => FloatDType::F16,
        }
    }

    /// Whether it is f32.
    pub fn is_f32(&self) -> bool {
        *self == Self::F32
    }
}
