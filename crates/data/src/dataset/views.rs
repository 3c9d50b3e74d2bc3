//! Reading of a person's stored views: pictures, masks, depths and cameras.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use image::{DynamicImage, GrayImage, RgbImage};
use snapsnap_base::FileError;
use snapsnap_splat::{Camera, RigidTransform, camera_file};

use super::{Folder, Layout, Split, files};
use snapsnap_mesh::picture::{MAX_BYTES, decode_bytes};

/// A person of a data set.
#[derive(Debug, Clone, Copy)]
pub struct Person<'a> {
    folder: &'a Folder,
    split: Option<Split>,
    /// Name in the data set.
    pub name: &'a str,
}

/// Depth of a view.
#[derive(Debug, Clone)]
pub struct DepthMap {
    /// `[H,W]` metres along the optical axis; 0 for the background.
    pub depth: Vec<f32>,
    /// The view's camera.
    pub camera: Camera,
}

impl Folder {
    /// The person `name` of a split, whose files are read later.
    pub fn person<'a>(&'a self, split: Option<Split>, name: &'a str) -> Person<'a> {
        Person { folder: self, split, name }
    }

    /// A stored camera in coordinates in which the first pixel's sample is at (½, ½).
    pub fn exact_camera(&self, stored: &Camera) -> Camera {
        let shift = DVec2::splat(0.5 - self.description.pixel_centre);
        Camera { principal_point: stored.principal_point + shift, ..*stored }
    }
}

impl Person<'_> {
    /// The folder with the person's files of one kind, or the file of the cameras.
    pub(super) fn path(&self, kind: &str) -> PathBuf {
        let name = if kind == "cameras" { format!("{}.json", self.name) } else { self.name.to_owned() };
        self.folder.split_path(self.split).join(kind).join(name)
    }

    /// Reads the depth and the camera of a view. The camera is the stored one, in the pixel coordinates of
    /// [`super::Description::pixel_centre`].
    ///
    /// # Errors
    /// [`FileError`] for a file that is missing, damaged or of another size than the data set's.
    pub fn depth(&self, view: usize) -> Result<DepthMap, FileError> {
        Ok(DepthMap { camera: self.camera(view)?, depth: self.depths("depth", view)? })
    }

    /// Depths `[H,W]` of a view, in metres: `depth`, or `depth2` of the second surface that faces the camera. They are 0
    /// without a surface.
    pub(crate) fn depths(&self, kind: &str, view: usize) -> Result<Vec<f32>, FileError> {
        let path = self.path(kind).join(self.folder.file_name(kind, view));
        let read = match self.folder.description.layout {
            Layout::Authors => files::read_inverse_depth,
            Layout::Exact => files::read_depth,
        };
        let (depth, [height, width]) = read(&path, &self.folder.bytes(&path)?)?;
        self.check_size(&path, (width, height), 1)?;
        if let Some(z) = depth.iter().find(|z| !z.is_finite() || **z < 0.0) {
            return Err(FileError::unsuitable(&path, format!("holds a depth of {z}")));
        }
        Ok(depth)
    }

    /// Reads the picture of a view, at twice the side if `high_resolution`: colours `[H,W]`, which are undefined where
    /// the mask is 0, and coverage `[H,W]`.
    ///
    /// # Errors
    /// As [`Self::depth`].
    pub fn picture(&self, view: usize, high_resolution: bool) -> Result<(RgbImage, GrayImage), FileError> {
        let picture = self.file(view, high_resolution)?;
        if self.folder.description.layout == Layout::Exact {
            return Ok(split_alpha(picture));
        }
        let mask = self.mask(view)?;
        let (width, height) = (picture.width(), picture.height());
        let mask = if high_resolution {
            image::imageops::resize(&mask, width, height, image::imageops::FilterType::Nearest)
        } else {
            mask
        };
        Ok((picture.into_rgb8(), mask))
    }

    /// Path of a view's picture.
    pub fn picture_path(&self, view: impl Display) -> PathBuf {
        self.path("img").join(self.folder.file_name("img", view))
    }

    /// The picture file of a view. In the exact layout it contains the mask as well.
    pub(super) fn file(&self, view: usize, high_resolution: bool) -> Result<DynamicImage, FileError> {
        let (suffix, times) = if high_resolution { ("_hr", 2) } else { ("", 1) };
        let path = self.picture_path(format_args!("{view}{suffix}"));
        let picture = decode_bytes(&path, &self.folder.bytes(&path)?, MAX_BYTES)?;
        self.check_size(&path, (picture.width(), picture.height()), times)?;
        Ok(picture)
    }

    /// The mask file of a view in the authors' layout.
    pub(super) fn mask(&self, view: usize) -> Result<GrayImage, FileError> {
        let path = self.path("mask").join(self.folder.file_name("mask", view));
        let mask = decode_bytes(&path, &self.folder.bytes(&path)?, MAX_BYTES)?.into_luma8();
        self.check_size(&path, mask.dimensions(), 1)?;
        Ok(mask)
    }

    /// Reads the camera of a view, in the pixel coordinates of [`super::Description::pixel_centre`].
    ///
    /// # Errors
    /// As [`Self::depth`].
    pub fn camera(&self, view: usize) -> Result<Camera, FileError> {
        let folder = self.folder;
        match folder.description.layout {
            Layout::Authors => {
                let (path, side) = (self.path("parm"), folder.description.resolution);
                let camera = files::read_camera(&path, view, side, |path| folder.bytes(path))?;
                let path = path.join(format!("{view}_intrinsic.npy"));
                camera.check().map_err(|problem| FileError::unsuitable(&path, problem))?;
                Ok(camera)
            }
            Layout::Exact => {
                let path = self.path("cameras");
                let bytes = folder.bytes(&path)?;
                let text = std::str::from_utf8(&bytes)
                    .map_err(|_| FileError::unsuitable(&path, "is no text (UTF-8)"))?;
                let cameras = camera_file::parse(&path, text)?;
                let views = folder.description.views;
                if cameras.len() != views {
                    let message = format!("holds {} cameras, the data set has {views} views", cameras.len());
                    return Err(FileError::unsuitable(&path, message));
                }
                let camera = cameras.get(view).copied().ok_or_else(|| {
                    FileError::unsuitable(&path, format!("has no camera for view {view}, of {views}"))
                })?;
                self.check_size(&path, (camera.width, camera.height), 1)?;
                Ok(camera)
            }
        }
    }

    /// Refuses a file that has not `times` the side of the views.
    fn check_size(&self, path: &Path, found: (u32, u32), times: u32) -> Result<(), FileError> {
        let side = times * self.folder.description.resolution;
        if found == (side, side) {
            return Ok(());
        }
        let message = format!("is {}×{}, the data set has views of {side}×{side}", found.0, found.1);
        Err(FileError::unsuitable(path, message))
    }
}

