//! Gaussians behind the surface (docs/method.md, "Backing"). A photograph's Gaussians have the size of its pixels and
//! leave gaps in pictures from near. Larger ones behind them fill the gaps in the surface's own colours.

use burn::tensor::{Tensor, TensorData};
use glam::{Quat, Vec3};
use snapsnap_ops::host;
use snapsnap_splat::Gaussians;

use crate::Reconstruction;
use crate::config::Config;
use crate::network::{View, nominal_camera, pixel_width};
use crate::painter::Origin;
use crate::steps::Step;

/// Pixels per Gaussian of the backing, along an axis.
const CELL: usize = 2;
/// Standard deviation along the surface, as a share of the distance of neighbouring cells.
const SCALE: f32 = 0.6;
/// Standard deviation along the normal, and depth behind the surface, in widths of a cell.
const THICKNESS: f32 = 0.25;
const DEPTH: f32 = 1.0;
const OPACITY: f32 = 0.99;
/// Largest distance of neighbouring cells, in widths of a cell. Other views see steeper surfaces better.
const STEEPEST: f32 = 2.5;

/// The Gaussians of a cell's pixels.
#[derive(Clone, Copy, Default)]
struct Cell {
    mean: Vec3,
    color: Vec3,
    count: usize,
    origin: Option<Origin>,
}

impl Reconstruction {
    /// Adds the [`backing`].
    pub fn add_backing(&mut self, config: &Config) {
        let added = backing(&self.gaussians, &self.origins, config);
        self.steps.push(Step::Backing { gaussians: added.as_ref().map_or(0, |(_, origins)| origins.len()) });
        if let Some((backing, origins)) = added {
            self.gaussians = Gaussians::joined(&[self.gaussians.clone(), backing]);
            self.origins.extend(origins);
        }
    }
}

/// The backing of all views behind the surface of the Gaussians, and its origins; `None` without one. Each Gaussian
/// belongs to a pixel of its cell. Cells beside a silhouette or a missing Gaussian have none. Nothing has gradients.
pub fn backing(surface: &Gaussians, of: &[Origin], config: &Config) -> Option<(Gaussians, Vec<Origin>)> {
    let side = config.network.resolution;
    let own = [&surface.means, &surface.colors].map(|x| host(x.clone()));
    let (mut rows, mut origins) = ([const { Vec::new() }; 4], Vec::new());
    for view in View::WITH_SECOND {
        let cells = cells(of, view, side, [&own[0], &own[1]]);
        let camera = nominal_camera(view, config.network.pair_degrees, side);
        let away = camera.world_to_camera.rotation.row(2).as_vec3();
        let (width, spacing) = (side / CELL, CELL as f32 * pixel_width(side));
        let inner = (1..width - 1).flat_map(|row| (1..width - 1).map(move |column| row * width + column));
        for at in inner {
            let mut around = [at - width, at, at + width].into_iter().flat_map(|row| row - 1..=row + 1);
            if !around.all(|cell| cells[cell].count == CELL * CELL) {
                continue;
            }
            let beside = [at - width, at - 1, at + 1, at + width].map(|cell| cells[cell].mean);
            let distances = beside.map(|mean| mean.distance(cells[at].mean));
            let [up, left, right, down] = beside;
            let normal = (right - left).cross(down - up).normalize_or_zero();
            if normal == Vec3::ZERO || distances.iter().any(|distance| *distance > STEEPEST * spacing) {
                continue;
            }
            let inwards = normal * normal.dot(away).signum();
            let turn = Quat::from_rotation_arc(Vec3::Z, inwards);
            let scale = SCALE * distances.iter().sum::<f32>() / 4.0;
            rows[0].extend((cells[at].mean + DEPTH * spacing * inwards).to_array());
            rows[1].extend([turn.w, turn.x, turn.y, turn.z]);
            rows[2].extend([scale, scale, THICKNESS * spacing]);
            rows[3].extend(cells[at].color.to_array());
            origins.extend(cells[at].origin);
        }
    }
    let (n, device) = (origins.len(), surface.device());
    let [means, rotations, scales, colors] = rows.map(|values: Vec<f32>| {
        let columns = values.len() / n.max(1);
        Tensor::<2>::from_data(TensorData::new(values, [n, columns]), &device)
    });
    let opacities = Tensor::full([n], OPACITY, &device);
    (n > 0).then(|| (Gaussians { means, rotations, scales, opacities, colors }, origins))
}

/// The cells of a view, row by row.
fn cells(origins: &[Origin], view: View, side: usize, [means, colors]: [&[f32]; 2]) -> Vec<Cell> {
    let width = side / CELL;
    let mut cells = vec![Cell::default(); width * width];
    for (i, origin) in origins.iter().enumerate().filter(|(_, origin)| origin.view == Some(view)) {
        let [row, column] = [origin.pixel as usize / side / CELL, origin.pixel as usize % side / CELL];
        let Some(cell) = cells.get_mut(row * width + column).filter(|_| column < width) else { continue };
        let of_row = |values: &[f32]| Vec3::from_slice(&values[3 * i..]) / (CELL * CELL) as f32;
        cell.mean += of_row(means);
        cell.color += of_row(colors);
        cell.count += 1;
        cell.origin = Some(*origin);
    }
    cells
}

