//! Training samples: Burn data sets of both stages, batches, and a loader (docs/method.md, "Samples").

mod augment;
mod four_views;
mod loader;
mod photograph_changes;
mod scene;
mod stages;
mod test_set;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use burn::data::dataset::{Dataset, DatasetError};
use image::{GrayImage, RgbImage};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use snapsnap_net::Photograph;
use snapsnap_net::config::OPPOSITE;
use snapsnap_photo::{Cutting, Photographs, Placement, Source as Picture};
use snapsnap_splat::Camera;

use crate::dataset::{Arrangement, Description, Folder, Layout, Person, Split};
pub use augment::Augment;
pub use loader::{Batches, Loader, share};
pub use photograph_changes::{PhotographChanges, Road};
use snapsnap_base::{FileError, config, random};
pub use stages::{Stage1, Stage1Batch, Stage1Item, Stage2, Stage2Item};
pub use test_set::{Test, TestItem};

/// Least mask value, of 255, at which a pixel counts as the person.
const INSIDE: u8 = 128;

/// The section `[samples]` of a training config.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SampleConfig {
    /// Whether samples have every quirk of the published loader: points half a pixel off in sets that are sampled at
    /// the pixels' corners, a black background, and no augmentation: `mode.compat`.
    #[serde(skip)]
    pub compat: bool,
    /// Samples of each subject in an epoch.
    #[serde(skip)]
    pub repeat: usize,
    /// Largest angle, in degrees, between the front photograph and the subject's own front; 180: any view is a front.
    pub front_within_degrees: f32,
    /// Stage 2: number of random target views, beside the two side views.
    pub random_targets: usize,
    /// Stage 2: whether targets have twice the side, as published. The data set must contain such views.
    #[serde(skip)]
    pub high_resolution: bool,
    /// Stage 2: whether samples contain the points of all views for stage 1's loss: `stage2.points_weight`.
    #[serde(skip)]
    pub points: bool,
    /// Stage 1: whether samples with sides contain the second surface that faces each side camera, such as the flank
    /// behind an arm: `network.second_layer`. The data set must contain it: `views.second_depth`.
    #[serde(skip)]
    pub second_depth: bool,
    /// Share of the samples whose photographs are placed on their canvas like a user's photographs. The points of these
    /// samples are scaled and moved into the nominal cameras' views. If the distance or focal length of rigs varies,
    /// any share above 0 places all photographs.
    pub placed_share: f32,
    /// Whether points are rectified to the points of an upright person (docs/method.md, "Upright targets"): no
    /// photograph shows its camera's elevation. In stage 2, people are restored to the photographs' cameras before they
    /// are rendered.
    pub upright: bool,
    /// Whether samples contain the points of right and left. Only networks with side heads need these points.
    #[serde(skip)]
    pub sides: bool,
    /// Height of a placed person in pixels of a canvas of 1024: `mode.person_height`.
    #[serde(skip)]
    pub person_height: usize,
    /// Degrees between the two photographs' cameras: `network.pair_degrees`.
    #[serde(skip)]
    pub pair_degrees: f64,
    /// Seed of everything that is random: `training.seed`.
    #[serde(skip)]
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
            second_depth: false,
            placed_share: 0.0,
            upright: false,
            sides: true,
            person_height: 739,
            pair_degrees: OPPOSITE,
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

    /// The first invalid key, and why it is invalid.
    pub fn problem(&self) -> Option<(String, String)> {
        let ranges = [
            ("front_within_degrees", self.front_within_degrees, 0.0..=180.0),
            ("random_targets", self.random_targets as f32, 0.0..=64.0),
            ("placed_share", self.placed_share, 0.0..=1.0),
        ];
        if let Some((key, message)) = config::outside(ranges) {
            return Some((key.into(), message));
        }
        if self.placed_share > 0.0 && !self.upright {
            let message = "needs `samples.upright = true`: a placed photograph shows no camera's elevation";
            return Some(("placed_share".into(), message.into()));
        }
        let wrong = [
            ("front_within_degrees", "must be 180", self.front_within_degrees != 180.0),
            ("augment", "must be off", self.augment != Augment::none()),
            ("placed_share", "must be 0", self.placed_share > 0.0),
            ("upright", "must be false", self.upright),
        ];
        // Photographs of neighbouring views keep their known cameras.
        for (is_set, rows, why) in [
            (self.compat, &wrong[..], "with `mode.compat = true`"),
            (self.pair_degrees != OPPOSITE, &wrong[2..], "unless `network.pair_degrees` is 180"),
        ] {
            if let Some((key, message, _)) = rows.iter().find(|(.., wrong)| is_set && *wrong) {
                return Some(((*key).into(), format!("{message} {why}")));
            }
        }
        self.augment.problem().map(|(key, message)| (format!("augment.{key}"), message))
    }
}

/// Samples of a training stage from a split of a data set.
#[derive(Debug, Clone)]
pub struct Stage<I> {
    source: Source,
    make: fn(&Source, usize) -> Result<I, FileError>,
}

impl<I> Stage<I> {
    /// The same subjects with the random choices of another epoch.
    pub fn with_epoch(&self, epoch: u64) -> Self {
        Self { source: Source { epoch, ..self.source.clone() }, make: self.make }
    }

