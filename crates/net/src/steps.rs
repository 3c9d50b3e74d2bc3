//! The steps of a run, the omitted steps with reasons, and the time of each module, as data and as lines for `-v`.

use std::fmt;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use serde::Serialize;

use crate::config::Downsample;
use crate::window::Window;

/// A step of a run, or one that was left out.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "step", rename_all = "kebab-case")]
#[allow(missing_docs, reason = "the names say it")]
pub enum Step {
    /// The point predictor received the `window` of a canvas of this side, reduced to `size` (width, height), as this
    /// many tokens and channels of each photograph.
    PointPredictor {
        window: Window,
        canvas: usize,
        size: [usize; 2],
        /// How the window was reduced.
        downsample: Downsample,
        tokens: usize,
        channels: usize,
    },
    /// The network of details received both photographs in this size (width, height).
    Details { size: [usize; 2] },
    /// The network of details did not run: the canvas, of this side, has fewer pixels than the network's image of it.
    NoDetails { canvas: usize },
    /// Pixels of the sides moved into the silhouettes.
    MovedIntoSilhouettes { pixels: usize },
    /// Pixels of a view that become Gaussians, of all pixels of the canvas.
    Chosen { view: &'static str, pixels: usize, of: usize },
    /// Pixels left out, since their points are not finite.
    NotFinite { pixels: usize },
    /// Pixels of the sides left out, since they lie outside of the silhouettes.
    OutsideSilhouettes { pixels: usize },
    /// Pixels left out, since their points hang between two surfaces.
    BetweenSurfaces { pixels: usize },
    /// Colours of the sides were left out: `as_asked` by the caller, else since there are no sides.
    NoSideColors { as_asked: bool },
    /// The regressor received the `window` of some views of a canvas of this side, with this box around the person.
    Regressor { views: &'static str, window: Window, canvas: usize, person: Window },
    /// The regressor did not run: no pixel of these views is valid.
    NoRegressor { views: &'static str },
    /// Gaussians between the upper edges of front and back.
    ClosedTop { gaussians: usize },
    /// All Gaussians.
    Gaussians { gaussians: usize },
    /// Gaussians left out, since their attributes are not finite.
    GaussiansNotFinite { gaussians: usize },
    /// Gaussians left out, since they hang off the person's surface.
    OffSurface { gaussians: usize },
    /// Gaussians whose colours were corrected by the render of their photograph's view.
    OwnColors { gaussians: usize },
    /// Gaussians behind the surface.
    Backing { gaussians: usize },
    /// Several pairs of photographs were reconstructed. The other steps belong to the first pair.
    Pairs { pairs: usize },
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::PointPredictor { window, canvas, size: [width, height], downsample, tokens, channels } => {
                let reduced = match downsample {
                    _ if window.columns.len() == *width => "as they are instead",
                    Downsample::Area => "area means",
                    Downsample::Nearest => "every first pixel",
                };
                let part = if *window == Window::whole(*canvas) { "" } else { ", the person's window" };
                write!(
                    f,
                    "point predictor: 2 photographs of {width}×{height} ({reduced} of {window}{part}), {tokens} tokens each, {channels} \
                     channels"
                )
            }
            Self::Details { size: [width, height] } => {
                write!(f, "details: 2 photographs of {width}×{height}, the person's window")
            }
            Self::NoDetails { canvas } => {
                write!(
                    f,
                    "details were left out: a canvas of {canvas}² has fewer pixels than their network's image of it"
                )
            }
            Self::MovedIntoSilhouettes { pixels } => {
                write!(f, "{pixels} pixels of the sides moved into the silhouettes")
            }
            Self::Chosen { view, pixels, of } => {
                write!(f, "{view}: {pixels} of {of} pixels become Gaussians")
            }
            Self::NotFinite { pixels } => write!(f, "{pixels} pixels left out: their points are not finite"),
            Self::OutsideSilhouettes { pixels } => {
                write!(f, "{pixels} pixels of the sides left out: they lie outside of the silhouettes")
            }
            Self::BetweenSurfaces { pixels } => {
                write!(f, "{pixels} pixels left out: their points hang between two surfaces")
            }
            Self::NoSideColors { as_asked: true } => write!(f, "side colours left out, as asked for"),
            Self::NoSideColors { as_asked: false } => {
                write!(f, "side colours left out: there are no side heads")
            }
            Self::Regressor { views, window, canvas, person } => {
                write!(
                    f,
                    "regressor ({views}): {window} of {canvas}×{canvas} pixels each, person's box {person}"
                )
            }
            Self::NoRegressor { views } => {
                write!(f, "regressor ({views}) left out: no pixel of these views is valid")
            }
            Self::ClosedTop { gaussians } => {
                write!(f, "closed top: {gaussians} Gaussians between the upper edges of front and back")
            }
            Self::Gaussians { gaussians } => write!(f, "{gaussians} Gaussians"),
            Self::OffSurface { gaussians } => {
                write!(f, "{gaussians} Gaussians left out: they hang off the person's surface")
            }
            Self::OwnColors { gaussians } => write!(f, "own colours: {gaussians} Gaussians corrected"),
            Self::Backing { gaussians } => write!(f, "backing: {gaussians} Gaussians behind the surface"),
            Self::GaussiansNotFinite { gaussians } => {
                write!(f, "{gaussians} Gaussians left out: their attributes are not finite")
            }
            Self::Pairs { pairs } => write!(f, "{pairs} pairs of photographs, the first one"),
        }
    }
}

/// The steps and times of a run.
#[derive(Default)]
pub struct Record<'a> {
    /// What ran, and what was left out.
    pub steps: Vec<Step>,
    /// Time per module, with the device synchronised before and after each. Empty for a silent record.
    pub times: Vec<(&'static str, Duration)>,
    /// The device to measure, and what is called before each module.
    watch: Option<(&'a Device, &'a dyn Fn(&'static str))>,
}

impl<'a> Record<'a> {
    /// Measures times on `device`. `stage` is called with the name of each module before it runs.
    pub fn new(device: &'a Device, stage: &'a dyn Fn(&'static str)) -> Self {
        Self { watch: Some((device, stage)), ..Self::default() }
    }

    /// Does the work of a module.
    pub(crate) fn timed<T>(&mut self, name: &'static str, work: impl FnOnce(&mut Self) -> T) -> T {
        let Some((device, stage)) = self.watch else { return work(self) };
        stage(name);
        device.sync().expect("the device finishes its work");
        let start = Instant::now();
        let result = work(self);
        device.sync().expect("the device finishes its work");
        self.times.push((name, start.elapsed()));
        result
    }

    /// Adds a step that concerns a number of pixels or Gaussians, unless the number is 0.
    pub(crate) fn add_some(&mut self, count: usize, step: impl FnOnce(usize) -> Step) {
        if count > 0 {
            self.steps.push(step(count));
        }
    }
}