#[cfg(test)]
pub(crate) mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::Points;

    pub(crate) const SIDE: usize = 32;

    /// A wall before the front's camera, `slope` metres deeper per metre to the right. Pixel (9, 12) has no Gaussian.
    pub(crate) fn wall(slope: f32) -> Reconstruction {
        let pixels = (4..24).flat_map(|row| (8..28).map(move |column| row * SIDE + column));
        let pixels: Vec<usize> = pixels.filter(|pixel| *pixel != 12 * SIDE + 9).collect();
        let (n, width, device) = (pixels.len(), pixel_width(SIDE), Device::flex());
        let rows = |columns: usize, of: &dyn Fn(usize) -> Vec<f32>| {
            let values: Vec<f32> = pixels.iter().flat_map(|pixel| of(*pixel)).collect();
            Tensor::<2>::from_data(TensorData::new(values, [n, columns]), &device)
        };
        let [x, y] = [|pixel: usize| (pixel % SIDE) as f32, |pixel: usize| (pixel / SIDE) as f32];
        let gaussians = Gaussians::new(
            rows(3, &|pixel| vec![width * x(pixel), width * y(pixel), 2.0 + slope * width * x(pixel)]),
            rows(4, &|_| vec![1.0, 0.0, 0.0, 0.0]),
            rows(3, &|_| vec![0.3 * width; 3]),
            Tensor::ones([n], &device),
            rows(3, &|pixel| vec![x(pixel) / 32.0, y(pixel) / 32.0, 0.5]),
        );
        let origin = |pixel: &usize| Origin { view: Some(View::Front), pixel: *pixel as u32 };
        Reconstruction {
            views: vec![View::Front],
            points: Points { maps: Tensor::zeros([1, 1, 1, 3], &device), host: Vec::new(), conf: Vec::new() },
            valid: Vec::new(),
            side_images: Vec::new(),
            gaussians: gaussians.expect("shapes"),
            origins: pixels.iter().map(origin).collect(),
            lost: 0,
            steps: Vec::new(),
            times: Vec::new(),
        }
    }

    pub(crate) fn config() -> Config {
        let mut config = Config::default();
        config.network.resolution = SIDE;
        config
    }

    #[test]
    fn the_backing_is_behind_the_surface_in_its_colours_and_away_from_its_edges() {
        let slope = 0.75_f32;
        let mut made = wall(slope);
        let before = made.gaussians.len();
        made.add_backing(&config());
        // Of 10 × 10 cells, 8 × 8 are inner ones; the cell of the missing Gaussian has three neighbours among them.
        let n = made.gaussians.len() - before;
        assert_eq!((n, made.origins.len()), (64 - 3, before + 64 - 3));
        let values = |x: &Tensor<2>| host(x.clone().narrow(0, before, n));
        let (means, colors) = (values(&made.gaussians.means), values(&made.gaussians.colors));
        let (scales, turns) = (values(&made.gaussians.scales), values(&made.gaussians.rotations));
        let cell = 2.0 * pixel_width(SIDE);
        for i in 0..n {
            let mean = Vec3::from_slice(&means[3 * i..]);
            let normal = Vec3::new(-slope, 0.0, 1.0).normalize();
            let behind = (mean - Vec3::new(0.0, 0.0, 2.0)).dot(normal);
            assert!((behind - cell).abs() < 1e-5, "{behind}");
            let on_surface = mean - cell * normal;
            let color = on_surface / pixel_width(SIDE) / 32.0;
            assert!((colors[3 * i] - color.x).abs() < 1e-4 && (colors[3 * i + 1] - color.y).abs() < 1e-4);
            let spacing = cell * (1.0 + (1.0 + slope * slope).sqrt()) / 2.0;
            assert!(
                (scales[3 * i] - 0.6 * spacing).abs() < 1e-5
                    && (scales[3 * i + 2] - 0.25 * cell).abs() < 1e-6
            );
            let [w, x, y, z] = [0, 1, 2, 3].map(|axis| turns[4 * i + axis]);
            assert!((Quat::from_xyzw(x, y, z, w) * Vec3::Z).dot(normal).abs() > 0.999_99);
        }
    }

    #[test]
    fn steep_walls_and_nothing_at_all_have_no_backing() {
        let mut steep = wall(4.0);
        let before = steep.gaussians.len();
        steep.add_backing(&config());
        assert_eq!(steep.gaussians.len(), before);
        steep.gaussians = crate::rows(&steep.gaussians, &[0]);
        steep.origins.truncate(1);
        steep.add_backing(&config());
        assert_eq!(steep.gaussians.len(), 1);
    }
}
