//! An approximation of the nearest matrix with orthonormal rows, as Muon uses it for directions (Jordan et al., "Muon").

use crate::multiply::{Matrix, Multiply, Right};

/// Coefficients of a step, of x, x³ and x⁵: those of Muon's authors, which bring singular values to between 0.7 and 1.2.
const COEFFICIENTS: [f32; 3] = [3.4445, -4.775, 2.0315];
/// How many steps there are.
const STEPS: usize = 5;
/// Smaller norms are taken for this.
const MIN_NORM: f32 = 1e-7;

/// A matrix `[rows, columns]` with its singular values brought close to 1 by Newton-Schulz steps. Where `half` and the processor can, products
/// are in bf16, as in Muon's own implementation. Matrices are many and small, so each is the work of one thread.
pub fn orthogonalised(matrix: Vec<f32>, [rows, columns]: [usize; 2], half: bool) -> Vec<f32> {
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
    // [m, k] · [k, n], row by row.
    let product = |[m, k, n]: [usize; 3], lhs: Matrix, rhs: Matrix, out: &mut [f32]| {
        let rhs = Right::new(half, [k, n], rhs);
        Multiply { size: [m, n, k], lhs, rhs: &rhs, add: false }.write(out, n);
    };
    for _ in 0..STEPS {
        // x·xᵀ, and b·G + c·G².
        let transposed = [strides[1], strides[0]];
        product([m, n, m], (&x, strides), (&x, transposed), &mut gram);
        product([m, m, m], (&gram, [1, m]), (&gram, [1, m]), &mut square);
        square.iter_mut().zip(&gram).for_each(|(s, g)| *s = b * g + c * *s);
        if is_tall {
            // The transpose of (square · x), since square is symmetric: xᵀ · square, row by row as it is stored.
            product([n, m, m], (&x, [1, m]), (&square, [1, m]), &mut next);
        } else {
            product([m, m, n], (&square, [1, m]), (&x, [1, n]), &mut next);
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
            let got = orthogonalised(matrix, size, false);
            for (i, got) in got.iter().enumerate() {
                let (row, column) = (i / size[1], i % size[1]);
                let expected = if row == column { expected[row] } else { 0.0 };
                assert!((got - expected).abs() < 1e-5, "{size:?} {row} {column}: {got}, {expected}");
            }
        }
        assert_eq!(orthogonalised(vec![0.0; 6], [2, 3], false), [0.0; 6]);
    }

    /// Products in bf16 have factors with eight bits, of which five steps make an error of some percent. It is far smaller than the band of singular
    /// values that the polynomial leaves.
    #[test]
    fn products_in_bf16_change_the_direction_little() {
        for size in [[48, 200], [200, 48], [64, 64]] {
            let matrix = crate::tests::uniform(size[0] * size[1], 1);
            let [whole, half] = [false, true].map(|half| orthogonalised(matrix.clone(), size, half));
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
            let cosine = dot(&whole, &half) / (dot(&whole, &whole) * dot(&half, &half)).sqrt();
            println!("{size:?}: cosine {cosine}");
            assert!(cosine > 0.999, "{size:?}: {cosine}");
            assert_eq!(whole == half, crate::half::unit().is_none());
        }
    }
}