impl DepthMap {
    /// The point at `place` (pixels), in metres in the camera's frame, with the depth of the pixel there.
    pub(crate) fn point(&self, place: DVec2) -> Option<DVec3> {
        let side = self.camera.width as usize;
        let (column, row) = (place.x.floor(), place.y.floor());
        if column < 0.0 || row < 0.0 || column as usize >= side || row as usize >= side {
            return None;
        }
        let z = self.depth[row as usize * side + column as usize];
        let ray = (place - self.camera.principal_point) / self.camera.focal;
        (z > 0.0).then(|| f64::from(z) * ray.extend(1.0))
    }

    /// Points of the pixels, row by row, in metres in the frame `to` (from the world); `None` for the background. A
    /// pixel's ray passes through its centre, at +½ in the coordinates of the camera.
    pub(crate) fn points(&self, to: &RigidTransform) -> impl Iterator<Item = Option<DVec3>> {
        let there = self.camera.world_to_camera.inverse().then(to);
        centres(self.camera.width).map(move |place| self.point(place).map(|point| there.apply(point)))
    }
}

/// Centres of a square picture's pixels, row by row.
pub(crate) fn centres(side: u32) -> impl Iterator<Item = DVec2> {
    (0..side).flat_map(move |row| (0..side).map(move |column| DVec2::new(column.into(), row.into()) + 0.5))
}

/// Colours and coverage of a picture with alpha.
pub(super) fn split_alpha(picture: DynamicImage) -> (RgbImage, GrayImage) {
    let rgba = picture.into_rgba8();
    let mask =
        GrayImage::from_fn(rgba.width(), rgba.height(), |x, y| image::Luma([rgba.get_pixel(x, y).0[3]]));
    (DynamicImage::ImageRgba8(rgba).into_rgb8(), mask)
}
