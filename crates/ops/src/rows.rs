#![allow(deprecated, reason = "NdArray is the CPU test backend")]

//! Rows of a table with another gradient, for GPUs. Burn's own adds up the rows' gradients in one thread per column. Here
//! each row is taken once at most, so that its gradient is a copy.

use std::sync::Arc;

use burn::backend::autodiff::Autodiff;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, ExtensionType, Flex, NdArray, TensorMetadata, backend_extension};
use burn::tensor::{Device, Int, Shape, Tensor, TensorData};
use burn_cubecl::CubeBackend;

use crate::gpu::is_tracked_on_gpu;

/// A table `[N, C]`, or rows of it.
#[derive(ExtensionType, Clone, Debug)]
pub struct Table<B: Backend> {
    values: FloatTensor<B>,
}

/// Backends with the operation.
#[backend_extension(Cube, Flex, NdArray, Autodiff)]
pub trait RowsBackend: Backend {
    /// The table's `rows` `[M, C]`.
    fn take(#[extension_type] table: Table<Self>, rows: Arc<[i32]>) -> Table<Self>;
}

macro_rules! untracked {
    ($($backend:ty),+) => {
        $(impl RowsBackend for $backend {
            fn take(table: Table<Self>, rows: Arc<[i32]>) -> Table<Self> {
                Table { values: select::<Self>(table.values, &rows) }
            }
        })+
    };
}

untracked!(CubeBackend, Flex, NdArray);

fn select<B: Backend>(table: FloatTensor<B>, rows: &[i32]) -> FloatTensor<B> {
    let device = table.device();
    let rows: IntTensor<B> = B::int_from_data(TensorData::new(rows.to_vec(), [rows.len()]), &device);
    B::float_select(table, 0, rows)
}

#[derive(Debug)]
struct RowsBackward;

impl<B: Backend> Backward<B, 1> for RowsBackward {
    /// The rows, and the table's shape.
    type State = (Arc<[i32]>, Shape);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let upstream = grads.consume::<B>(&ops.node);
        let ([Some(parent)], (rows, shape)) = (ops.parents, ops.state) else { return };
        let [count, columns] = shape.dims();
        // Rows that are not taken get a row of zeros behind the others.
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
    fn take(Table { values }: Table<Self>, rows: Arc<[i32]>) -> Table<Self> {
        let shape = values.shape();
        let values = match RowsBackward.prepare::<C>([values.node()]).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => {
                let taken = select::<B>(values.into_primitive(), &rows);
                prepared.finish((rows, shape), taken)
            }
            OpsKind::UnTracked(prepared) => prepared.finish(select::<B>(values.into_primitive(), &rows)),
        };
        Table { values }
    }
}

/// The `rows` `[M, C]` of a table `[N, C]`. A row may be taken more than once only if it is constant: on GPUs its gradient is
/// that of the last one.
pub fn taken(table: Tensor<2>, rows: &[i32]) -> Tensor<2> {
    if is_tracked_on_gpu(&table) {
        return taken_once(table, rows);
    }
    table.clone().select(0, indices(rows, &table.device()))
}

fn taken_once(table: Tensor<2>, rows: &[i32]) -> Tensor<2> {
    let table = Table { values: table.into_dispatch() };
    Tensor::from_dispatch(<Dispatch as RowsBackend>::take(table, rows.into()).values)
}

fn indices(rows: &[i32], device: &Device) -> Tensor<1, Int> {
    Tensor::from_data(TensorData::new(rows.to_vec(), [rows.len()]), device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host;
    use crate::tests::uniform;

    /// Row 5 is constant and taken three times; rows 1 and 4 are not taken.
    #[test]
    fn gradients_of_rows_equal_burns() {
        let rows = [3, 5, 0, 5, 2, 5];
        let device = Device::flex().autodiff();
        let tensor = |shape: [usize; 2], seed| {
            let data = TensorData::new(uniform(shape.iter().product(), seed), shape);
            Tensor::<2>::from_data(data, &device)
        };
        let (upstream, constant) = (tensor([6, 3], 2), tensor([1, 3], 3));
        let results = [taken_once, |table: Tensor<2>, rows: &[i32]| {
            table.clone().select(0, indices(rows, &table.device()))
        }]
        .map(|take| {
            let table = tensor([5, 3], 1).require_grad();
            let out = take(Tensor::cat(vec![table.clone(), constant.clone()], 0), &rows);
            let gradients = (out.clone() * upstream.clone()).sum().backward();
            [host(out), host(table.grad(&gradients).expect("tracked"))]
        });
        assert_eq!(results[0], results[1]);
        assert!(results[0][1].iter().any(|value| *value != 0.0));
    }
}
