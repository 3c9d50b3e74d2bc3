//! Allocation and launch sizes on one CubeCL device.

use burn::tensor::{DType, Shape};
use burn_cubecl::CubeDevice;
use burn_cubecl::ops::numeric::empty_device_contiguous_dtype;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use crate::SplatError;

/// A device to allocate on and launch to.
pub struct Buffers {
    pub client: Client,
    pub device: CubeDevice,
}

impl Buffers {
    /// On the device of `tensor`.
    pub fn of(tensor: &CubeTensor) -> Self {
        Self { client: tensor.client.clone(), device: tensor.device.clone() }
    }

    /// `n` uninitialised u32.
    pub fn u32(&self, n: usize) -> CubeTensor {
        self.empty([n], DType::U32)
    }

    /// `n` uninitialised f32.
    pub fn f32(&self, n: usize) -> CubeTensor {
        self.empty([n], DType::F32)
    }

    /// An uninitialised tensor. Under test it is filled with garbage, so that nothing relies on zeroed memory.
    pub fn empty<const D: usize>(&self, shape: [usize; D], dtype: DType) -> CubeTensor {
        // A binding of no bytes is not allowed.
        let shape = if shape.contains(&0) { Shape::new([1]) } else { Shape::new(shape) };
        let tensor = empty_device_contiguous_dtype(self.client.clone(), self.device.clone(), shape, dtype);
        #[cfg(test)]
        self.fill(&tensor, 0xFFC0_1234);
        tensor
    }

    /// `n` u32 zeros.
    pub fn zeros(&self, n: usize) -> CubeTensor {
        let tensor = self.u32(n);
        self.fill(&tensor, 0);
        tensor
    }

    /// Numbers of 32 bits from the host.
    pub fn upload(&self, bytes: &[u8], dtype: DType) -> CubeTensor {
        let handle = self.client.create_from_slice(bytes);
        let shape = Shape::new([bytes.len() / 4]);
        CubeTensor::new_contiguous(self.client.clone(), self.device.clone(), shape, handle, dtype)
    }

    /// At least `n` cubes, over two axes if one is too short. Kernels return where `CUBE_POS` is `n` or more.
    pub fn cubes(&self, n: usize) -> CubeCount {
        let most = self.client.properties().hardware.max_cube_count.0 as usize;
        let y = n.div_ceil(most).max(1);
        CubeCount::Static(n.div_ceil(y) as u32, y as u32, 1)
    }

    /// Whether an array of `n` numbers is allowed; kernels count in 32 bits.
    ///
    /// # Errors
    /// [`SplatError::Memory`].
    pub fn check(&self, what: &'static str, n: usize) -> Result<(), SplatError> {
        let bytes = (n as u64).saturating_mul(4);
        if bytes > self.largest() || n > u32::MAX as usize {
            Err(SplatError::Memory { what, bytes })
        } else {
            Ok(())
        }
    }

    /// Largest buffer in bytes.
    pub fn largest(&self) -> u64 {
        self.client.properties().memory.max_page_size
    }

    fn fill(&self, tensor: &CubeTensor, value: u32) {
        let n = tensor.meta.num_elements();
        fill::launch(&self.client, self.cubes(n.div_ceil(256)), CubeDim::new_1d(256), arg(tensor), n, value);
    }
}

/// The argument of a kernel for a buffer that is used again.
pub fn arg(tensor: &CubeTensor) -> BufferArg {
    tensor.clone().into_buffer_arg()
}

#[cube(launch)]
fn fill(out: &mut [u32], n: usize, value: u32) {
    if ABSOLUTE_POS < n {
        out[ABSOLUTE_POS] = value;
    }
}

#[cfg(test)]
pub mod testing {
    use burn::tensor::{Device, DeviceType};
    use burn_cubecl::ops::into_data_sync;

    use super::*;

    /// Runs `test` on the machine's wgpu adapter, or prints that there is none.
    pub fn with_buffers(test: impl FnOnce(&Buffers)) {
        let found = std::panic::catch_unwind(|| !Device::enumerate(DeviceType::Wgpu).into_vec().is_empty());
        if !found.unwrap_or(false) {
            assert!(
                std::env::var_os("SNAPSNAP_REQUIRE_WGPU").is_none(),
                "no wgpu adapter, but one is required"
            );
            println!("SKIPPED: no wgpu adapter on this machine");
            return;
        }
        let device = CubeDevice::from(burn::backend::wgpu::WgpuDevice::default());
        test(&Buffers { client: device.client(), device });
    }

    /// u32 numbers from the host, and one more: a buffer is not empty.
    pub fn upload(buffers: &Buffers, values: &[u32]) -> CubeTensor {
        buffers.upload(bytemuck::cast_slice(&[values, &[0]].concat()), DType::U32)
    }

    /// u32 numbers to the host.
    pub fn read(tensor: CubeTensor) -> Vec<u32> {
        into_data_sync(tensor).try_into_vec().expect("u32")
    }
}
