//! Test sets: some photographs of a subject, and all of its views as ground truth.

use std::sync::Arc;

use image::{GrayImage, RgbImage};
use snapsnap_splat::Camera;

use super::{Augment, Handling, SampleConfig, Source};
use crate::dataset::{Folder, Split, unproject};
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
    /// [`FileError`] if the split has no subject, or the config contradicts itself.
    pub fn new(folder: Arc<Folder>, split: Option<Split>, config: SampleConfig) -> Result<Self, FileError> {
        let config = SampleConfig { repeat: 1, high_resolution: false, augment: Augment::none(), ..config };
        Source::new(folder, split, config, 1).map(Self)
    }

    /// Number of subjects.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether the set is empty. It never is.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Name of a subject.
    pub fn name(&self, index: usize) -> &str {
        &self.0.subjects[index]
    }

    /// One subject with the photographs of some of its views, changed by `handling`.
    ///
    /// # Errors
    /// [`FileError`] for files that are missing or damaged.
    pub fn sample(&self, index: usize, views: &[usize], handling: &Handling) -> Result<TestItem, FileError> {
        let source = &self.0;
        let subject = self.name(index);
        let description = source.folder.description();
        let photograph = |(place, view): (usize, &usize)| {
            let (color, mask) = source.folder.picture(source.split, subject, *view, false)?;
            Ok(handling.apply(place, color, mask))
        };
        let photographs = views.iter().enumerate().map(photograph).collect::<Result<Vec<_>, FileError>>()?;
        let camera = |view: usize| source.folder.camera(source.split, subject, view);
        let cameras = (0..description.views).map(|view| camera(view).map(|stored| source.camera(&stored)));
        Ok(TestItem {
            subject: subject.to_owned(),
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
        self.0.target(self.name(index), view, false, background)
    }

    /// Points of some views of a subject, `[V,H,W,3]` in metres in the first view's frame, and their validity
    /// `[V,H,W]`, 0 or 1.
    ///
    /// # Errors
    /// As [`Self::sample`].
    pub fn points(&self, index: usize, views: &[usize]) -> Result<(Vec<f32>, Vec<f32>), FileError> {
        let source = &self.0;
        let (mut points, mut valid, mut front) = (Vec::new(), Vec::new(), None);
        for view in views {
            let stored = source.folder.depth(source.split, self.name(index), *view)?;
            let camera = source.camera(&stored.camera);
            let front = front.get_or_insert(camera.world_to_camera);
            points.extend(unproject(&stored.depth, &camera, front, 0.0));
            valid.extend(stored.depth.iter().map(|z| f32::from(u8::from(*z > 0.0))));
        }
        Ok((points, valid))
    }
}
