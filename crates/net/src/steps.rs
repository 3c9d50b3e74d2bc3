//! The steps of a run, the omitted steps with reasons, and the time of each module, as data and as lines for `-v`.

use std::time::{Duration, Instant};

use burn::tensor::Device;
use serde::Serialize;

use crate::config::Downsample;
use crate::window::Window;

/// A step of a run, or one that was left out.
#[derive(Debug, Clone, PartialEq, Serialize, thiserror::Error)]
#[serde(tag = "step", rename_all = "kebab-case")]
#[allow(missing_docs, reason = "names and messages say it")]
pub enum Step {
    /// The point predictor received the `window` of a canvas of this side, reduced to `size` (width, height), as this
    /// many tokens and channels of each photograph.
    #[error(
        "point predictor: 2 photographs of {}×{} ({} of {window}{}), {tokens} tokens each, {channels} channels",
        .size[0], .size[1], reduction(.window, .size[0], *.downsample),
        if *.window == Window::whole(*.canvas) { "" } else { ", the person's window" }
    )]
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
    #[error("details: 2 photographs of {}×{}, the person's window", .size[0], .size[1])]
    Details { size: [usize; 2] },
    #[error("details were left out: a canvas of {canvas}² has fewer pixels than their network's image of it")]
    NoDetails { canvas: usize },
    #[error("{pixels} pixels of the sides moved into the silhouettes")]
    MovedIntoSilhouettes { pixels: usize },
    /// Pixels of a view that become Gaussians, of all pixels of the canvas.
    #[error("{view}: {pixels} of {of} pixels become Gaussians")]
    Chosen { view: &'static str, pixels: usize, of: usize },
    #[error("{pixels} pixels left out: their points are not finite")]
    NotFinite { pixels: usize },
    #[error("{pixels} pixels of the sides left out: they lie outside of the silhouettes")]
    OutsideSilhouettes { pixels: usize },
    #[error("{pixels} pixels left out: their points hang between two surfaces")]
    BetweenSurfaces { pixels: usize },
    /// Colours of the sides were left out: `as_asked` by the caller, else since there are no sides.
    #[error("side colours left out{}", if *.as_asked { ", as asked for" } else { ": there are no side heads" })]
    NoSideColors { as_asked: bool },
    /// The regressor received the `window` of some views of a canvas of this side, with this box around the person.
    #[error("regressor ({views}): {window} of {canvas}×{canvas} pixels each, person's box {person}")]
    Regressor { views: &'static str, window: Window, canvas: usize, person: Window },
    #[error("regressor ({views}) left out: no pixel of these views is valid")]
    NoRegressor { views: &'static str },
    #[error("closed top: {gaussians} Gaussians between the upper edges of front and back")]
    ClosedTop { gaussians: usize },
    /// All Gaussians.
    #[error("{gaussians} Gaussians")]
    Gaussians { gaussians: usize },
    #[error("{gaussians} Gaussians left out: their attributes are not finite")]
    GaussiansNotFinite { gaussians: usize },
    #[error("{gaussians} Gaussians left out: they hang off the person's surface")]
    OffSurface { gaussians: usize },
    /// Gaussians whose colours were corrected by the render of their photograph's view.
    #[error("own colours: {gaussians} Gaussians corrected")]
    OwnColors { gaussians: usize },
    #[error("backing: {gaussians} Gaussians behind the surface")]
    Backing { gaussians: usize },
    /// Several pairs of photographs were reconstructed. The other steps belong to the first pair.
    #[error("{pairs} pairs of photographs, the first one")]
    Pairs { pairs: usize },
}

/// How the network's image of a window came to its `width`.
fn reduction(window: &Window, width: usize, downsample: Downsample) -> &'static str {
    match downsample {
        _ if window.columns.len() == width => "as they are instead",
        Downsample::Area => "area means",
        Downsample::Nearest => "every first pixel",
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
