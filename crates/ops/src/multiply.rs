//! Matrix products by the gemm crate on one thread; what is shared out among threads is decided by its callers, by sizes
//! alone, so that every element is one sum in one order.

/// lhs `[m, k]` · rhs `[k, n]`.
pub struct Multiply<'a> {
    /// m, n, k.
    pub size: [usize; 3],
    /// Values, and their (column, row) strides in elements.
    pub lhs: (&'a [f32], [usize; 2]),
    /// The same of the right factor.
    pub rhs: (&'a [f32], [usize; 2]),
    /// Adds to the present values.
    pub add: bool,
}

impl Multiply<'_> {
    /// Writes the product's rows, which begin `stride` floats after one another.
    pub fn write(self, out: &mut [f32], stride: usize) {
        let Self { size: [m, n, k], lhs: (lhs, ls), rhs: (rhs, rs), add } = self;
        let last = |rows: usize, columns: usize, [column, row]: [usize; 2]| {
            (rows - 1) * row + (columns - 1) * column
        };
        assert!(m > 0 && n > 0 && k > 0 && stride >= n);
        assert!(
            last(m, k, ls) < lhs.len() && last(k, n, rs) < rhs.len() && last(m, n, [1, stride]) < out.len()
        );
        let s = |x: usize| x as isize;
        let keep = if add { 1.0 } else { 0.0 };
        // SAFETY: the assertions above bound every element that the strides reach; `out` is borrowed mutably.
        #[allow(unsafe_code, reason = "the matrix product of the gemm crate takes pointers")]
        unsafe {
            gemm::gemm(
                m,
                n,
                k,
                out.as_mut_ptr(),
                1,
                s(stride),
                add,
                lhs.as_ptr(),
                s(ls[0]),
                s(ls[1]),
                rhs.as_ptr(),
                s(rs[0]),
                s(rs[1]),
                keep,
                1.0,
                false,
                false,
                false,
                gemm::Parallelism::None,
            );
        }
    }
}
