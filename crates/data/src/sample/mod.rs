//! Training samples: Burn data sets of both stages, batches, and a loader (docs/method.md, "Samples").

mod augment;
mod handling;
mod joined;
mod loader;
mod place;
mod stage1;
mod stage2;
mod test_set;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use image::{GrayImage, RgbImage};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use snapsnap_splat::Camera;

use crate::dataset::{Arrangement, Folder, Layout, Split, StoredView};
use crate::photo::{Canvas, Mapping, place};
pub use augment::Augment;
pub use handling::Handling;
pub use joined::Joined;
pub use loader::{Batches, Loader};
use snapsnap_base::FileError;
use snapsnap_base::random::stream;
pub use stage1::{Stage1, Stage1Batch, Stage1Batcher, Stage1Item};
pub use stage2::{Stage2, Stage2Item};
pub use test_set::{Test, TestItem};

/// Least coverage of a pixel of the person, in 8 bits.
const INSIDE: u8 = 128;

/// The section `[samples]` of a training config.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SampleConfig {
    /// Whether samples have every quirk of the published loader: points half a pixel off in sets that are sampled at
    /// the pixels' corners, a black background, and no augmentation.
    pub compat: bool,
    /// Samples of each subject in an epoch.
    pub repeat: usize,
    /// Largest angle, in degrees, between the front photograph and the subject's own front; 180: any view is a front.
    pub front_within_degrees: f32,
    /// Stage 2: number of random target views, beside the two side views.
    pub random_targets: usize,
    /// Stage 2: whether targets have twice the side. The data set must contain such views.
    pub high_resolution: bool,
    /// Stage 2: whether samples contain the points of four views for stage 1's loss: `stage2.points_weight`.
    #[serde(skip)]
    pub points: bool,
    /// Share of the samples whose photographs are placed on their canvas like a user's photographs. Their points are
    /// scaled and moved into the nominal cameras' views.
    pub placed_share: f32,
    /// Height of a placed person in pixels of a canvas of 1024: `mode.person_height`.
    #[serde(skip)]
    pub person_height: usize,
    /// Seed of everything that is random.
    pub seed: u64,
    /// Changes to the two input photographs.
    pub augment: Augment,
}

impl Default for SampleConfig {
    /// Samples of this program's trainings.
    fn default() -> Self {
        Self {
            compat: false,
            repeat: 50,
            front_within_degrees: 180.0,
            random_targets: 3,
            high_resolution: false,
            points: false,
            placed_share: 0.0,
            person_height: 739,
            seed: 1,
            augment: Augment::default(),
        }
    }
}

impl SampleConfig {
    /// Samples of the published loader.
    pub fn compat() -> Self {
        Self { compat: true, high_resolution: true, augment: Augment::none(), ..Self::default() }
    }

    /// The first key that makes no sense, and why.
    pub fn problem(&self) -> Option<(String, String)> {
        if self.repeat == 0 || self.repeat > 1_000_000 {
            return Some(("repeat".into(), format!("is {}, must be 1 to 1000000", self.repeat)));
        }
        if !(0.0..=180.0).contains(&self.front_within_degrees) {
            let message = format!("is {}, must be 0 to 180", self.front_within_degrees);
            return Some(("front_within_degrees".into(), message));
        }
        if self.compat && self.front_within_degrees != 180.0 {
            return Some(("front_within_degrees".into(), "must be 180 beside `compat = true`".into()));
        }
        if self.random_targets > 64 {
            return Some(("random_targets".into(), format!("is {}, must be 0 to 64", self.random_targets)));
        }
        if self.compat && self.augment != Augment::none() {
            return Some(("augment".into(), "must be off beside `compat = true`".into()));
        }
        if !(0.0..=1.0).contains(&self.placed_share) {
            return Some(("placed_share".into(), format!("is {}, must be 0 to 1", self.placed_share)));
        }
        if self.compat && self.placed_share > 0.0 {
            return Some(("placed_share".into(), "must be 0 beside `compat = true`".into()));
        }
        self.augment.problem().map(|(key, message)| (format!("augment.{key}"), message))
    }
}

/// A split of a data set and the config of its samples, for all stages.
#[derive(Debug, Clone)]
struct Source {
    folder: Arc<Folder>,
    split: Option<Split>,
    subjects: Arc<Vec<String>>,
    config: SampleConfig,
    epoch: u64,
}

impl Source {
    /// The number of views must be a multiple of `parts`.
    fn new(
        folder: Arc<Folder>,
        split: Option<Split>,
        config: SampleConfig,
        parts: usize,
    ) -> Result<Self, FileError> {
        let wrong = |message: String| FileError::unsuitable(folder.root(), message);
        if let Some((key, message)) = config.problem() {
            return Err(wrong(format!("samples: `{key}`: {message}")));
        }
        let views = folder.description().views;
        if !views.is_multiple_of(parts) {
            return Err(wrong(format!(
                "has {views} views; front, back and sides need a multiple of {parts}"
            )));
        }
        if config.compat && folder.description().arrangement != Arrangement::Ring {
            return Err(wrong("is arranged in groups, which `compat = true` does not support".into()));
        }
        if config.high_resolution && !folder.description().high_resolution {
            return Err(wrong("has no views at twice the side, which `high_resolution` needs".into()));
        }
        let subjects = folder.subjects(split)?;
        if subjects.is_empty() {
            return Err(wrong("has no subject in this split".into()));
        }
        Ok(Self { folder, split, subjects: Arc::new(subjects), config, epoch: 0 })
    }

    fn len(&self) -> usize {
        self.subjects.len() * self.config.repeat
    }

