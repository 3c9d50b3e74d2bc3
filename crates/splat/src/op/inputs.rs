//! One value for each input, and one for each output, of a call: tensors, their values, their gradients.

/// One value for each input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Inputs<T> {
    pub means: T,
    pub rotations: T,
    pub scales: T,
    pub opacities: T,
    pub colors: T,
}

/// Which inputs need gradients.
pub type Wanted = Inputs<bool>;

impl<T> Inputs<T> {
    /// The values in the order of the fields.
    pub fn from_array([means, rotations, scales, opacities, colors]: [T; 5]) -> Self {
        Self { means, rotations, scales, opacities, colors }
    }

    /// The inverse of [`Self::from_array`].
    pub fn into_array(self) -> [T; 5] {
        [self.means, self.rotations, self.scales, self.opacities, self.colors]
    }

    pub fn as_ref(&self) -> Inputs<&T> {
        let Self { means, rotations, scales, opacities, colors } = self;
        Inputs { means, rotations, scales, opacities, colors }
    }

    pub fn as_mut(&mut self) -> Inputs<&mut T> {
        let Self { means, rotations, scales, opacities, colors } = self;
        Inputs { means, rotations, scales, opacities, colors }
    }

    pub fn map<U>(self, f: impl FnMut(T) -> U) -> Inputs<U> {
        Inputs::from_array(self.into_array().map(f))
    }

    /// Applies `f` to each value and the value of `other` for the same input.
    pub fn with<U, R>(self, other: Inputs<U>, mut f: impl FnMut(T, U) -> R) -> Inputs<R> {
        let mut others = other.into_array().into_iter();
        self.map(|value| f(value, others.next().expect("as many of them")))
    }
}

impl Wanted {
    /// Whether the gradient of a mean, rotation or scale is wanted: they share their sums over pixels.
    pub fn geometry(self) -> bool {
        self.means || self.rotations || self.scales
    }
}

/// ∂L/∂ of the outputs of a call; `None` for outputs without a gradient. The outputs stay separate, since joining
/// images costs several times their memory.
#[derive(Debug, Clone, Copy)]
pub struct Upstream<T> {
    /// Colours `[V,H,W,3]`.
    pub color: Option<T>,
    /// Alphas `[V,H,W,1]`.
    pub alpha: Option<T>,
    /// Depths `[V,H,W,1]`.
    pub depth: Option<T>,
}

impl<T> Upstream<T> {
    pub fn as_ref(&self) -> Upstream<&T> {
        let Self { color, alpha, depth } = self;
        Upstream { color: color.as_ref(), alpha: alpha.as_ref(), depth: depth.as_ref() }
    }

    pub fn map<U>(self, f: impl Fn(T) -> U) -> Upstream<U> {
        let Self { color, alpha, depth } = self;
        Upstream { color: color.map(&f), alpha: alpha.map(&f), depth: depth.map(&f) }
    }
}
