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
pub fn orthogonalised(matrix: Vec<f32>, [rows, columns]: [usize; 2]) -> Vec<f32> {
    assert_eq!(matrix.len(), rows * columns);
    // Products of the shorter side are cheaper; a tall matrix is read as its transpose.
    let is_tall = rows > columns;
    let (m, n) = if is_tall { (columns, rows) } else { (rows, columns) };
    // (column, row) strides of the m×n matrix as it is stored.
    let strides = if is_tall { [m, 1] } else { [1, n] };
    let norm = matrix.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt() as f32;
    let scale = norm.max(MIN_NORM).recip();
    let mut x: Vec<f32> = matrix.iter().map(|v| v * scale).collect();
    let [mut gram, mut square] = [(); 2].map(|()| vec![0.0; m * m]);
    let mut next = vec![0.0; m * n];
    let [a, b, c] = COEFFICIENTS;
    for _ in 0..STEPS {
        // x·xᵀ, and b·G + c·G².
        let transposed = [strides[1], strides[0]];
        Multiply { size: [m, m, n], lhs: (&x, strides), rhs: &Right::Plain((&x, transposed)), add: false }
            .write(&mut gram, m);
        Multiply { size: [m, m, m], lhs: (&gram, [1, m]), rhs: &Right::Plain((&gram, [1, m])), add: false }
            .write(&mut square, m);
        square.iter_mut().zip(&gram).for_each(|(s, g)| *s = b * g + c * *s);
        if is_tall {
            // The transpose of (square · x), since square is symmetric: xᵀ · square, row by row as it is stored.
            Multiply {
                size: [n, m, m],
                lhs: (&x, [1, m]),
                rhs: &Right::Plain((&square, [1, m])),
                add: false,
            }
            .write(&mut next, m);
        } else {
            Multiply {
                size: [m, n, m],
                lhs: (&square, [1, m]),
                rhs: &Right::Plain((&x, [1, n])),
                add: false,
            }
            .write(&mut next, n);
        }
        x.iter_mut().zip(&next).for_each(|(x, next)| *x = a * *x + next);
    }
    x
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
