//! All gradients of a step together: their norm, and its limit.

use burn::module::{Module, Param};
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use snapsnap_net::weights::{NamedVisitor, visit_named};

/// The Euclidean norm of all gradients of `module` together. Not finite if one of them is not.
pub fn norm<M: Module>(module: &M, gradients: &GradientsParams) -> f64 {
    struct Squares<'a> {
        gradients: &'a GradientsParams,
        sums: Vec<Tensor<1>>,
    }
    impl NamedVisitor for Squares<'_> {
        fn visit<const D: usize>(&mut self, _: &str, _: bool, parameter: &Param<Tensor<D>>) {
            if let Some(gradient) = self.gradients.get::<D>(parameter.id) {
                self.sums.push(gradient.square().sum());
            }
        }
    }
    let mut squares = Squares { gradients, sums: Vec::new() };
    visit_named(module, "", &mut squares);
    if squares.sums.is_empty() {
        return 0.0;
    }
    // Read back once, and added in f64.
    let sums: Vec<f32> = Tensor::cat(squares.sums, 0).into_data().try_into_vec().expect("f32 sums");
    sums.into_iter().map(f64::from).sum::<f64>().sqrt()
}

/// The gradients times `factor`.
pub fn scaled<M: Module>(module: &M, gradients: GradientsParams, factor: f64) -> GradientsParams {
    struct Scale {
        from: GradientsParams,
        to: GradientsParams,
        factor: f64,
    }
    impl NamedVisitor for Scale {
        fn visit<const D: usize>(&mut self, _: &str, _: bool, parameter: &Param<Tensor<D>>) {
            if let Some(gradient) = self.from.remove::<D>(parameter.id) {
                self.to.register(parameter.id, gradient * self.factor);
            }
        }
    }
    let mut scale = Scale { from: gradients, to: GradientsParams::new(), factor };
    visit_named(module, "", &mut scale);
    scale.to
}

/// Limits the norm of all gradients together to `limit`, as PyTorch's `clip_grad_norm_`; `norm` is what [`norm`] gave. `None`
/// where it is not finite: no step can be made of such gradients.
pub fn clipped<M: Module>(
    module: &M,
    gradients: GradientsParams,
    norm: f64,
    limit: f64,
) -> Option<GradientsParams> {
    /// PyTorch's guard against a division by 0.
    const EPSILON: f64 = 1e-6;
    let factor = limit / (norm + EPSILON);
    let limited = |gradients| if factor < 1.0 { scaled(module, gradients, factor) } else { gradients };
    norm.is_finite().then(|| limited(gradients))
}
