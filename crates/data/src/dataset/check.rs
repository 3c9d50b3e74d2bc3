//! Faults of a data set: files that are missing or damaged, and views that contradict one another. Points of one view must
//! lie within the person's silhouette in the others.

use std::collections::{BTreeSet, HashSet};
use std::fs;
use std::path::Path;

use glam::{DVec2, DVec3};
use image::GrayImage;
use rayon::prelude::*;

use super::views::split_alpha;
use super::write::UNFINISHED;
use super::{Arrangement, DepthMap, Description, Folder, Layout, Person, Split, name};
use snapsnap_base::{FileError, folder};
use snapsnap_net::dilated;
use snapsnap_splat::{Camera, RigidTransform};

/// Largest share of the person without depth. Scans have gaps narrower than a pixel.
const HOLES: f64 = 0.01;
/// Largest side of a silhouette in cells. Silhouettes are coarser than the pictures.
const CELLS: u32 = 256;
/// Pictures with a shorter side are too coarse to compare.
const LEAST_SIDE: u32 = 64;
/// Largest number of points of a view that are tested.
const POINTS: usize = 2000;
/// Largest share of points outside the silhouette. Parts as thin as a pixel may be missing in another view.
const OUTSIDE: f64 = 0.08;

/// Result of a check.
#[derive(Debug, Default)]
pub struct Checked {
    /// Checked subjects.
    pub subjects: usize,
    /// Checked views.
    pub views: usize,
    /// One line per fault, with its file.
    pub problems: Vec<String>,
}

/// Reads all files of a data set. Calls `progress` with the number of checked subjects and of all subjects.
///
/// # Errors
/// [`FileError`] if `root` is no data set. Every other fault is a line of the result.
pub fn check(root: &Path, mut progress: impl FnMut(usize, usize)) -> Result<Checked, FileError> {
    let folder = Folder::open(root)?;
    let mut checked = Checked::default();
    let mut all: Vec<(Option<Split>, String)> = Vec::new();
    for split in folder.splits() {
        let subjects = folder.subjects(split)?;
        checked.problems.extend(orphans(&folder, split, &subjects));
        all.extend(subjects.into_iter().map(|subject| (split, subject)));
    }
    if all.is_empty() {
        checked.problems.push(format!("{}: there is no subject", root.display()));
    }
    let path = root.join(UNFINISHED);
    // A killed run's lock file alone is no fault. The next run removes it.
    if fs::read_dir(&path).is_ok_and(|entries| entries.flatten().any(|entry| entry.path().is_dir())) {
        checked.problems.push(format!(
            "{}: a run is in progress or was killed; the next run removes this folder",
            path.display()
        ));
    }
    for (done, (split, subject)) in all.iter().enumerate() {
        progress(done, all.len());
        checked.subjects += 1;
        checked.views += folder.description().views;
        let person = folder.person(*split, subject);
        checked.problems.extend(unexpected(&folder, person));
        let views = (0..folder.description().views).into_par_iter();
        let (problems, seen): (Vec<_>, Vec<_>) = views.map(|view| faults(&folder, person, view)).unzip();
        // A fault in a file of all views is reported once.
        let mut reported = HashSet::new();
        checked.problems.extend(problems.into_iter().flatten().filter(|p| reported.insert(p.clone())));
        let at = person.path("img");
        // Views a quarter turn apart are compared; in groups, a photograph with a side.
        let step = match folder.description().arrangement {
            Arrangement::Ring => (seen.len() / 4).max(1),
            Arrangement::Groups => 2,
        };
        checked.problems.extend(disagreements(&seen, step).map(|p| format!("{}: {p}", at.display())));
    }
    progress(all.len(), all.len());
    Ok(checked)
}

/// Parts of subjects that have no pictures.
fn orphans(folder: &Folder, split: Option<Split>, subjects: &[String]) -> Vec<String> {
    let mut problems = Vec::new();
    for kind in folder.kinds().iter().filter(|kind| **kind != "img") {
        let path = folder.split_path(split).join(kind);
        for path in folder::entries(&path).unwrap_or_default() {
            let name = name(&path);
            let subject = name.strip_suffix(".json").unwrap_or(&name).to_owned();
            if !subjects.contains(&subject) {
                problems.push(format!("{}: its subject has no pictures", path.display()));
            }
        }
    }
    problems.sort_unstable();
    problems
}

/// Files that belong to none of the views in the description.
fn unexpected(folder: &Folder, person: Person<'_>) -> Vec<String> {
    let views = folder.description().views;
    let mut extra = BTreeSet::new();
    for kind in folder.kinds().iter().filter(|kind| **kind != "cameras") {
        for path in folder::entries(&person.path(kind)).unwrap_or_default() {
            let number: String = name(&path).chars().take_while(char::is_ascii_digit).collect();
            if !number.parse().is_ok_and(|view: usize| view < views) {
                extra.insert(format!("{}: belongs to none of the {views} views", path.display()));
            }
        }
    }
    extra.into_iter().collect()
}

