//! What contestants, surfaces and meshes of an evaluation share: names, failures, renders.

use std::path::Component;

use snapsnap_splat::{Camera, Gaussians, render};

use super::config::{EvalConfig, ViewsSection};
use super::person::People;
use crate::Result;
use crate::pictures::Picture;

/// A part of an evaluation that failed.
#[derive(Debug, Clone, serde::Serialize)]
pub struct LeftOut {
    /// Person, or person and view, or model.
    pub name: String,
    /// The reason.
    pub why: String,
}

impl LeftOut {
    /// A failed part and the reason.
    pub fn new(name: impl Into<String>, why: impl ToString) -> Self {
        Self { name: name.into(), why: why.to_string() }
    }
}

/// The evaluated people of all data sets, with their rows in them.
pub(super) fn everybody(sets: &[People]) -> impl Iterator<Item = (&People, usize)> {
    sets.iter().flat_map(|set| set.chosen.iter().map(move |row| (set, *row)))
}

/// The people whom the config names and no data set has.
pub(super) fn missing(config: &EvalConfig, sets: &[People]) -> Vec<LeftOut> {
    let is_missing = |name: &&String| !everybody(sets).any(|(set, row)| set.test.name(row) == name.as_str());
    let missing = config.data.only.iter().filter(is_missing);
    let why = "data.only: no data set has this person, or not among its first `data.subjects`";
    let mut left_out: Vec<LeftOut> = missing.map(|name| LeftOut::new(name, why)).collect();
    if left_out.is_empty() && everybody(sets).next().is_none() {
        left_out.push(LeftOut::new("everything", "the data sets have no people"));
    }
    left_out
}

/// A person's name. With several data sets, the data set's name stands before it.
pub(super) fn name_of(sets: &[People], people: &People, row: usize) -> String {
    let name = people.test.name(row);
    if sets.len() < 2 {
        return name.to_owned();
    }
    let parts = |set: &People| {
        let root = set.folder.root();
        let root = root.canonicalize().unwrap_or_else(|_| root.to_owned());
        let parts = root.components().filter(|part| matches!(part, Component::Normal(_)));
        parts.map(|part| part.as_os_str().to_string_lossy().into_owned()).collect::<Vec<_>>()
    };
    // The fewest last folders of the path that no other data set has.
    let (own, all) = (parts(people), sets.iter().map(parts).collect::<Vec<_>>());
    let called = |count: usize| &own[own.len() - count..];
    let is_own = |count: &usize| all.iter().filter(|other| other.ends_with(called(*count))).count() == 1;
    let count = (1..own.len()).find(is_own).unwrap_or(own.len());
    format!("{}/{name}", called(count).join("/"))
}

/// Number of pictures of `side`² pixels that are processed at once, to bound memory: 64 million pixels need about 3
/// GB.
pub(super) fn at_once(side: usize) -> usize {
    const PIXELS: usize = 1 << 26;
    (PIXELS / (side * side).max(1)).clamp(1, rayon::current_num_threads())
}

/// A render of Gaussians (world frame) over black, `side`² pixels, with the config's options.
///
/// # Errors
/// [`EvalError`](crate::EvalError) for Gaussians that cannot be rendered.
pub fn rendered(shown: &Gaussians, camera: &Camera, side: usize, views: &ViewsSection) -> Result<Picture> {
    let large = side * views.supersampling;
    let camera = camera.resized(large as u32, large as u32);
    let color = render(shown, std::slice::from_ref(&camera), &views.render_options())?.color;
    Picture::rendered(&snapsnap_ops::host(color), [large, large], views.supersampling)
}
