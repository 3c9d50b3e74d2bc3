//! Consistency of a subject's views: points of one view must lie within the person's silhouette in the others.

use glam::{DVec2, DVec3};
use image::GrayImage;
use snapsnap_net::dilated;
use snapsnap_splat::{Camera, RigidTransform};

use super::DepthMap;

/// Largest side of a silhouette in cells. Silhouettes are coarser than the pictures.
const CELLS: u32 = 256;
/// Pictures with a shorter side are too coarse to compare.
pub const LEAST_SIDE: u32 = 64;
/// Largest number of points of a view that are tested.
const POINTS: usize = 2000;
/// Largest share of points outside the silhouette. Parts as thin as a pixel may be missing in another view.
const OUTSIDE: f64 = 0.08;

/// Points and silhouette of a view.
pub struct Seen {
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
    pub fn new(map: &DepthMap, mask: &GrayImage) -> Self {
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
            let cell = self
                .camera
                .project(*point)
                .map(|(at, _)| (at * f64::from(self.side) / f64::from(self.camera.width)).floor());
            let size = f64::from(self.side);
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
pub fn disagreements(views: &[Option<Seen>], step: usize) -> impl Iterator<Item = String> {
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
