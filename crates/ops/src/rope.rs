//! Rotary position embedding in two dimensions. The first half of a head's channels is rotated by the token's row, the
//! second half by its column (docs/method.md, "Patch embedding and RoPE").

use burn::tensor::{Device, Tensor, TensorData};

use crate::device::in_f32;

/// Cosines and sines of every token's rotation angles, for one grid and one head size.
#[derive(Debug, Clone)]
pub struct Rope {
    /// `[N, head_dim]`: cos θ for both members of each rotated pair.
    pub cos: Tensor<2>,
    /// `[N, head_dim]`: −sin θ for the first member of each pair, +sin θ for the second.
    pub sin: Tensor<2>,
}

impl Rope {
    /// Tables for a grid of `rows` × `columns` tokens, row-major, with `head_dim` channels per head (a multiple of 4).
    ///
    /// The angles are computed in f64: token positions reach the hundreds on large canvases.
    pub fn new(rows: usize, columns: usize, head_dim: usize, base: f64, device: &Device) -> Self {
        assert_eq!(head_dim % 4, 0, "head_dim {head_dim} must be a multiple of 4");
        let pairs = head_dim / 4;
        let (mut cos, mut sin) = (Vec::new(), Vec::new());
        for token in 0..rows * columns {
            for position in [token / columns, token % columns] {
                let angles = (0..pairs).map(|k| position as f64 * base.powf(-(k as f64) / pairs as f64));
                let (s, c): (Vec<f32>, Vec<f32>) =
                    angles.map(f64::sin_cos).map(|(s, c)| (s as f32, c as f32)).unzip();
                cos.extend(c.iter().chain(&c));
                sin.extend(s.iter().map(|v| -v));
                sin.extend(s);
            }
        }
        let tensor = |values| Tensor::from_data(TensorData::new(values, [rows * columns, head_dim]), device);
        Self { cos: tensor(cos), sin: tensor(sin) }
    }

    /// Rotates queries or keys `[B, heads, N, head_dim]`.
    pub fn apply(&self, x: Tensor<4>) -> Tensor<4> {
        let [b, h, n, d] = x.dims();
        in_f32(x, |x| {
            // In each half (row, column), channels k and k + d/4 are a pair. The sine multiplies the other member.
            let swapped = x.clone().reshape([b * h * n, 2, 2, d / 4]).flip([2]).reshape([b, h, n, d]);
            x * self.cos.clone().unsqueeze() + swapped * self.sin.clone().unsqueeze()
        })
    }
}
