//! Rotary attention and bilinear resizing as [`Kernel`]s with gradients, for training on `flex`.

use burn::tensor::Tensor;

use crate::op::{self, Kept, Kernel};
use snapsnap_base::bilinear::Tap;

use crate::resize::{resize, resize_gradient};
use crate::train::{Attention, Tokens};
use crate::{Rope, host};

/// Rotary attention. Queries, keys and values are three tensors (`apart`) or side by side in one tensor.
#[derive(Debug)]
struct Attend {
    sizes: Attention,
    /// Tables of cos and ±sin, as in [`Rope`].
    tables: [Vec<f32>; 2],
    apart: bool,
}

impl Attend {
    fn tokens<'a>(&self, [q, k, v]: [&'a [f32]; 3]) -> [Tokens<'a>; 3] {
        let channels = self.sizes.heads * self.sizes.head_dim;
        if self.apart { Tokens::apart([q, k, v], channels) } else { Tokens::parts(q, channels) }
    }
}

impl Kernel for Attend {
    fn shape(&self) -> Vec<usize> {
        vec![self.sizes.batch, self.sizes.queries, self.sizes.heads * self.sizes.head_dim]
    }

    fn forward(&self, inputs: [&[f32]; 3], keep: bool) -> (Vec<f32>, Kept) {
        let tables = self.tables.each_ref().map(Vec::as_slice);
        let (out, logarithms) = self.sizes.forward(self.tokens(inputs), tables);
        let kept: Kept = if keep { Some(Box::new(logarithms)) } else { None };
        (out, kept)
    }

    fn backward(
        &self,
        inputs: [&[f32]; 3],
        kept: Kept,
        upstream: &[f32],
        wanted: [bool; 3],
    ) -> [Option<Vec<f32>>; 3] {
        let logarithms =
            kept.and_then(|kept| kept.downcast::<Vec<f32>>().ok()).expect("kept by the forward pass");
        let (tokens, tables) = (self.tokens(inputs), self.tables.each_ref().map(Vec::as_slice));
        if !self.apart {
            let gradient = self.sizes.backward_parts(tokens, tables, &logarithms, upstream);
            return [Some(gradient), None, None];
        }
        let gradients = self.sizes.backward(tokens, tables, &logarithms, upstream);
        let mut wanted = wanted.into_iter();
        gradients.map(|gradient| wanted.next().expect("three of each").then_some(gradient))
    }
}

/// [`crate::rotary_attention`] with gradients.
pub fn apart([q, k, v]: [Tensor<3>; 3], rope: &Rope, heads: usize, half: bool) -> Tensor<3> {
    let ([batch, queries, c], keys) = (q.dims(), k.dims()[1]);
    let sizes = Attention { batch, queries, keys, heads, head_dim: c / heads, half };
    op::run(Attend { sizes, tables: tables(rope), apart: true }, q, Some(k), Some(v))
}

/// [`crate::rotary_self_attention`] with gradients.
pub fn together(qkv: Tensor<3>, rope: &Rope, heads: usize, half: bool) -> Tensor<3> {
    let [batch, tokens, c] = qkv.dims();
    let sizes = Attention { batch, queries: tokens, keys: tokens, heads, head_dim: c / 3 / heads, half };
    let none: Option<Tensor<1>> = None;
    op::run(Attend { sizes, tables: tables(rope), apart: false }, qkv, none.clone(), none)
}

fn tables(rope: &Rope) -> [Vec<f32>; 2] {
    [host(rope.cos.clone()), host(rope.sin.clone())]
}

/// A bilinear resize.
#[derive(Debug)]
struct Resize {
    /// B, C, H, W of the input.
    from: [usize; 4],
    down: Vec<Tap>,
    across: Vec<Tap>,
}

impl Kernel for Resize {
    fn shape(&self) -> Vec<usize> {
        vec![self.from[0], self.from[1], self.down.len(), self.across.len()]
    }

    fn forward(&self, [x, ..]: [&[f32]; 3], _keep: bool) -> (Vec<f32>, Kept) {
        (resize(x, [self.from[2], self.from[3]], &self.down, &self.across), None)
    }

    fn backward(
        &self,
        _inputs: [&[f32]; 3],
        _kept: Kept,
        upstream: &[f32],
        _wanted: [bool; 3],
    ) -> [Option<Vec<f32>>; 3] {
        let size = [self.from[2], self.from[3]];
        [Some(resize_gradient(upstream, size, &self.down, &self.across)), None, None]
    }
}

/// [`crate::bilinear`] with gradients.
pub fn resized(x: Tensor<4>, down: Vec<Tap>, across: Vec<Tap>) -> Tensor<4> {
    let none: Option<Tensor<1>> = None;
    op::run(Resize { from: x.dims(), down, across }, x, none.clone(), none)
}
