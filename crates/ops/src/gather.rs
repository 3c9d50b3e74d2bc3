//! A gather of a table's rows with a faster gradient, for GPUs. Burn scatters the rows' gradients with one thread per
//! column. Here each row is taken once at most, so the gradient is a gather, too.

use std::sync::Arc;

use burn::backend::autodiff::Autodiff;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{Int, Shape, Tensor, TensorData};

use crate::device::is_tracked_on_gpu;
use crate::op::One;

/// Backends with the operation.
#[cfg_attr(feature = "gpu", backend_extension(Cube, Flex, Autodiff))]
#[cfg_attr(not(feature = "gpu"), backend_extension(Flex, Autodiff))]
pub trait RowsBackend: Backend {
    /// The `rows` `[M, C]` of a table `[N, C]`.
    fn take(#[extension_type] table: One<Self>, rows: Arc<[i32]>) -> One<Self> {
        One { tensor: select::<Self>(table.tensor, &rows) }
    }
}

#[cfg(feature = "gpu")]
impl RowsBackend for burn_cubecl::CubeBackend {}
impl RowsBackend for Flex {}

fn select<B: Backend>(table: FloatTensor<B>, rows: &[i32]) -> FloatTensor<B> {
    let device = table.device();
    let rows: IntTensor<B> = B::int_from_data(TensorData::new(rows.to_vec(), [rows.len()]), &device);
    B::float_select(table, 0, rows)
}

#[derive(Debug)]
struct RowsBackward;

impl<B: Backend> Backward<B, 1> for RowsBackward {
    /// The taken rows, and the table's shape.
    type State = (Arc<[i32]>, Shape);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let upstream = grads.consume::<B>(&ops.node);
        let ([Some(parent)], (rows, shape)) = (ops.parents, ops.state) else { return };
        let [count, columns] = shape.dims();
        // Rows that are not taken get the last row, which is 0.
        let mut places = vec![rows.len() as i32; count];
        for (place, row) in rows.iter().enumerate() {
            places[*row as usize] = place as i32;
        }
        let zeros = B::float_zeros(Shape::new([1, columns]), &upstream.device(), upstream.dtype().into());
        let gradient = select::<B>(B::float_cat(vec![upstream, zeros], 0), &places);
        grads.register::<B>(parent.id, gradient);
    }
}

impl<B: RowsBackend, C: CheckpointStrategy> RowsBackend for Autodiff<B, C> {
    fn take(One { tensor }: One<Self>, rows: Arc<[i32]>) -> One<Self> {
        let (shape, node) = (tensor.shape(), tensor.node());
        let taken = select::<B>(tensor.into_primitive(), &rows);
        let tensor = match RowsBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => prepared.finish((rows, shape), taken),
            OpsKind::UnTracked(prepared) => prepared.finish(taken),
        };
        One { tensor }
    }
}

/// Stands for no row: [`taken`] returns zeros.
pub const NONE: i32 = -1;

/// The `rows` `[M, C]` of a table `[N, C]`; zeros for [`NONE`].
///
/// # Panics
/// If a row is taken twice: on GPUs only the last one would have a gradient.
pub fn taken(table: Tensor<2>, rows: &[i32]) -> Tensor<2> {
    let [n, columns] = table.dims();
    let mut is_taken = vec![false; n];
    for row in rows.iter().filter(|row| **row != NONE) {
        let before = std::mem::replace(&mut is_taken[*row as usize], true);
        assert!(!before, "row {row} is taken twice");
    }
    if !rows.contains(&NONE) {
        return selected(table, rows);
    }
    // The zeros are a last row without a gradient.
    let zeros = Tensor::zeros([1, columns], &table.device());
    let rows: Vec<i32> = rows.iter().map(|row| if *row == NONE { n as i32 } else { *row }).collect();
    selected(Tensor::cat(vec![table, zeros], 0), &rows)
}

fn selected(table: Tensor<2>, rows: &[i32]) -> Tensor<2> {
    if is_tracked_on_gpu(&table) {
        return taken_once(table, rows);
    }
    let device = table.device();
    table.select(0, Tensor::<1, Int>::from_data(TensorData::new(rows.to_vec(), [rows.len()]), &device))
}

fn taken_once(table: Tensor<2>, rows: &[i32]) -> Tensor<2> {
    let table = One { tensor: table.into_dispatch() };
    Tensor::from_dispatch(<Dispatch as RowsBackend>::take(table, rows.into()).tensor)
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, FloatDType};

    use super::*;
    use crate::host;
    use crate::testing::tensor;

    /// With rows that are not taken: 1 and 4.
    #[test]
    fn gradients_of_rows_equal_burns() {
        let rows = [3, NONE, 0, NONE, 2, NONE];
        let device = Device::flex().autodiff();
        let upstream = tensor([6, 3], 2, FloatDType::F32);
        let with_zeros =
            |table: &Tensor<2>| Tensor::cat(vec![table.clone(), Tensor::zeros([1, 3], &device)], 0);
        let numbers = rows.map(|row| if row == NONE { 5 } else { row });
        let results = [
            &(|table: &Tensor<2>| taken(table.clone(), &rows)) as &dyn Fn(&Tensor<2>) -> Tensor<2>,
            &|table| taken_once(with_zeros(table), &numbers),
        ]
        .map(|take| {
            let table = tensor([5, 3], 1, FloatDType::F32).require_grad();
            let out = take(&table);
            let gradients = (out.clone() * upstream.clone()).sum().backward();
            [host(out), host(table.grad(&gradients).expect("tracked"))]
        });
        assert_eq!(results[0], results[1]);
        assert!(results[0][1].iter().any(|value| *value != 0.0));
        assert_eq!(results[0][0][3..6], [0.0; 3]);
    }

    #[test]
    #[should_panic(expected = "row 2 is taken twice")]
    fn a_row_that_repeats_is_refused() {
        taken(Tensor::zeros([3, 1], &Device::flex()), &[2, 0, 2]);
    }
}
