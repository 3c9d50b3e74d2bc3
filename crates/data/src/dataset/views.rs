//! Reading of stored views: pictures, masks, depths and cameras.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use image::{DynamicImage, GrayImage, RgbImage};
use snapsnap_base::FileError;
use snapsnap_splat::{Camera, RigidTransform, cameras};

use super::{Folder, Layout, Split, Stored, files};
use snapsnap_mesh::picture::{MAX_BYTES, decode_bytes};

/// One stored view.
#[derive(Debug, Clone)]
pub struct StoredView {
    /// `[H,W]` colours, undefined where the mask is 0.
    pub color: RgbImage,
    /// `[H,W]` coverage.
    pub mask: GrayImage,
    /// `[H,W]` metres along the optical axis; 0 for the background.
    pub depth: Vec<f32>,
    /// The stored camera, in the pixel coordinates of [`super::Description::pixel_centre`].
    pub camera: Camera,
}

impl Folder {
    /// Reads one view.
    ///
    /// # Errors
    /// [`FileError`] for a file that is missing, damaged or of another size than the data set's.
    pub fn view(&self, split: Option<Split>, subject: &str, view: usize) -> Result<StoredView, FileError> {
        let (color, mask) = self.picture(split, subject, view, false)?;
        Ok(StoredView { color, mask, ..self.depth(split, subject, view)? })
    }

    /// Reads one view without its picture. Colours and mask are empty.
    ///
    /// # Errors
    /// As [`Self::view`].
    pub fn depth(&self, split: Option<Split>, subject: &str, view: usize) -> Result<StoredView, FileError> {
        let camera = self.camera(split, subject, view)?;
        let depth = self.depth_map(split, subject, view)?;
        Ok(StoredView { color: RgbImage::default(), mask: GrayImage::default(), depth, camera })
    }

    /// Reads the depth of the second surface that faces the camera: `[H,W]` metres, 0 without one.
    ///
    /// # Errors
    /// As [`Self::view`]. Without [`super::Description::second_depth`] the files are missing.
    pub fn second_depth(
        &self,
        split: Option<Split>,
        subject: &str,
        view: usize,
    ) -> Result<Vec<f32>, FileError> {
        self.map_of("depth2", split, subject, view)
    }

    pub(super) fn depth_map(
        &self,
        split: Option<Split>,
        subject: &str,
        view: usize,
    ) -> Result<Vec<f32>, FileError> {
        self.map_of("depth", split, subject, view)
    }

    fn map_of(
        &self,
        kind: &str,
        split: Option<Split>,
        subject: &str,
        view: usize,
    ) -> Result<Vec<f32>, FileError> {
        let path = self.path(split, kind, subject).join(self.file_name(kind, view));
        let read = match self.description.layout {
            Layout::Authors => files::read_inverse_depth,
            Layout::Exact => files::read_depth,
        };
        let stored = self.stored(&path)?;
        let (depth, [height, width]) = read(&stored)?;
        self.check_size(&stored.path, (width, height), self.description.resolution)?;
        if let Some(z) = depth.iter().find(|z| !z.is_finite() || **z < 0.0) {
            return Err(FileError::unsuitable(&stored.path, format!("holds a depth of {z}")));
        }
        Ok(depth)
    }

    /// Reads the picture of a view, at twice the side if `high_resolution`: colours and coverage.
    ///
    /// # Errors
    /// As [`Self::view`].
    pub fn picture(
        &self,
        split: Option<Split>,
        subject: &str,
        view: usize,
        high_resolution: bool,
    ) -> Result<(RgbImage, GrayImage), FileError> {
        let picture = self.file(split, subject, view, high_resolution)?;
        if self.description.layout == Layout::Exact {
            return Ok(split_alpha(picture));
        }
        let mask = self.mask(split, subject, view)?;
        let (width, height) = (picture.width(), picture.height());
        let mask = if high_resolution {
            image::imageops::resize(&mask, width, height, image::imageops::FilterType::Nearest)
        } else {
            mask
        };
        Ok((picture.into_rgb8(), mask))
    }

    /// Path of a view's picture.
    pub fn picture_path(&self, split: Option<Split>, subject: &str, view: usize) -> PathBuf {
        self.picture_named(split, subject, view)
    }

    fn picture_named(&self, split: Option<Split>, subject: &str, view: impl Display) -> PathBuf {
        self.path(split, "img", subject).join(self.file_name("img", view))
    }

