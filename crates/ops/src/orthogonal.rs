//! An approximation of the nearest matrix with orthonormal rows, as Muon uses it for directions (Jordan et al., "Muon").

use crate::multiply::{Multiply, Right};

/// Coefficients of a step, of x, x³ and x⁵: those of Muon's authors, which bring singular values to between 0.7 and 1.2.
const COEFFICIENTS: [f32; 3] = [3.4445, -4.775, 2.0315];
/// How many steps there are.
const STEPS: usize = 5;
/// Smaller norms are taken for this.
const MIN_NORM: f32 = 1e-7;

/// A matrix `[rows, columns]` with its singular values brought close to 1 by Newton-Schulz steps. On one thread: matrices
/// are many, and small.
///
/// A step multiplies X by Q = a + b·G + c·G², with G = X·Xᵀ. All Q are polynomials of the first G, so they commute, and the next G is
/// Q·Q·G. Hence only the first and the last product have X's longer side, and a side nine times the other costs less than half as much.
pub fn orthogonalised(matrix: Vec<f32>, [rows, columns]: [usize; 2]) -> Vec<f32> {
    assert_eq!(matrix.len(), rows * columns);
    // A tall matrix is read as its transpose, whose G is smaller.
    let is_tall = rows > columns;
    let (m, n) = if is_tall { (columns, rows) } else { (rows, columns) };
    // (column, row) strides of the m×n matrix as it is stored.
    let strides = if is_tall { [m, 1] } else { [1, n] };
    let norm = matrix.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt() as f32;
    let scale = norm.max(MIN_NORM).recip();
    let x: Vec<f32> = matrix.iter().map(|v| v * scale).collect();
    let [mut gram, mut correction, mut product, mut all] = [(); 4].map(|()| vec![0.0; m * m]);
    let [a, b, c] = COEFFICIENTS;
    let square = |lhs: &[f32], rhs: &[f32], out: &mut [f32]| {
        Multiply { size: [m, m, m], lhs: (lhs, [1, m]), rhs: &Right::Plain((rhs, [1, m])), add: false }
            .write(out, m);
    };
    let transposed = Right::Plain((&x, [strides[1], strides[0]]));
    Multiply { size: [m, m, n], lhs: (&x, strides), rhs: &transposed, add: false }.write(&mut gram, m);
    // The product of all Q begins with 1.
    all.iter_mut().step_by(m + 1).for_each(|diagonal| *diagonal = 1.0);
    for step in 1..=STEPS {
        square(&gram, &gram, &mut correction);
        correction.iter_mut().zip(&gram).for_each(|(s, g)| *s = b * g + c * *s);
        for (matrix, times) in [(&mut all, 1), (&mut gram, if step < STEPS { 2 } else { 0 })] {
            for _ in 0..times {
                square(&correction, matrix, &mut product);
                matrix.iter_mut().zip(&product).for_each(|(value, product)| *value = a * *value + product);
            }
        }
    }
    let mut out = vec![0.0; m * n];
    if is_tall {
        // The transpose of (all · x), since `all` is symmetric: xᵀ · all, row by row as it is stored.
        Multiply { size: [n, m, m], lhs: (&x, [1, m]), rhs: &Right::Plain((&all, [1, m])), add: false }
            .write(&mut out, m);
    } else {
        Multiply { size: [m, n, m], lhs: (&all, [1, m]), rhs: &Right::Plain((&x, [1, n])), add: false }
            .write(&mut out, n);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A diagonal matrix stays diagonal, and the polynomial maps each of its values.
    #[test]
    fn singular_values_go_the_polynomials_way() {
        let values = [3.0_f32, 1.0, 0.25];
        let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
        let expected = values.map(|v| {
            let [a, b, c] = COEFFICIENTS;
            (0..STEPS).fold(v / norm, |x, _| a * x + b * x.powi(3) + c * x.powi(5))
        });
        assert!(expected.iter().all(|v| (0.6..1.3).contains(v)), "{expected:?}");
        for size in [[3, 5], [5, 3], [3, 3]] {
            let mut matrix = vec![0.0; size[0] * size[1]];
            for (i, value) in values.iter().enumerate() {
                matrix[i * size[1] + i] = *value;
            }
            let got = orthogonalised(matrix, size);
            for (i, got) in got.iter().enumerate() {
                let (row, column) = (i / size[1], i % size[1]);
                let expected = if row == column { expected[row] } else { 0.0 };
                assert!((got - expected).abs() < 1e-5, "{size:?} {row} {column}: {got}, {expected}");
            }
        }
        assert_eq!(orthogonalised(vec![0.0; 6], [2, 3]), [0.0; 6]);
    }
}
