//! `--dump`: every intermediate tensor, with the names and shapes of the `pipeline` fixture.

use std::path::Path;

use burn::tensor::Tensor;
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use snapsnap_net::Reconstruction;
use snapsnap_ops::host;

use crate::failure::Failure;
use crate::output;

/// Writes `points conf valid side_images means opacity scale rotation rgb`, in the front camera's frame.
pub fn write(result: &Reconstruction, path: &Path) -> Result<(), Failure> {
    let [views, height, width, _] = result.points.maps.dims();
    let g = &result.gaussians;
    let float = Dtype::F32;
    let valid = result.valid.iter().flatten().map(|v| u8::from(*v)).collect();
    let mut tensors = vec![
        ("points", float, vec![views, height, width, 3], of_values(&result.points.host)),
        ("conf", float, vec![views, height, width], of_values(&result.points.conf)),
        ("valid", Dtype::U8, vec![views, height, width], valid),
        ("means", float, g.means.dims().to_vec(), bytes(&g.means)),
        ("opacity", float, vec![g.len(), 1], bytes(&g.opacities)),
        ("scale", float, g.scales.dims().to_vec(), bytes(&g.scales)),
        ("rotation", float, g.rotations.dims().to_vec(), bytes(&g.rotations)),
        ("rgb", float, g.colors.dims().to_vec(), bytes(&g.colors)),
    ];
    if !result.side_images.is_empty() {
        let values = result.side_images.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        tensors.push(("side_images", float, vec![result.side_images.len(), 3, height, width], values));
    }
    let views = tensors.iter().map(|(name, dtype, shape, bytes)| {
        (name, TensorView::new(*dtype, shape.clone(), bytes).expect("the size of the shape"))
    });
    let file = safetensors::serialize(views, None).expect("valid tensors");
    output::write(path, &file)
}

fn bytes<const D: usize>(tensor: &Tensor<D>) -> Vec<u8> {
    of_values(&host(tensor.clone()))
}

fn of_values(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}
