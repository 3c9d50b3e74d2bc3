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
    /// What lies between photographs and raw points.
    Body {
        /// DUSt3R: encoder, two decoders, a head per view (SNAPSNAP §1).
        Transformer = "transformer",
        /// A U-shaped convolutional network over both photographs at once with attention where it is coarsest (LEARNING.md).
        Convolution = "convolution",
    }
}
names! {
    /// What predicted points are measured from (LEARNING.md).
    Anchor {
        /// The front camera: direction and exponential distance, as published.
        None = "none",
        /// Where the pixel's ray, of the nominal camera, meets the plane through the body's axis: metres over δ.
        Ray = "ray",
    }
}
names! {
    /// How the tokens of the two photographs become those of the unseen sides (SNAPSNAP §4, §13.3 fix 4).
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
    /// Activation of the confidence channel (SNAPSNAP §2.2).
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
        /// Bilinear, normalised by the mask: only body points are blended (SNAPSNAP §13.3 fix 6).
        MaskAware = "mask-aware",
    }
}
names! {
    /// What the regressor's output is measured from (LEARNING.md).
    RegressorStart {
        /// Nothing: sizes of 0.7 mm, half transparent, grey (SNAPSNAP §8.3).
        Published = "published",
        /// The point map and the picture: at zero output a Gaussian is round, as large as its point's distance from its
        /// neighbours asks, opaque, and has the pixel's colour.
        Geometric = "geometric",
    }
}
names! {
    /// Where a Gaussian's colour comes from (LEARNING.md).
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
        /// The front camera's; rotated into the world with the means (SNAPSNAP §13.3 fix 1).
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
