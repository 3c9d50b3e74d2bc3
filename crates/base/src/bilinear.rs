//! Weights of a bilinear resize along one axis.

/// One target position: lower source index, upper source index, weight of the upper sample.
pub type Tap = (usize, usize, f32);

/// Samples and weights of every target position when `from` samples become `to`.
///
/// With `align_corners`, the centres of the outermost pixels coincide; without, their outer edges do.
pub fn taps(from: usize, to: usize, align_corners: bool) -> Vec<Tap> {
    let position = |i: usize| match align_corners {
        true if to > 1 => i as f64 * (from - 1) as f64 / (to - 1) as f64,
        true => 0.0,
        false => ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64),
    };
    let tap = |at: f64| {
        let low = (at as usize).min(from - 1);
        (low, (low + 1).min(from - 1), (at - low as f64) as f32)
    };
    (0..to).map(position).map(tap).collect()
}
