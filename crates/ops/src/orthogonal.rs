//! Newton-Schulz orthogonalisation of matrices for the optimiser Muon (Jordan et al., "Muon").

use crate::multiply::{self, Right};

/// Coefficients of x, x³ and x⁵ in a step, by Muon's authors. They bring singular values to between 0.7 and 1.2.
const COEFFICIENTS: [f32; 3] = [3.4445, -4.775, 2.0315];
/// Number of steps.
const STEPS: usize = 5;
/// Norms below this value are replaced by it.
const MIN_NORM: f32 = 1e-7;
/// Smaller values become 0. Beside a norm of 1 they are below f32's rounding. Products of a few of these values are
/// subnormal numbers, which processors multiply several times slower. Gradients of low rank have many of them.
const NEGLIGIBLE: f32 = 1e-10;

/// Brings the singular values of a matrix `[rows, columns]` close to 1 by Newton-Schulz steps. Runs on one thread:
/// matrices are many and small.
///
/// A step multiplies X by Q = a + b·G + c·G², with G = X·Xᵀ. All Q are polynomials of the first G. So they commute,
/// and the next G is Q·Q·G. Only the first and the last product then have X's longer side. That saves more than half of
/// the work if one side is nine times the other. For equal sides it costs a third more.
pub fn orthogonalised(matrix: Vec<f32>, [rows, columns]: [usize; 2]) -> Vec<f32> {
    assert_eq!(matrix.len(), rows * columns);
    // For a tall matrix X is the transpose, because its G is smaller.
    let is_tall = rows > columns;
    let (m, n) = if is_tall { (columns, rows) } else { (rows, columns) };
    // (column, row) strides of the m×n matrix as it is stored.
    let strides = if is_tall { [m, 1] } else { [1, n] };
    let norm = matrix.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt() as f32;
    let scale = norm.max(MIN_NORM).recip();
    let x: Vec<f32> = matrix.iter().map(|v| flushed(v * scale)).collect();
    let [mut gram, mut correction, mut next, mut all] = [(); 4].map(|()| vec![0.0; m * m]);
    let [a, b, c] = COEFFICIENTS;
    let product = |lhs: &[f32], rhs: &[f32], out: &mut [f32]| {
        multiply::product([m, m, m], (lhs, [1, m]), &Right::Plain((rhs, [1, m])), out, false);
    };
    let transposed = Right::Plain((&x, [strides[1], strides[0]]));
    multiply::product([m, m, n], (&x, strides), &transposed, &mut gram, false);
    gram.iter_mut().for_each(|value| *value = flushed(*value));
    // `all` is the product of all Q. It begins as the identity.
    all.iter_mut().step_by(m + 1).for_each(|diagonal| *diagonal = 1.0);
    for step in 1..=STEPS {
        product(&gram, &gram, &mut correction);
        correction.iter_mut().zip(&gram).for_each(|(s, g)| *s = flushed(b * g + c * *s));
        for (matrix, times) in [(&mut all, 1), (&mut gram, if step < STEPS { 2 } else { 0 })] {
            for _ in 0..times {
                product(&correction, matrix, &mut next);
                matrix.iter_mut().zip(&next).for_each(|(value, next)| *value = flushed(a * *value + next));
            }
        }
    }
    let mut out = vec![0.0; m * n];
    if is_tall {
        // The transpose of (all · x), since `all` is symmetric: xᵀ · all, row by row as it is stored.
        multiply::product([n, m, m], (&x, [1, m]), &Right::Plain((&all, [1, m])), &mut out, false);
    } else {
        multiply::product([m, n, m], (&all, [1, m]), &Right::Plain((&x, [1, n])), &mut out, false);
    }
    out
}

/// 0 if the value is below [`NEGLIGIBLE`], else the value.
fn flushed(value: f32) -> f32 {
    if value.abs() < NEGLIGIBLE { 0.0 } else { value }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, FloatDType, Tensor, TensorData};

    use super::*;
    use crate::testing::{relative_error, uniform, values, wide};

    #[test]
    fn zeros_stay_zeros() {
        assert_eq!(orthogonalised(vec![0.0; 6], [2, 3]), [0.0; 6]);
    }

    /// Rows whose sizes fall from 1 to 1e-7 or 1e-12, as in gradients of low rank, against the same steps in f64.
    #[test]
    fn matrices_of_few_directions_go_the_same_way() {
        for [rows, columns] in [[24, 60], [60, 24], [40, 40]] {
            let noise = uniform(rows * columns, 1);
            let matrix: Vec<f32> =
                noise.iter().enumerate().map(|(i, x)| x * 0.5_f32.powi((i / columns) as i32)).collect();
            let norm = matrix.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
            let data = TensorData::new(matrix.clone(), [rows, columns]);
            let mut x = Tensor::<2>::from_data(data, &Device::flex()).cast(FloatDType::F64) / norm;
            let [a, b, c] = COEFFICIENTS.map(f64::from);
            for _ in 0..STEPS {
                let gram = x.clone().matmul(x.clone().transpose());
                let correction = gram.clone() * b + gram.clone().matmul(gram) * c;
                x = x.clone() * a + correction.matmul(x);
            }
            let error = relative_error(&wide(&orthogonalised(matrix, [rows, columns])), &values(x));
            println!("{rows}x{columns}: {error:e}");
            assert!(error < 2e-3, "{rows}x{columns}: {error:e}");
        }
    }
}
