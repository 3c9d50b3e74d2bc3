//! Photographs become people.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use image::{GrayImage, RgbImage};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::PyByteArray;
use serde_json::json;
use snapsnap::{CameraArguments, Failure, ModelArguments, check_memory};
use snapsnap_mesh::picture;
use snapsnap_net::Reconstructor;
use snapsnap_photo::{Content, Cutting, Source};

use crate::arrays::{Made, bytes, numbers};
use crate::work::{run, unsuitable};

/// Loaded networks on a device.
#[pyclass(frozen)]
pub struct Networks(Arc<Mutex<Reconstructor>>);

#[pymethods]
impl Networks {
    #[new]
    #[pyo3(signature = (weights, device))]
    fn new(py: Python<'_>, weights: Option<PathBuf>, device: String) -> PyResult<Self> {
        let networks = run(py, move |_| {
            let model = ModelArguments::new(weights, &device);
            let weights = model.open()?;
            let device = model.device_for_one(&weights)?;
            Ok(model.load(&weights, &device)?.0)
        })?;
        Ok(Self(Arc::new(Mutex::new(networks))))
    }
}

/// Pixels: red, green and blue, width, height, and a mask if there is one.
type Pixels = (PyBackedBytes, u32, u32, Option<PyBackedBytes>);

/// A photograph: its name or path, its pixels if they are in memory, and the file of its mask.
type Photograph = (PathBuf, Option<Pixels>, Option<PathBuf>);

/// Colours and mask of a photograph without its background: width, height, RGB, mask.
type Cutout<'py> = (u32, u32, Bound<'py, PyByteArray>, Bound<'py, PyByteArray>);

/// Pictures of pixels in memory.
type Pictures = (RgbImage, Option<GrayImage>);

fn pictures(name: &Path, (rgb, width, height, mask): &Pixels) -> Result<Pictures, Failure> {
    let wrong = || Failure::file(name, "has another number of pixels than it says");
    let mask = mask.as_ref().map(|mask| {
        GrayImage::from_raw(*width, *height, mask.to_vec()).ok_or_else(|| {
            Failure::file(name, format!("the mask has not the photograph's size, {width}×{height}"))
        })
    });
    Ok((RgbImage::from_raw(*width, *height, rgb.to_vec()).ok_or_else(wrong)?, mask.transpose()?))
}

/// Makes a person of a front and a back photograph. Returns the Gaussians, a report as JSON, and the photographs without
/// their backgrounds.
#[pyfunction]
#[pyo3(signature = (networks, photographs, *, cutout, strict, height, focal, distance, elevation))]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
pub fn reconstruct<'py>(
    py: Python<'py>,
    networks: &Networks,
    photographs: [Photograph; 2],
    cutout: &str,
    strict: bool,
    height: Option<f64>,
    focal: Option<f64>,
    distance: Option<f64>,
    elevation: Option<f64>,
) -> PyResult<(Made<'py>, String, [Cutout<'py>; 2])> {
    let cutting = Cutting::named(cutout);
    let camera = CameraArguments { height, focal, distance, elevation };
    let networks = Arc::clone(&networks.0);
    let (arrays, report, cutouts) = run(py, move |check| {
        let cutting = cutting.ok_or_else(|| unsuitable("cutout", "must be auto, network or none"))?;
        let networks = networks.lock().unwrap_or_else(PoisonError::into_inner);
        let config = networks.config();
        let told = camera.told(config, false)?;
        let mut decoded = Vec::new();
        for (path, pixels, _) in &photographs {
            let size = match pixels {
                Some((_, width, height, _)) => [*width, *height],
                None => picture::size(path, None)?,
            };
            check_memory(path, size)?;
            decoded.push(pixels.as_ref().map(|pixels| pictures(path, pixels)).transpose()?);
        }
        let sources = [0, 1].map(|i| {
            let (path, _, mask) = &photographs[i];
            let content = match &decoded[i] {
                Some((rgb, mask)) => Content::Pixels(rgb, mask.as_ref()),
                None => Content::File,
            };
            Source { content, mask: mask.as_deref(), ..Source::file(path) }
        });
        let side = config.network.resolution;
        let mut read = snapsnap_photo::read(&sources, cutting, side, told.placement(config), told.focal)?;
        let doubts: Vec<String> = read.doubts.iter().map(ToString::to_string).collect();
        if strict && !doubts.is_empty() {
            return Err(Failure::Input(doubts.join("; ")));
        }
        check();
        let person = snapsnap_photo::person(&read, &networks, &told, &|_| check())?;
        let made = &person.made;
        let time = |(name, time): &(&str, std::time::Duration)| (name.to_string(), json!(time.as_secs_f64()));
        let report = json!({
            "doubts": doubts,
            "photographs": read.reports,
            "cameras": person.seats,
            "steps": made.steps,
            "seconds": made.times.iter().map(time).collect::<serde_json::Map<_, _>>(),
        });
        Ok((numbers(&person.gaussians), report.to_string(), std::mem::take(&mut read.cutouts)))
    })?;
    let picture = |(rgb, mask): &(RgbImage, GrayImage)| {
        (rgb.width(), rgb.height(), PyByteArray::new(py, rgb.as_raw()), PyByteArray::new(py, mask.as_raw()))
    };
    let cutouts = [picture(&cutouts[0]), picture(&cutouts[1])];
    Ok((arrays.map(|values| bytes(py, &values)), report, cutouts))
}
