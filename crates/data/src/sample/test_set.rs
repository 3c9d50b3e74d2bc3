//! The test: two opposite photographs of a subject, and every view around it to compare.

use std::sync::Arc;

use burn::data::dataset::{Dataset, DatasetError};
use snapsnap_splat::Camera;

use super::{Augment, SampleConfig, Source};
use crate::dataset::{Folder, Split};
use snapsnap_mesh::FileError;

/// Subjects of a test set (SNAPSNAP §5.6): the first view and the opposite one go in, 0 and 15 of the published 30; all
/// are compared. Each subject comes once, and nothing about it is random.
#[derive(Debug, Clone)]
pub struct Test(Source);

/// One subject; H and W are the side of the data set's views.
#[derive(Debug, Clone)]
pub struct TestItem {
    /// Its name.
    pub subject: String,
    /// H and W.
    pub side: usize,
    /// `[2,3,H,W]` front and back in [−1, 1] times the mask.
    pub images: Vec<f32>,
    /// `[2,H,W]` 1 where the input masks see the person.
    pub masks: Vec<f32>,
    /// Cameras of all views; those of front and back are the first and the middle one.
    pub cameras: Vec<Camera>,
}

impl Test {
    /// The subjects of a split; `None` where they lie in the root itself, as in the authors' test sets.
    ///
    /// # Errors
    /// [`FileError`] if the split has no subject, the number of views is odd, or the config contradicts itself.
    pub fn new(folder: Arc<Folder>, split: Option<Split>, config: SampleConfig) -> Result<Self, FileError> {
        let config = SampleConfig { repeat: 1, high_resolution: false, augment: Augment::none(), ..config };
        Source::new(folder, split, config, 2).map(Self)
    }

    /// One subject.
    ///
    /// # Errors
    /// [`FileError`] for files that are missing or damaged.
    pub fn sample(&self, index: usize) -> Result<TestItem, FileError> {
        let source = &self.0;
        let (subject, mut random) = source.subject(3, index);
        let description = source.folder.description();
        let picture = |view: usize| source.folder.picture(source.split, subject, view, false);
        let (front, back) = (picture(0)?, picture(description.views / 2)?);
        let (images, masks) = source.photographs([(&front.0, &front.1), (&back.0, &back.1)], &mut random);
        let camera = |view: usize| source.folder.camera(source.split, subject, view);
        let cameras = (0..description.views).map(|view| camera(view).map(|stored| source.camera(&stored)));
        Ok(TestItem {
            subject: subject.to_owned(),
            side: description.resolution as usize,
            images,
            masks,
            cameras: cameras.collect::<Result<_, _>>()?,
        })
    }

    /// `[3,H,W]` in [0, 1]: what a view of the subject `index` sees, over `background`. One at a time, for thirty take
    /// four hundred megabytes.
    ///
    /// # Errors
    /// As [`Self::sample`].
    pub fn target(&self, index: usize, view: usize, background: [f32; 3]) -> Result<Vec<f32>, FileError> {
        Ok(self.0.target(self.0.subject(3, index).0, view, false, background)?.0)
    }
}

impl Dataset<TestItem> for Test {
    fn get(&self, index: usize) -> Result<TestItem, DatasetError> {
        assert!(index < self.len(), "sample {index} of {}", self.len());
        self.sample(index).map_err(DatasetError::new)
    }

    fn len(&self) -> usize {
        self.0.len()
    }
}