    /// One sample.
    ///
    /// # Errors
    /// [`FileError`] for files that are missing or damaged.
    pub fn sample(&self, index: usize) -> Result<I, FileError> {
        (self.make)(&self.source, index)
    }
}

impl<I: Send + Sync> Dataset<I> for Stage<I> {
    fn get(&self, index: usize) -> Result<I, DatasetError> {
        assert!(index < self.len(), "sample {index} of {}", self.len());
        self.sample(index).map_err(DatasetError::new)
    }

    fn len(&self) -> usize {
        self.source.len()
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
            return Err(wrong("is arranged in groups, which `mode.compat = true` does not support".into()));
        }
        if config.high_resolution && !folder.description().high_resolution {
            return Err(wrong("has no views at twice the side, which `mode.compat = true` needs".into()));
        }
        if config.sides && config.second_depth && !folder.description().second_depth {
            return Err(wrong("has no second surfaces, which `network.second_layer` needs".into()));
        }
        if config.pair_degrees != OPPOSITE {
            let steps = steps_of(config.pair_degrees, views);
            if folder.description().arrangement != Arrangement::Ring || steps.fract() != 0.0 {
                let degrees = config.pair_degrees;
                return Err(wrong(format!(
                    "`network.pair_degrees` needs a ring of views with two that are {degrees}° apart"
                )));
            }
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

    /// The person of a sample and its random stream. As in the published code, people take turns.
    fn person(&self, stage: u32, index: usize) -> (Person<'_>, ChaCha8Rng) {
        let subject = &self.subjects[index % self.subjects.len()];
        let random = random::stream(&format!("sample/{stage}/{}/{}/{index}", self.config.seed, self.epoch));
        (self.folder.person(self.split, subject), random)
    }

    /// Draws the view of the front photograph. In groups, it is the front of a random group.
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

    /// Views of front, back, and the sides at +90° and +270°. Unless `pair_degrees` is 180, the back is a neighbour.
    fn order(&self, front: usize) -> [usize; 4] {
        let Description { arrangement, views, .. } = *self.folder.description();
        let mut order = arrangement.four(front, views);
        if self.config.pair_degrees != OPPOSITE {
            order[1] = (front + steps_of(self.config.pair_degrees, views) as usize) % views;
        }
        order
    }

    /// The camera that unprojects depths: the exact camera, or, with `compat`, the stored one as in the published code.
    fn camera(&self, stored: &Camera) -> Camera {
        if self.config.compat { *stored } else { self.folder.exact_camera(stored) }
    }

    /// A target view: `[3,h,w]` in [0, 1] over `background`, and the person's share of each pixel `[h,w]`.
    fn target(
        &self,
        person: Person<'_>,
        view: usize,
        high_resolution: bool,
        background: [f32; 3],
    ) -> Result<(Vec<f32>, Vec<f32>), FileError> {
        let (color, mask) = person.picture(view, high_resolution)?;
        // The authors' pictures already have a black background. Masks have half the side of their large pictures.
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

    /// Photographs of front and back as the networks' input: placed on their canvases like a user's, or used unchanged.
    fn photographs(
        &self,
        person: Person<'_>,
        views: [usize; 2],
        pictures: &[(RgbImage, GrayImage)],
        random: &mut impl Rng,
    ) -> Result<Photographs, FileError> {
        let height = self.config.person_height;
        let placement = if self.is_placed(random) { Placement::Training { height } } else { Placement::AsIs };
        let paths = views.map(|view| person.picture_path(view));
        let changed = [0, 1].map(|i| self.config.augment.apply(&pictures[i].0, &pictures[i].1, random));
        let source = |i: usize| Picture::pixels(&paths[i], &changed[i].0, Some(&changed[i].1));
        let sources = [source(0), source(1)];
        let side = changed[0].0.width() as usize;
        let mut made = snapsnap_photo::read(&sources, Cutting::Given, side, placement, None)?;
        if self.config.compat {
            for photograph in &mut made.canvases {
                let inside = |share: &f32| f32::from(u8::from(*share >= f32::from(INSIDE) / 255.0));
                let mask = photograph.mask.iter().map(inside).collect();
                *photograph = Photograph::new(std::mem::take(&mut photograph.rgb), mask);
            }
        }
        Ok(made)
    }

    /// Whether a sample's photographs are placed like a user's.
    fn is_placed(&self, random: &mut impl Rng) -> bool {
        // A share of 0 draws no random number, so that the later random numbers do not change.
        let share = self.config.placed_share;
        if share == 0.0 {
            return false;
        }
        // A photograph that is not placed needs the nominal distance and focal length: else no network can predict it.
        let rig = self.folder.description().drawn.as_ref().map(|drawn| &drawn.jitter.rig);
        rig.is_some_and(|rig| rig.distance > 0.0 || rig.focal > 0.0) || random.random::<f32>() < share
    }
}

/// Number of steps between the views of a ring that span `degrees`; fractional if no view is there.
fn steps_of(degrees: f64, views: usize) -> f64 {
    degrees * views as f64 / 360.0
}