    /// The subject of a sample and its random stream. As in the published code, subjects take turns.
    fn subject(&self, stage: u32, index: usize) -> (&str, ChaCha8Rng) {
        let subject = &self.subjects[index % self.subjects.len()];
        let random = stream(&format!("sample/{stage}/{}/{}/{index}", self.config.seed, self.epoch));
        (subject, random)
    }

    /// A view for the front photograph, or the front of a random group.
    fn front(&self, random: &mut impl Rng) -> usize {
        let count = self.folder.description().views;
        if self.folder.description().arrangement == Arrangement::Groups {
            return 4 * random.random_range(0..count / 4);
        }
        // View 0 is the subject's own front. Views are evenly spaced.
        let reach = (f64::from(self.config.front_within_degrees) * count as f64 / 360.0 + 1e-6) as usize;
        if 2 * reach >= count {
            return random.random_range(0..count);
        }
        (count + random.random_range(0..=2 * reach) - reach) % count
    }

    /// A view, with its picture or without.
    fn view_for(&self, subject: &str, view: usize, picture: bool) -> Result<StoredView, FileError> {
        if picture {
            self.folder.view(self.split, subject, view)
        } else {
            self.folder.depth(self.split, subject, view)
        }
    }

    /// The camera that unprojects depths: the exact camera, or, with `compat`, the stored one as in the published code.
    fn camera(&self, stored: &Camera) -> Camera {
        if self.config.compat { *stored } else { self.folder.exact_camera(stored) }
    }

    /// A target view: `[3,h,w]` in [0, 1] over a colour, and the share of the person `[h,w]`.
    fn target(
        &self,
        subject: &str,
        view: usize,
        high_resolution: bool,
        background: [f32; 3],
    ) -> Result<(Vec<f32>, Vec<f32>), FileError> {
        let (color, mask) = self.folder.picture(self.split, subject, view, high_resolution)?;
        // The authors' pictures are over black already. Their masks have half the side of the larger pictures.
        let is_done = self.folder.description().layout == Layout::Authors && background == [0.0; 3];
        let value = |c: u8, a: u8, behind: f32| {
            let a = if is_done { 1.0 } else { f32::from(a) / 255.0 };
            a * f32::from(c) / 255.0 + (1.0 - a) * behind
        };
        let pixels = |channel: usize| {
            let pixels = color.pixels().zip(mask.pixels());
            pixels.map(move |(c, a)| value(c.0[channel], a.0[0], background[channel]))
        };
        let share = mask.as_raw().iter().map(|a| f32::from(*a) / 255.0).collect();
        Ok(((0..3).flat_map(pixels).collect(), share))
    }

    /// Photographs of front and back as the networks' input.
    fn photographs(
        &self,
        views: [(&RgbImage, &GrayImage); 2],
        is_placed: bool,
        random: &mut impl Rng,
    ) -> Vec<Photograph> {
        let changed = views.map(|(color, mask)| self.config.augment.apply(color, mask, random));
        let changed = [0, 1].map(|i| (&changed[i].0, &changed[i].1));
        Photograph::all(&changed, if is_placed { self.config.person_height } else { 0 }, self.config.compat)
    }

    /// Whether a sample's photographs are placed like a user's.
    fn is_placed(&self, random: &mut impl Rng) -> bool {
        // A share of 0 draws no random number, so that it leaves the others as they are.
        match self.config.placed_share {
            0.0 => false,
            share => random.random::<f32>() < share,
        }
    }
}

/// A photograph on its canvas.
struct Photograph {
    /// `[3,H,W]` in [−1, 1] times the mask.
    image: Vec<f32>,
    /// `[H,W]` share of the person. In the published code it is 1 or 0.
    mask: Vec<f32>,
    mapping: Mapping,
}

impl Photograph {
    /// Photographs of a person as the networks' input. They are placed on their canvas like a user's, with a person of
    /// `height` pixels of 1024. With 0 they are used unchanged.
    fn all(photographs: &[(&RgbImage, &GrayImage)], height: usize, compat: bool) -> Vec<Self> {
        let side = photographs.first().map_or(0, |(color, _)| color.width() as usize);
        let placed = (height > 0).then(|| place(photographs, height, side)).flatten();
        let mut photographs: Vec<Self> = match placed {
            Some(canvases) => canvases.into_iter().map(Self::of_canvas).collect(),
            None => photographs.iter().map(|(color, mask)| Self::unchanged(color, mask)).collect(),
        };
        if compat {
            let inside = |share: f32| f32::from(u8::from(share >= f32::from(INSIDE) / 255.0));
            let masks = photographs.iter_mut().map(|photograph| &mut photograph.mask);
            masks.flatten().for_each(|share| *share = inside(*share));
        }
        photographs
    }

    /// All images, and all masks.
    fn joined(photographs: Vec<Self>) -> (Vec<f32>, Vec<f32>) {
        let (images, masks): (Vec<_>, Vec<_>) =
            photographs.into_iter().map(|photograph| (photograph.image, photograph.mask)).unzip();
        (images.concat(), masks.concat())
    }

    fn of_canvas(canvas: Canvas) -> Self {
        Self { image: canvas.rgb, mask: canvas.mask, mapping: canvas.mapping }
    }

    fn unchanged(color: &RgbImage, mask: &GrayImage) -> Self {
        // Channels first; the background is 0.
        let channel = |channel: usize| {
            let pixels = color.pixels().zip(mask.pixels());
            pixels.map(move |(c, m)| {
                (2.0 * f32::from(c.0[channel]) / 255.0 - 1.0) * (f32::from(m.0[0]) / 255.0)
            })
        };
        Self {
            image: (0..3).flat_map(channel).collect(),
            mask: mask.as_raw().iter().map(|m| f32::from(*m) / 255.0).collect(),
            mapping: Mapping::AS_IT_IS,
        }
    }
}
