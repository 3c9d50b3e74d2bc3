//! Plain loops compiled for the widest vectors of the processor.

use pulp::{Arch, Simd, WithSimd};

/// Runs loops, a closure without arguments, with all vector instructions of this processor.
macro_rules! vectorized {
    ($($loops:tt)+) => {
        $crate::vectors::run(
            #[inline(always)]
            $($loops)+,
        )
    };
}
pub(crate) use vectorized;

/// Runs `loops`, a closure with `#[inline(always)]`, in a function with all vector instructions of this processor.
/// pulp inlines the trait's method into that function. It would call a closure through `FnOnce`'s shim, which the
/// compiler may keep apart, for the baseline's instructions.
pub fn run<R>(loops: impl FnMut() -> R) -> R {
    struct Loops<F>(F);
    impl<R, F: FnMut() -> R> WithSimd for Loops<F> {
        type Output = R;
        #[inline(always)]
        fn with_simd<S: Simd>(mut self, _: S) -> R {
            (self.0)()
        }
    }
    Arch::new().dispatch(Loops(loops))
}
