//! Choices by the names that configs give them.

use serde::{Deserialize, Serialize};

macro_rules! names {
    ($(#[$doc:meta])* $name:ident { $($(#[$vdoc:meta])* $variant:ident = $text:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
        pub enum $name { $($(#[$vdoc])* #[serde(rename = $text)] $variant),+ }
    };
}

names! {
    /// Kind of head.
    HeadKind {
        /// Convolutional head over four token maps.
        Dpt = "dpt",
        /// One linear layer and a pixel shuffle.
        Linear = "linear",
    }
}
names! {
    /// Network between photographs and raw points.
    Body {
        /// DUSt3R: encoder, two decoders, a head per view (docs/method.md, "Point predictor").
        Transformer = "transformer",
        /// A U-shaped convolutional network over both photographs, with attention at the coarsest level
        /// (docs/method.md, "Convolutional body").
        Convolution = "convolution",
    }
}
names! {
    /// Origin of predicted points (docs/method.md, "Ray anchors").
    Anchor {
        /// The front camera: direction and exponential distance, as published.
        None = "none",
        /// Where the pixel's ray, of the nominal camera, meets the plane through the body's axis: metres over δ.
        Ray = "ray",
    }
}
names! {
    /// Fusion of the photographs' tokens into those of the unseen sides (docs/method.md, "Tokens of the sides").
    Fusion {
        /// Arithmetic mean at equal token positions.
        Mean = "mean",
        /// Mean of the front tokens and the horizontally flipped back tokens.
        MirrorMean = "mirror-mean",
        /// Both token maps stacked along the channels.
        Concat = "concat",
    }
}
names! {
    /// Activation of the confidence channel (docs/method.md, "Points and confidence").
    ConfMode {
        /// 1 / (1 + e^−x), Snap-Snap.
        Sigmoid = "sigmoid",
        /// 1 + e^x, DUSt3R.
        Exp = "exp",
    }
}
names! {
    /// Interpolation of points and confidences from the network's grid to the canvas.
    Upsample {
        /// Bilinear, blending body and background points across the silhouette.
        Bilinear = "bilinear",
        /// Bilinear, normalised by the mask: only body points are blended
        /// (docs/method.md, "Enlargement and delta").
        MaskAware = "mask-aware",
    }
}
names! {
    /// Reference of the regressor's output (docs/method.md, "Attributes").
    RegressorStart {
        /// Fixed: at zero output a Gaussian has a size of 0.7 mm, opacity ½ and grey colour.
        Published = "published",
        /// The point map and the picture: at zero output a Gaussian is round, as large as its point's distance from its
        /// neighbours asks, opaque, and has the pixel's colour.
        Geometric = "geometric",
    }
}
names! {
    /// Source of a Gaussian's colour (docs/method.md, "Colour residual").
    RegressorColor {
        /// The network's own.
        Free = "free",
        /// The pixel's, which the network corrects.
        Residual = "residual",
    }
}
names! {
    /// Axes that predicted quaternions refer to.
    RotationFrame {
        /// The front camera's. Quaternions are rotated into the world with the means.
        Camera = "camera",
        /// Passed on unchanged, as if they were in world axes.
        World = "world",
    }
}
names! {
    /// Reduction of the canvas to the network's input.
    Downsample {
        /// Mean over the pixels that fall into one.
        Area = "area",
        /// The first pixel of each cell.
        Nearest = "nearest",
    }
}
names! {
    /// World frame of the PLY.
    WorldFrame {
        /// y up, metres, feet near y = 0, subject upright and facing +z: the training cameras' world.
        Upright = "upright",
        /// The published demo's diag(−1, −1, −1) about (0, 0, 2): a mirror image.
        Mirrored = "mirrored",
    }
}
