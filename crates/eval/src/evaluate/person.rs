//! People of a test set: their photographs, ground-truth pictures and points on canvases of any size.

use std::path::Path;
use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};
use glam::DVec3;
use snapsnap_base::FileError;
use snapsnap_data::dataset::{Arrangement, Folder};
use snapsnap_data::sample::{PhotographChanges, Test, TestItem};
use snapsnap_net::Photograph;
use snapsnap_net::config::Downsample;
use snapsnap_net::resample::shrink;
use snapsnap_ops::{bilinear, host};
use snapsnap_photo::on_canvas;
use snapsnap_splat::Camera;

use super::config::{DataSection, ViewsSection};
use crate::geometry::double;
use crate::pictures::Picture;
use crate::{EvalError, Result};

/// The people of one data set.
pub struct People {
    /// The data set's people.
    pub test: Test,
    /// The data set.
    pub folder: Arc<Folder>,
    /// Rows of `test` that are evaluated.
    pub chosen: Vec<usize>,
}

impl People {
    /// Opens a data set.
    ///
    /// # Errors
    /// [`EvalError`] if the folder is no data set, or does not have the views of the config.
    pub fn open(path: &Path, data: &DataSection, views: &ViewsSection) -> Result<Self> {
        let folder = Arc::new(Folder::open(path)?);
        let wrong = |message: &str| EvalError::File(FileError::unsuitable(path, message));
        if let Some(split) = data.split.filter(|split| !folder.splits().contains(&Some(*split))) {
            return Err(wrong(&format!("has no split `{split}`: change `data.split`")));
        }
        let test = Test::new(folder.clone(), data.split)?;
        let description = folder.description();
        let count = description.views;
        if description.arrangement != Arrangement::Ring {
            return Err(wrong("is arranged in groups, for training: test people need a ring of views"));
        }
        if views.inputs.is_empty() && !count.is_multiple_of(2) {
            return Err(wrong(&format!("has {count} views, none opposite the first: set `views.inputs`")));
        }
        for (key, list) in [("inputs", &views.inputs), ("compared", &views.compared)] {
            if let Some(view) = list.iter().find(|view| **view >= count) {
                return Err(wrong(&format!("has no view {view}, of {count}, which `views.{key}` names")));
            }
        }
        let side = description.resolution as usize;
        if views.resolution > 0 && !side.is_multiple_of(views.resolution) {
            let message =
                format!("has views of {side}², no multiple of `views.resolution` = {}", views.resolution);
            return Err(wrong(&message));
        }
        let is_chosen =
            |i: &usize| data.only.is_empty() || data.only.iter().any(|name| name == test.name(*i));
        let most = if data.subjects == 0 { usize::MAX } else { data.subjects };
        let chosen = (0..test.count()).filter(is_chosen).take(most).collect();
        Ok(Self { test, folder, chosen })
    }

    /// Views of each person.
    pub fn views(&self) -> usize {
        self.folder.description().views
    }

    /// The input views.
    pub fn inputs(&self, views: &ViewsSection) -> Vec<usize> {
        if views.inputs.is_empty() { vec![0, self.views() / 2] } else { views.inputs.clone() }
    }

    /// Side of the compared pictures.
    pub fn side(&self, views: &ViewsSection) -> usize {
        if views.resolution > 0 { views.resolution } else { self.folder.description().resolution as usize }
    }

    /// A person's photographs, with `changes`, masks and cameras.
    ///
    /// # Errors
    /// [`EvalError::File`], also for a camera that mirrors: no quaternion can express the mirrored Gaussians.
    pub fn item(&self, row: usize, inputs: &[usize], changes: &PhotographChanges) -> Result<TestItem> {
        let item = self.test.sample(row, inputs, changes)?;
        let mirrors = |camera: &Camera| camera.world_to_camera.rotation.determinant() < 0.0;
        if let Some(view) = item.cameras.iter().position(mirrors) {
            let name = self.test.name(row);
            let message = format!("{name}: the camera of view {view} is a reflection, no rotation");
            return Err(EvalError::File(FileError::unsuitable(self.folder.root(), message)));
        }
        Ok(item)
    }

    /// The ground-truth picture of a view over black, and the person's share of each pixel `[S, S]`.
    ///
    /// # Errors
    /// [`EvalError::File`].
    pub fn target(&self, row: usize, view: usize, side: usize) -> Result<(Picture, Vec<f32>)> {
        let (values, mask) = self.test.target(row, view, [0.0; 3])?;
        let stored = self.folder.description().resolution as usize;
        let values = smaller(values, 3, stored, side);
        let picture = Picture::new(values, [side, side], "true picture")?;
        Ok((picture, smaller(mask, 1, stored, side)))
    }
}

