//! Test sets: some photographs of a subject, and all of its views as ground truth.

use std::sync::Arc;

use image::{GrayImage, RgbImage};
use snapsnap_splat::Camera;

use super::four_views::{Points, add};
use super::{Augment, PhotographChanges, SampleConfig, Source};
use crate::dataset::{DepthMap, Folder, Person, Split};
use snapsnap_base::FileError;

/// Subjects of a test set. The caller chooses the input views. The published test takes the first and the opposite one,
/// 0 and 15 of 30 (docs/method.md, "Samples"). No sample is random.
#[derive(Debug, Clone)]
pub struct Test(Source);

/// One subject; H and W are the side of the data set's views.
#[derive(Debug, Clone)]
pub struct TestItem {
    /// Name of the subject.
    pub subject: String,
    /// H and W.
    pub side: usize,
    /// Input photographs and the person's share of their pixels.
    pub photographs: Vec<(RgbImage, GrayImage)>,
    /// Cameras of all views.
    pub cameras: Vec<Camera>,
}

impl Test {
    /// The subjects of a split; `None` is the root itself, as in the authors' test sets.
    ///
    /// # Errors
    /// [`FileError`] if the split has no subject.
    pub fn new(folder: Arc<Folder>, split: Option<Split>) -> Result<Self, FileError> {
        let config = SampleConfig { augment: Augment::none(), ..SampleConfig::default() };
        Source::new(folder, split, config, 1).map(Self)
    }

    /// Number of subjects.
    pub fn count(&self) -> usize {
        self.0.subjects.len()
    }

    /// Name of a subject.
    pub fn name(&self, index: usize) -> &str {
        &self.0.subjects[index]
    }

    fn person(&self, index: usize) -> Person<'_> {
        self.0.folder.person(self.0.split, self.name(index))
    }

    /// One subject with the photographs of some of its views, changed by `changes`.
    ///
    /// # Errors
    /// [`FileError`] for files that are missing or damaged.
    pub fn sample(
        &self,
        index: usize,
        views: &[usize],
        changes: &PhotographChanges,
    ) -> Result<TestItem, FileError> {
        let person = self.person(index);
        let description = self.0.folder.description();
        let photograph = |(place, view): (usize, &usize)| {
            let (color, mask) = person.picture(*view, false)?;
            Ok(changes.apply(person.name, place, color, mask))
        };
        let photographs = views.iter().enumerate().map(photograph).collect::<Result<Vec<_>, FileError>>()?;
        let camera = |view: usize| person.camera(view).map(|stored| self.0.camera(&stored));
        let cameras = (0..description.views).map(camera);
        Ok(TestItem {
            subject: person.name.to_owned(),
            side: description.resolution as usize,
            photographs,
            cameras: cameras.collect::<Result<_, _>>()?,
        })
    }

    /// Ground truth of a view: `[3,H,W]` in [0, 1] over `background`, and the share of the person `[H,W]`. Views are
    /// read one by one: thirty views of a subject would take 400 MB.
    ///
    /// # Errors
    /// As [`Self::sample`].
    pub fn target(
        &self,
        index: usize,
        view: usize,
        background: [f32; 3],
    ) -> Result<(Vec<f32>, Vec<f32>), FileError> {
        self.0.target(self.person(index), view, false, background)
    }

    /// Points of some views of a subject, `[V,H,W,3]` in metres in the first view's frame, and their validity
    /// `[V,H,W]`, 0 or 1.
    ///
    /// # Errors
    /// As [`Self::sample`].
    pub fn points(&self, index: usize, views: &[usize]) -> Result<(Vec<f32>, Vec<f32>), FileError> {
        let (mut points, mut front) = (Points::default(), None);
        for view in views {
            let stored = self.person(index).depth(*view)?;
            let map = DepthMap { camera: self.0.camera(&stored.camera), ..stored };
            add(&mut points, map.points(front.get_or_insert(map.camera.world_to_camera)));
        }
        Ok(points)
    }
}