    /// The picture file of a view. In the exact layout it contains the mask as well.
    pub(super) fn file(
        &self,
        split: Option<Split>,
        subject: &str,
        view: usize,
        high_resolution: bool,
    ) -> Result<DynamicImage, FileError> {
        let (suffix, times) = if high_resolution { ("_hr", 2) } else { ("", 1) };
        let path = self.picture_named(split, subject, format_args!("{view}{suffix}"));
        let Stored { path, bytes } = self.stored(&path)?;
        let picture = decode_bytes(&path, &bytes, MAX_BYTES)?;
        self.check_size(&path, (picture.width(), picture.height()), times * self.description.resolution)?;
        Ok(picture)
    }

    /// The mask file of a view in the authors' layout.
    pub(super) fn mask(
        &self,
        split: Option<Split>,
        subject: &str,
        view: usize,
    ) -> Result<GrayImage, FileError> {
        let path = self.path(split, "mask", subject).join(self.file_name("mask", view));
        let Stored { path, bytes } = self.stored(&path)?;
        let mask = decode_bytes(&path, &bytes, MAX_BYTES)?.into_luma8();
        self.check_size(&path, mask.dimensions(), self.description.resolution)?;
        Ok(mask)
    }

    /// Reads the camera of a view, in the pixel coordinates of [`super::Description::pixel_centre`].
    ///
    /// # Errors
    /// As [`Self::view`].
    pub fn camera(&self, split: Option<Split>, subject: &str, view: usize) -> Result<Camera, FileError> {
        let side = self.description.resolution;
        match self.description.layout {
            Layout::Authors => {
                let folder = self.path(split, "parm", subject);
                let matrix = |name: &str| self.stored(&folder.join(format!("{view}_{name}.npy")));
                let intrinsic = matrix("intrinsic")?;
                let camera = files::read_camera(&intrinsic, &matrix("extrinsic")?, side)?;
                camera.check().map_err(|problem| FileError::unsuitable(&intrinsic.path, problem))?;
                Ok(camera)
            }
            Layout::Exact => {
                let Stored { path, bytes } = self.stored(&self.path(split, "cameras", subject))?;
                let text = std::str::from_utf8(&bytes)
                    .map_err(|_| FileError::unsuitable(&path, "is no text (UTF-8)"))?;
                let cameras = cameras::parse(&path, text)?;
                let views = self.description.views;
                if cameras.len() != views {
                    let message = format!("holds {} cameras, the data set has {views} views", cameras.len());
                    return Err(FileError::unsuitable(&path, message));
                }
                let camera = cameras.get(view).copied().ok_or_else(|| {
                    FileError::unsuitable(&path, format!("has no camera for view {view}, of {views}"))
                })?;
                self.check_size(&path, (camera.width, camera.height), side)?;
                Ok(camera)
            }
        }
    }

    /// A stored camera in coordinates in which the first pixel's sample is at (½, ½).
    pub fn exact_camera(&self, stored: &Camera) -> Camera {
        let shift = DVec2::splat(0.5 - self.description.pixel_centre);
        Camera { principal_point: stored.principal_point + shift, ..*stored }
    }

    fn check_size(&self, path: &Path, found: (u32, u32), side: u32) -> Result<(), FileError> {
        if found == (side, side) {
            return Ok(());
        }
        let message = format!("is {}×{}, the data set has views of {side}×{side}", found.0, found.1);
        Err(FileError::unsuitable(path, message))
    }
}

/// Points `[H,W,3]` of a depth map `[H,W]` in the frame `to` (from the world), in metres. A pixel's ray passes through
/// its centre, at +½ in the coordinates of `camera`. The background has the depth `far`.
pub(crate) fn unproject(depth: &[f32], camera: &Camera, to: &RigidTransform, far: f32) -> Vec<f32> {
    let width = camera.width as usize;
    let there = camera.world_to_camera.inverse().then(to);
    let (f, c) = (camera.focal, camera.principal_point);
    let mut points = Vec::with_capacity(3 * depth.len());
    for (pixel, z) in depth.iter().enumerate() {
        let z = f64::from(if *z > 0.0 { *z } else { far });
        let (x, y) = ((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let point = there.apply(z * DVec3::new((x - c.x) / f.x, (y - c.y) / f.y, 1.0));
        points.extend(point.as_vec3().to_array());
    }
    points
}

/// Colours and coverage of a picture with alpha.
pub(super) fn split_alpha(picture: DynamicImage) -> (RgbImage, GrayImage) {
    let rgba = picture.into_rgba8();
    let mask =
        GrayImage::from_fn(rgba.width(), rgba.height(), |x, y| image::Luma([rgba.get_pixel(x, y).0[3]]));
    (DynamicImage::ImageRgba8(rgba).into_rgb8(), mask)
}