/// The largest divisor of a side up to `most`.
pub fn part_of(side: usize, most: usize) -> usize {
    (1..=side).find(|f| side.is_multiple_of(*f) && side / f <= most).map_or(side, |factor| side / factor)
}

/// Planes `[C, S, S]`, shrunk with area means from side `from` to its divisor `to`.
pub fn smaller(values: Vec<f32>, channels: usize, from: usize, to: usize) -> Vec<f32> {
    if from == to {
        return values;
    }
    // By rounding, means of values in [0, 1] can exceed 1.
    host(shrink(planes(values, channels, from), from / to, Downsample::Area).clamp(0.0, 1.0))
}

/// Planes `[1, C, S, S]` on the CPU.
pub fn planes(values: Vec<f32>, channels: usize, side: usize) -> Tensor<4> {
    Tensor::from_data(TensorData::new(values, [1, channels, side, side]), &Device::flex())
}

/// An input photograph, which is stored as a canvas, resized to a canvas of `side` pixels: with area means if `side`
/// divides the stored side, else with bilinear interpolation.
pub fn photograph(item: &TestItem, place: usize, side: usize) -> Photograph {
    let (from, (rgb, mask)) = (item.side, &item.photographs[place]);
    let photograph = on_canvas(rgb, mask);
    if from == side {
        return photograph;
    }
    let sized = |values: Vec<f32>, channels: usize| {
        let planes = planes(values, channels, from);
        host(match from.is_multiple_of(side) {
            true => shrink(planes, from / side, Downsample::Area),
            false => bilinear(planes, [side, side], false),
        })
    };
    Photograph::new(sized(photograph.rgb, 3), sized(photograph.mask, 1))
}

/// Points `[V,S,S,3]`, and their mask `[V,S,S]`.
pub type Points = (Vec<f32>, Vec<f32>);

/// Ground-truth points of some views on a canvas of `side` pixels: `[V,S,S,3]` metres in the first view's frame, and
/// their mask `[V,S,S]`. A pixel of the canvas has the mean of its stored points, if at least half of its area has
/// points. `None` if `side` does not divide the stored side `from`.
///
/// # Errors
/// [`EvalError`] for a file of a view that cannot be read.
pub fn points(test: &Test, row: usize, views: &[usize], from: usize, side: usize) -> Result<Option<Points>> {
    if !from.is_multiple_of(side) {
        return Ok(None);
    }
    let (points, valid) = test.points(row, views)?;
    if from == side {
        return Ok(Some((points, valid)));
    }
    let area = from * from;
    let views = points.chunks_exact(3 * area).zip(valid.chunks_exact(area));
    let (points, valid): (Vec<_>, Vec<_>) = views.map(|(p, v)| means(p, v, from, side)).unzip();
    Ok(Some((points.concat(), valid.concat())))
}

/// One view's points and mask, shrunk from `stored`² to `side`² pixels as [`points`] does it.
pub(super) fn means(points: &[f32], valid: &[f32], stored: usize, side: usize) -> Points {
    let factor = stored / side;
    let mean = |cell: usize| {
        let corner = cell / side * factor * stored + cell % side * factor;
        let pixels = (0..factor).flat_map(|y| (0..factor).map(move |x| corner + y * stored + x));
        let there = pixels.filter(|i| valid[*i] > 0.5).map(|i| double(points.as_chunks().0[i]));
        let (sum, count) = there.fold((DVec3::ZERO, 0), |(sum, count), point| (sum + point, count + 1));
        let is_there = 2 * count >= factor * factor;
        if is_there { ((sum / count as f64).as_vec3().to_array(), 1.0) } else { ([0.0; 3], 0.0) }
    };
    let (means, shares): (Vec<[f32; 3]>, Vec<f32>) = (0..side * side).map(mean).unzip();
    (means.into_flattened(), shares)
}

/// The view whose camera is nearest to `wanted` degrees around the person from the view `first`.
pub fn nearest_view(cameras: &[Camera], first: usize, wanted: f64) -> usize {
    let off = |view: &usize| off(&cameras[*view], &cameras[first], wanted);
    (0..cameras.len()).min_by(|a, b| off(a).total_cmp(&off(b))).expect("there are views")
}

/// Angle between a camera and the direction `wanted` degrees around the person from `front`, 0° to 180°.
pub fn off(camera: &Camera, front: &Camera, wanted: f64) -> f64 {
    let apart = (degrees(camera, front) - wanted).rem_euclid(360.0);
    apart.min(360.0 - apart)
}

/// Azimuth of a camera around the world's y, degrees from the azimuth of `front`, 0 to 360.
pub fn degrees(camera: &Camera, front: &Camera) -> f64 {
    let azimuth = |camera: &Camera| {
        let centre = camera.centre();
        centre.x.atan2(centre.z).to_degrees()
    };
    (azimuth(camera) - azimuth(front)).rem_euclid(360.0)
}
