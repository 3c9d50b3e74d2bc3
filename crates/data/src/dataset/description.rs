//! The description of a data set, `dataset.toml`.

use std::fmt;
use std::io::Write;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::JitterConfig;
use crate::light::LightConfig;
use snapsnap_base::{FileError, config, file};

/// Name of the description's file.
pub const DESCRIPTION: &str = "dataset.toml";
/// Largest description that is read, in bytes.
const MAX_DESCRIPTION: u64 = 1 << 20;
/// Largest number of views of a subject.
pub const MAX_VIEWS: usize = 4096;
/// Largest side of a view.
pub const MAX_RESOLUTION: u32 = 8192;

/// Layout of the stored views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// The layout of the authors' tools: JPEG, depth in 16 bits, sampled at the pixels' corners.
    Authors,
    /// Lossless, depth in f32, sampled at the pixels' centres.
    Exact,
}

/// Arrangement of a subject's views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Arrangement {
    /// Evenly around the subject, with independent deviations. Any view may be the front. The opposite view is its
    /// back.
    #[default]
    Ring,
    /// In groups of four: a front, a back whose camera deviates, and the right and left sides at exact quarter turns of
    /// the front camera. The sides' cameras thereby follow from the front (docs/method.md, "Samples").
    Groups,
}

impl Arrangement {
    /// Front, back, right and left of a sample whose front is view `first` of `count`.
    pub fn four(self, first: usize, count: usize) -> [usize; 4] {
        match self {
            Self::Ring => [0, 2, 1, 3].map(|quarter| (first + quarter * count / 4) % count),
            Self::Groups => [0, 1, 2, 3].map(|place| first + place),
        }
    }
}

/// Purpose of a subject. Different splits have different people.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// For training.
    Train,
    /// For the choice of the best weights.
    Val,
    /// For reports.
    Test,
}

impl Split {
    /// Every split.
    pub const ALL: [Self; 3] = [Self::Train, Self::Val, Self::Test];

    /// Name of the split's folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Val => "val",
            Self::Test => "test",
        }
    }
}

impl fmt::Display for Split {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The content of `dataset.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Layout of the stored views.
    pub layout: Layout,
    /// Views of each subject.
    pub views: usize,
    /// Arrangement of the views around the subject.
    #[serde(default, skip_serializing_if = "is_default")]
    pub arrangement: Arrangement,
    /// Side of a view in pixels.
    pub resolution: u32,
    /// Whether each view is stored at twice the side as well.
    pub high_resolution: bool,
    /// Whether the depth of the second surface that faces the camera is stored as well.
    #[serde(default, skip_serializing_if = "is_default")]
    pub second_depth: bool,
    /// Camera coordinates of the first pixel's sample: 0 in the authors' sets, ½ in the exact layout. Points from depth
    /// are half a pixel off without this correction.
    pub pixel_centre: f64,
    /// Source of the subjects.
    pub source: String,
    /// Sampling and cameras of the renders, if known.
    pub drawn: Option<Drawn>,
}

/// Settings of the renders.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drawn {
    /// Samples per pixel along each axis.
    pub samples: usize,
    /// Deviations of the cameras.
    pub jitter: JitterConfig,
    /// Light.
    #[serde(default, skip_serializing_if = "is_default")]
    pub light: LightConfig,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl Description {
    pub(super) fn problem(&self) -> Option<String> {
        let views = ("views", self.views as u64, 1..=MAX_VIEWS as u64);
        let resolution = ("resolution", self.resolution.into(), 1..=MAX_RESOLUTION.into());
        if let Some((key, message)) = config::outside([views, resolution]) {
            return Some(format!("`{key}` {message}"));
        }
        if self.arrangement == Arrangement::Groups && !self.views.is_multiple_of(4) {
            return Some(format!(
                "`views` is {}, must be a multiple of 4 for `arrangement` = \"groups\"",
                self.views
            ));
        }
        if self.pixel_centre != 0.0 && self.pixel_centre != 0.5 {
            return Some(format!("`pixel_centre` is {}, must be 0 or 0.5", self.pixel_centre));
        }
        None
    }
}

/// Reads a description.
pub fn read(path: &Path) -> Result<Description, FileError> {
    let text = file::read_text(path, MAX_DESCRIPTION).map_err(FileError::read(path))?;
    let description: Description =
        toml::from_str(&text).map_err(|e| FileError::unsuitable(path, e.to_string().trim_end()))?;
    match description.problem() {
        Some(problem) => Err(FileError::unsuitable(path, problem)),
        None => Ok(description),
    }
}

/// Writes a description.
pub fn write(path: &Path, description: &Description) -> Result<(), FileError> {
    let keys = toml::to_string(description).expect("the description has only TOML types");
    file::write_whole(path, |out| write!(out, "# Written by `snapsnap prepare`.\n{keys}"))
        .map_err(FileError::write(path))
}

/// Differences between two descriptions, key by key.
pub fn differences(there: &Description, wanted: &Description) -> String {
    let messages = config::differences(&config::keys(there), &config::keys(wanted));
    messages.into_iter().map(|(_, message)| message).collect::<Vec<_>>().join(", ")
}
