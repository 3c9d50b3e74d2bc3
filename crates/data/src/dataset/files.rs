//! Single files of data sets.

use std::io::{Cursor, Read, Write};
use std::path::Path;

use glam::{DMat3, DVec2, DVec3};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageBuffer, ImageEncoder, Luma, RgbImage};
use ndarray::{Array2, ArrayView2};
use ndarray_npy::{ReadNpyExt, ReadableElement, WriteNpyExt};
use snapsnap_splat::{Camera, RigidTransform};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::MAX_RESOLUTION;
use snapsnap_base::FileError;
use snapsnap_mesh::picture::{MAX_BYTES, decode_bytes, unreadable};
use snapsnap_mesh::view::View;

/// Stored depths of the authors' layout are ⌊2¹⁵/z⌋ (docs/method.md, "Layouts").
const INVERSE_DEPTH_UNIT: f64 = 32_768.0;
/// Nearest depth in metres that the authors' layout can store.
pub const NEAREST: f32 = 0.5;
/// Quality of JPEGs in the authors' layout.
const JPEG_QUALITY: u8 = 95;
/// Name of the array in a depth file.
const DEPTH: &str = "depth";
/// Largest `.npy` that is read, in bytes: a depth map of the largest view.
const MAX_NPY: u64 = MAX_RESOLUTION as u64 * MAX_RESOLUTION as u64 * 4 + 4096;

fn write(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    // The file is in a subject's temporary folder, which is renamed when it is complete.
    std::fs::write(path, bytes).map_err(FileError::write(path))
}

fn write_png(
    path: &Path,
    bytes: &[u8],
    side: (usize, usize),
    kind: ExtendedColorType,
) -> Result<(), FileError> {
    let mut out = Vec::new();
    PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytes, side.0 as u32, side.1 as u32, kind)
        .map_err(unreadable(path))?;
    write(path, &out)
}

fn to_byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// The straight colour of a pixel. The colours of a view are premultiplied by coverage.
fn straight(view: &View, pixel: usize) -> [u8; 3] {
    let alpha = view.alpha[pixel];
    if alpha > 0.0 { view.color[pixel].map(|c| to_byte(c / alpha)) } else { [0; 3] }
}

/// Writes straight colours and coverage.
pub fn write_rgba(path: &Path, view: &View) -> Result<(), FileError> {
    let rgba = |pixel: usize| {
        let [r, g, b] = straight(view, pixel);
        [r, g, b, to_byte(view.alpha[pixel])]
    };
    let bytes: Vec<u8> = (0..view.alpha.len()).flat_map(rgba).collect();
    write_png(path, &bytes, (view.width, view.height), ExtendedColorType::Rgba8)
}

/// Writes straight colours of pixels with depth, and black for others.
pub fn write_jpeg(path: &Path, view: &View) -> Result<(), FileError> {
    let picture = RgbImage::from_fn(view.width as u32, view.height as u32, |x, y| {
        let pixel = y as usize * view.width + x as usize;
        image::Rgb(if view.depth[pixel] > 0.0 { straight(view, pixel) } else { [0; 3] })
    });
    let mut out = Vec::new();
    JpegEncoder::new_with_quality(&mut out, JPEG_QUALITY).encode_image(&picture).map_err(unreadable(path))?;
    write(path, &out)
}

/// Writes white in three channels for pixels with depth, and black for others.
pub fn write_mask(path: &Path, view: &View) -> Result<(), FileError> {
    let bytes: Vec<u8> = view.depth.iter().flat_map(|z| [if *z > 0.0 { 255 } else { 0 }; 3]).collect();
    write_png(path, &bytes, (view.width, view.height), ExtendedColorType::Rgb8)
}

/// Writes ⌊2¹⁵/z⌋ in 16 bits, 0 for the background.
pub fn write_inverse_depth(path: &Path, view: &View) -> Result<(), FileError> {
    // Depths below `NEAREST` would saturate. `write_subject` refuses them.
    let stored = |z: f32| if z > 0.0 { (INVERSE_DEPTH_UNIT / f64::from(z)).floor() as u16 } else { 0 };
    let bytes: Vec<u8> = view.depth.iter().flat_map(|z| stored(*z).to_ne_bytes()).collect();
    write_png(path, &bytes, (view.width, view.height), ExtendedColorType::L16)
}

/// The array in an `.npy`.
fn read_array<T: ReadableElement>(npy: &[u8]) -> Result<Array2<T>, String> {
    if !holds_its_shape(npy) {
        return Err("its header announces more numbers than it contains".into());
    }
    Array2::read_npy(npy).map_err(|e| e.to_string())
}

/// Whether an `.npy` is long enough for the shape in its header, at four bytes per number. Its reader allocates memory
/// before it checks this.
fn holds_its_shape(npy: &[u8]) -> bool {
    let length =
        |bytes: Option<&[u8]>| Some(bytes?.iter().rev().fold(0, |sum, b| sum << 8 | usize::from(*b)));
    let header = match npy.get(6) {
        Some(1) => length(npy.get(8..10)).and_then(|n| npy.get(10..10 + n)),
        _ => length(npy.get(8..12)).and_then(|n| npy.get(12..12 + n)),
    };
    let shape = header.and_then(|header| std::str::from_utf8(header).ok()).and_then(|text| {
        let (_, rest) = text.split_once("'shape':")?;
        let (_, rest) = rest.split_once('(')?;
        rest.split_once(')').map(|(shape, _)| shape)
    });
    let numbers = shape.and_then(|shape| {
        let mut sides = shape.split(',').map(str::trim).filter(|side| !side.is_empty());
        sides.try_fold(1_usize, |product, side| product.checked_mul(side.parse().ok()?))
    });
    numbers.is_some_and(|numbers| numbers <= npy.len() / 4)
}