/// Faults of one view's files, and its points and silhouette if all files can be read.
fn faults(folder: &Folder, person: Person<'_>, view: usize) -> (Vec<String>, Option<Seen>) {
    let mut problems = Vec::new();
    let mut keep = |e: FileError| problems.push(e.to_string());
    let Description { layout, high_resolution, second_depth, .. } = *folder.description();
    if high_resolution {
        person.file(view, true).map_err(&mut keep).ok();
    }
    let picture = person.file(view, false).map_err(&mut keep).ok();
    let mask = match layout {
        Layout::Exact => picture.map(|picture| split_alpha(picture).1),
        Layout::Authors => person.mask(view).map_err(&mut keep).ok(),
    };
    let depth = person.depths("depth", view).map_err(&mut keep).ok();
    let second = second_depth.then(|| person.depths("depth2", view).map_err(&mut keep).ok());
    let camera = person.camera(view).map_err(&mut keep).ok();

    let at = person.path("img").join(view.to_string());
    let mut report = |problem: String| problems.push(format!("{}: {problem}", at.display()));
    let seen = |v: u8| v >= 128;
    let pixels = mask.as_ref().map(|mask| mask.as_raw().iter().filter(|v| seen(**v)).count());
    if pixels == Some(0) {
        report("its mask is empty".into());
    }
    let (Some(mask), Some(depth)) = (mask, depth) else { return (problems, None) };
    // Coverage and depth sample may differ by a pixel at the silhouette, but not inside it.
    let outside: Vec<bool> = mask.as_raw().iter().map(|v| !seen(*v)).collect();
    let outside = dilated(&outside, mask.width() as usize, 1);
    let missing = depth.iter().zip(outside).filter(|(z, outside)| **z <= 0.0 && !outside).count();
    // Gaps narrower than a pixel are lines.
    let area = pixels.unwrap_or(0) as f64;
    if missing as f64 > (HOLES * area).max(area.sqrt()) {
        report(format!("{missing} pixels of the person have no depth"));
    }
    if let Some(second) = second.flatten() {
        let is_wrong = |(first, second): &(&f32, &f32)| **second > 0.0 && (second <= first || **first <= 0.0);
        let wrong = depth.iter().zip(&second).filter(is_wrong).count();
        if wrong > 0 {
            report(format!("{wrong} pixels have a second surface that is not behind a first one"));
        }
    }
    // Empty and tiny views cannot be compared.
    let camera = camera.filter(|_| pixels != Some(0) && mask.width() >= LEAST_SIDE);
    let camera = camera.map(|camera| folder.exact_camera(&camera));
    let seen = camera.map(|camera| Seen::new(&DepthMap { depth, camera }, &mask));
    (problems, seen)
}

/// Points and silhouette of a view.
struct Seen {
    camera: Camera,
    /// World points, metres.
    points: Vec<DVec3>,
    /// `[side,side]` silhouette of the person, widened by one cell.
    outline: Vec<bool>,
    side: u32,
    /// Whether the picture cuts the person off.
    is_cut: bool,
}

impl Seen {
    /// The first pixel's sample is at (½, ½) of the camera.
    fn new(map: &DepthMap, mask: &GrayImage) -> Self {
        let width = map.camera.width;
        let side = width.min(CELLS);
        let mut outline = vec![false; (side * side) as usize];
        let mut is_cut = false;
        for (x, y, pixel) in mask.enumerate_pixels() {
            if pixel.0[0] < 128 && map.depth[(y * width + x) as usize] <= 0.0 {
                continue;
            }
            is_cut |= x == 0 || y == 0 || x + 1 == width || y + 1 == width;
            let cell = |v: u32| (u64::from(v) * u64::from(side) / u64::from(width)) as u32;
            outline[(cell(y) * side + cell(x)) as usize] = true;
        }
        let outline = dilated(&outline, side as usize, 1);
        let points: Vec<DVec3> = map.points(&RigidTransform::IDENTITY).flatten().collect();
        let points = points.iter().step_by(points.len().div_ceil(POINTS).max(1)).copied().collect();
        Self { camera: map.camera, points, outline, side, is_cut }
    }

    /// Share of the points of `other` outside this silhouette.
    fn outside(&self, other: &Self) -> f64 {
        let (mut tried, mut outside) = (0, 0);
        for point in &other.points {
            let size = f64::from(self.side);
            let cell_of = |(at, _): (DVec2, f64)| (at * size / f64::from(self.camera.width)).floor();
            let cell = self.camera.project(*point).map(cell_of);
            let cell = cell.filter(|c| c.cmpge(DVec2::ZERO).all() && c.max_element() < size);
            match cell {
                None if self.is_cut => continue,
                None => outside += 1,
                Some(c) => {
                    let row = c.y as usize * self.side as usize;
                    outside += usize::from(!self.outline[row + c.x as usize]);
                }
            }
            tried += 1;
        }
        if tried == 0 { 0.0 } else { outside as f64 / f64::from(tried) }
    }
}

/// Messages for pairs of views, `step` places apart, that contradict one another.
fn disagreements(views: &[Option<Seen>], step: usize) -> impl Iterator<Item = String> {
    let count = views.len();
    let pairs = if count > 2 { count } else { count.saturating_sub(1) };
    (0..pairs).filter_map(move |a| {
        let b = (a + step) % count;
        let (one, other) = (views[a].as_ref()?, views[b].as_ref()?);
        let share = one.outside(other).max(other.outside(one));
        (share > OUTSIDE).then(|| {
            let percent = 100.0 * share;
            format!(
                "views {a} and {b} do not fit one another: {percent:.0} % of the points of one lie outside the person in \
                 the other; a camera or a depth map is wrong"
            )
        })
    })
}