/// Depths in metres and their shape.
type Depth = (Vec<f32>, [u32; 2]);

/// Reads a file of [`write_inverse_depth`].
pub fn read_inverse_depth(path: &Path, bytes: &[u8]) -> Result<Depth, FileError> {
    let picture = decode_bytes(path, bytes, MAX_BYTES)?;
    if picture.color() != image::ColorType::L16 {
        let message = format!("is {:?}, expected 16-bit grey: inverse depth", picture.color());
        return Err(FileError::unsuitable(path, message));
    }
    let stored: ImageBuffer<Luma<u16>, Vec<u16>> = picture.into_luma16();
    let shape = [stored.height(), stored.width()];
    let depth = |v: u16| if v > 0 { (INVERSE_DEPTH_UNIT / f64::from(v)) as f32 } else { 0.0 };
    Ok((stored.into_raw().into_iter().map(depth).collect(), shape))
}

/// Writes f32 metres, compressed without loss. NumPy's `load` reads the file.
pub fn write_depth(path: &Path, [height, width]: [usize; 2], depth: &[f32]) -> Result<(), FileError> {
    let array = ArrayView2::from_shape((height, width), depth).expect("one depth per pixel");
    let mut npy = Vec::new();
    array.write_npy(&mut npy).map_err(|e| FileError::unsuitable(path, e))?;
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .compression_level(Some(1));
    let packed = archive.start_file(format!("{DEPTH}.npy"), options).map_err(|e| e.to_string());
    let packed = packed.and_then(|()| archive.write_all(&npy).map_err(|e| e.to_string()));
    let packed = packed.and_then(|()| archive.finish().map_err(|e| e.to_string()));
    write(path, packed.map_err(|e| FileError::unsuitable(path, e))?.get_ref())
}

/// Reads a file of [`write_depth`].
pub fn read_depth(path: &Path, bytes: &[u8]) -> Result<Depth, FileError> {
    let wrong = |e: &dyn std::fmt::Display| FileError::unsuitable(path, format!("is no depth map: {e}"));
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| wrong(&e))?;
    let entry = archive.by_name(&format!("{DEPTH}.npy")).map_err(|e| wrong(&e))?;
    let mut npy = Vec::new();
    // An entry longer than the largest depth map is cut off here and refused below.
    entry.take(MAX_NPY).read_to_end(&mut npy).map_err(|e| wrong(&e))?;
    let array = read_array::<f32>(&npy).map_err(|e| wrong(&e))?;
    let (height, width) = array.dim();
    let array = array.as_standard_layout().into_owned();
    Ok((array.into_raw_vec_and_offset().0, [height as u32, width as u32]))
}

/// Writes the intrinsic 3×3 and the extrinsic 3×4 matrix (world → camera).
pub fn write_camera(folder: &Path, view: usize, camera: &Camera) -> Result<(), FileError> {
    let Camera { focal: f, principal_point: c, world_to_camera, .. } = *camera;
    let intrinsic = [[f.x, 0.0, c.x], [0.0, f.y, c.y], [0.0, 0.0, 1.0]];
    let RigidTransform { rotation, translation } = world_to_camera;
    let extrinsic = [0, 1, 2].map(|row| {
        let r = rotation.row(row);
        [r.x, r.y, r.z, translation[row]]
    });
    let save = |name: &str, matrix: Array2<f64>| {
        let path = folder.join(format!("{view}_{name}.npy"));
        let mut bytes = Vec::new();
        matrix.write_npy(&mut bytes).map_err(|e| FileError::unsuitable(&path, e))?;
        write(&path, &bytes)
    };
    save("intrinsic", ndarray::arr2(&intrinsic))?;
    save("extrinsic", ndarray::arr2(&extrinsic))
}

/// Reads the files of [`write_camera`] with `read`. The authors' tools store some matrices in f32.
pub fn read_camera(
    folder: &Path,
    view: usize,
    side: u32,
    read: impl Fn(&Path) -> Result<Vec<u8>, FileError>,
) -> Result<Camera, FileError> {
    let load = |name: &str, shape: (usize, usize)| {
        let path = &folder.join(format!("{view}_{name}.npy"));
        let bytes = &read(path)?;
        let matrix =
            read_array(bytes).or_else(|e| read_array::<f32>(bytes).map(|m| m.mapv(f64::from)).map_err(|_| e));
        let matrix = matrix.map_err(|e| FileError::unsuitable(path, format!("is no matrix: {e}")))?;
        if matrix.dim() != shape {
            let (rows, columns) = matrix.dim();
            let message = format!("is {rows}×{columns}, expected {}×{}", shape.0, shape.1);
            return Err(FileError::unsuitable(path, message));
        }
        if let Some(value) = matrix.iter().find(|v| !v.is_finite()) {
            return Err(FileError::unsuitable(path, format!("holds {value}")));
        }
        Ok(matrix)
    };
    let k = load("intrinsic", (3, 3))?;
    let e = load("extrinsic", (3, 4))?;
    let row = |row: usize| DVec3::new(e[[row, 0]], e[[row, 1]], e[[row, 2]]);
    let rotation = DMat3::from_cols(row(0), row(1), row(2)).transpose();
    let translation = DVec3::new(e[[0, 3]], e[[1, 3]], e[[2, 3]]);
    Ok(Camera {
        width: side,
        height: side,
        focal: DVec2::new(k[[0, 0]], k[[1, 1]]),
        principal_point: DVec2::new(k[[0, 2]], k[[1, 2]]),
        world_to_camera: RigidTransform { rotation, translation },
    })
}
