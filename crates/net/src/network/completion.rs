//! The unseen sides from the photographs' points (docs/method.md, "Completed sides"): the points are projected into
//! the side's camera, and a U-shaped network completes and corrects them. The left is the right of the mirrored
//! person, so that one network serves both sides.

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::tensor::{Device, Tensor};

use super::View;
use super::dpt::conv1x1;
use super::rays::Rays;
use super::shells::{Visible, depths};
use super::unet::{UNet, UNetSizes};
use crate::config::{NetworkConfig, OPPOSITE};
use crate::window::Window;
use snapsnap_ops::gather::taken;
use snapsnap_ops::host;
use snapsnap_ops::layers::conv2d;

/// Channels of the predictor's features in the input.
const FEATURES: usize = 16;
/// Channels of the input. Nearest point: depth, colour, front or back, features. Second point: depth, whether there
/// is one. Farthest point: depth.
const INPUTS: usize = 1 + 3 + 2 + FEATURES + 2 + 1;
/// Metres per unit of the input's depths, which start at the plane through the body's axis: as large as colours.
const DEPTH_UNIT: f64 = 0.2;

/// Data of both photographs at the network's resolution.
pub struct Photographed<'a> {
    /// `[B, 2, h, w, 3]` front and back: points in metres, front camera's frame.
    pub points: Tensor<5>,
    /// `[B, 2, 3, h, w]` colours in [−1, 1].
    pub colors: Tensor<5>,
    /// `[B, 2, 1, h, w]` share of the person.
    pub masks: Tensor<5>,
    /// Features `[B, last_dim, h, w]` of the predictor's decoder, for front and mirrored back.
    pub features: Tensor<4>,
    /// Images of the predictor's levels `[B, layer_dims, ..]`.
    pub levels: &'a [Tensor<4>],
    /// Part of the canvas of `net_resolution`² pixels, symmetric.
    pub window: &'a Window,
}

/// The completion network.
#[derive(Module, Debug)]
pub struct Completion {
    embed: Conv2d,
    /// By level: convolutions of the predictor's row means over both halves of the person.
    rows: Vec<Conv2d>,
    body: UNet,
    #[module(skip)]
    side: usize,
    #[module(skip)]
    second_layer: bool,
}

impl Completion {
    pub(super) fn new(config: &NetworkConfig, device: &Device) -> Self {
        let (c, widths) = (config, config.side_dims);
        let sizes = UNetSizes {
            inputs: INPUTS,
            outputs: if c.second_layer { 4 } else { 2 },
            widths,
            blocks: [c.dec_dim, c.dec_depth, c.dec_heads],
            stride: c.stride(),
            last_dim: c.last_dim,
        };
        Self {
            embed: conv1x1(c.last_dim, FEATURES, device),
            rows: widths.iter().zip(c.layer_dims).map(|(to, from)| conv1x1(2 * from, *to, device)).collect(),
            body: UNet::new(&sizes, device),
            side: c.net_resolution,
            second_layer: c.second_layer,
        }
    }

    /// Raw x, y, z, confidence `[B, 4, h, w]` of right and left, then of their second surfaces, if the network has
    /// them. Points are differences from the anchors over δ `[1]`.
    pub(super) fn forward(&self, photographed: &Photographed, delta: &Tensor<1>) -> Vec<Tensor<4>> {
        let [b, _, h, w, _] = photographed.points.dims();
        let table = self.table(photographed);
        let points = photographed.points.clone().reshape([b, 2 * h * w, 3]);
        let [there, inside] = [host(points.clone().detach()), host(photographed.masks.clone())];
        let seen = [View::Right, View::Left].map(|view| {
            let rows = Visible::new(view, self.side, photographed.window, [&there, &inside], b);
            SideInput::new(view, self.side, photographed.window, (points.clone(), table.clone()), rows)
        });
        let images = vec![seen[0].image.clone(), seen[1].image.clone().flip([3])];
        let levels = self.body.encode(Tensor::cat(images, 0), Some(self.row_means(photographed.levels)));
        let out = self.body.decoder.out(self.body.features(&levels));
        let out = [out.clone().narrow(0, 0, b), out.narrow(0, b, b).flip([3])];
        let raw = |layer: usize, seen: &SideInput, out: &Tensor<4>| {
            let known = seen.depths[layer].clone();
            let known = known.clone() / delta.clone().reshape([1; 4]).expand(known.dims());
            let beside = known + out.clone().narrow(1, 2 * layer, 1);
            let directions = seen.directions.clone().permute([0, 3, 1, 2]);
            Tensor::cat(vec![directions * beside, out.clone().narrow(1, 2 * layer + 1, 1)], 1)
        };
        let of_layer = |layer| seen.iter().zip(&out).map(move |(seen, out)| raw(layer, seen, out));
        (0..if self.second_layer { 2 } else { 1 }).flat_map(of_layer).collect()
    }

    /// Colour, front or back, and features of all pixels of both photographs `[B, N, 5 + FEATURES]`.
    fn table(&self, Photographed { colors, features, .. }: &Photographed) -> Tensor<3> {
        let ([b, _, _, h, w], device) = (colors.dims(), colors.device());
        let features = conv2d(&self.embed, features.clone(), true);
        // The features of the mirrored back are flipped: its points are not mirrored.
        let features = Tensor::stack::<5>(vec![features.clone(), features.flip([3])], 1);
        let shells = Tensor::<2>::eye(2, &device).reshape([1, 2, 2, 1, 1]).expand([b, 2, 2, h, w]);
        let all = Tensor::cat(vec![colors.clone(), shells, features], 2);
        let channels = all.dims()[2];
        all.permute([0, 1, 3, 4, 2]).reshape([b, 2 * h * w, channels])
    }

    /// By level, for right and mirrored left `[2·B, side_dims, h, 1]`: row means of the person's near and far half.
    fn row_means(&self, levels: &[Tensor<4>]) -> Vec<Tensor<4>> {
        let means = |(layer, image): (&Conv2d, &Tensor<4>)| {
            let half = image.dims()[3] / 2;
            // The right camera is on the side of the front picture's right half.
            let [left, right] = [0, half].map(|from| image.clone().narrow(3, from, half).mean_dim(3));
            let ways = [[right.clone(), left.clone()], [left, right]].map(|way| Tensor::cat(way.to_vec(), 1));
            conv2d(layer, Tensor::cat(ways.to_vec(), 0), false)
        };
        self.rows.iter().zip(levels).map(means).collect()
    }
}

/// The points of both photographs in the image of a side.
struct SideInput {
    /// Input of the network `[B, INPUTS, h, w]`.
    image: Tensor<4>,
    /// Depths of the nearest and the second point minus the anchor's `[B, 1, h, w]`, metres; 0 without a point.
    depths: [Tensor<4>; 2],
    /// Directions of the rays `[1, h, w, 3]`, scaled to a depth of 1 in the view's camera.
    directions: Tensor<4>,
}

impl SideInput {
    /// From `points` `[B, N, 3]` and the table of their channels `[B, N, ..]`.
    fn new(
        view: View,
        side: usize,
        window: &Window,
        (points, table): (Tensor<3>, Tensor<3>),
        rows: Visible,
    ) -> Self {
        let ([b, n, _], device) = (points.dims(), points.device());
        let (h, w) = (window.rows.len(), window.columns.len());
        let table = Tensor::cat(vec![depths(view, points), table], 2);
        let c = table.dims()[2];
        let table = table.reshape([b * n, c]);
        let image = |x: Tensor<2>, c: usize| x.reshape([b, h, w, c]).permute([0, 3, 1, 2]);
        let [second, farthest] =
            [rows.second, rows.farthest].map(|rows| image(taken(table.clone().narrow(1, 0, 6), &rows), 6));
        let nearest = image(taken(table, &rows.nearest), c);
        let rays = Rays::new(view, OPPOSITE, side, window, &device);
        let anchors = rays.depths.permute([0, 3, 1, 2]);
        let is_there = |point: &Tensor<4>| point.clone().narrow(1, 4, 2).sum_dim(1);
        let beside = |point: &Tensor<4>| (point.clone().narrow(1, 0, 1) - anchors.clone()) * is_there(point);
        let depths = [beside(&nearest), beside(&second)];
        let image = Tensor::cat(
            vec![
                depths[0].clone() / DEPTH_UNIT,
                nearest.narrow(1, 1, c - 1),
                depths[1].clone() / DEPTH_UNIT,
                is_there(&second),
                beside(&farthest) / DEPTH_UNIT,
            ],
            1,
        );
        Self { image, depths, directions: rays.directions }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use burn::module::Param;
    use burn::tensor::TensorData;
    use glam::Vec3;

    use super::*;
    use crate::config::{Body, Config};
    use crate::network::predictor::Body as PredictorBody;
    use crate::network::{Input, PointMap, PointPredictor, anchors, nominal_camera};
    use crate::parameters::{NamedMapper, ParameterPath, map_named};
    use crate::weights::random_predictor;

    pub const SIDE: usize = 64;
    const WIDTHS: [usize; 4] = [4, 4, 8, 8];

    /// A predictor of a few thousand parameters with completed sides.
    pub fn config() -> NetworkConfig {
        NetworkConfig {
            body: Body::Convolution,
            patch: 8,
            enc_dim: 16,
            enc_heads: 2,
            enc_depth: 1,
            dec_dim: 16,
            dec_heads: 2,
            dec_depth: 1,
            layer_dims: WIDTHS,
            side_dims: WIDTHS,
            last_dim: 8,
            resolution: SIDE,
            net_resolution: SIDE,
            anchor: crate::config::Anchor::Ray,
            mask_channel: true,
            mirror: true,
            sides: crate::config::Sides::Completed,
            second_layer: true,
            ..NetworkConfig::default()
        }
    }

    fn noise<const D: usize>(dims: [usize; D], seed: u32) -> Tensor<D> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        let values = (0..dims.iter().product()).map(|_| next()).collect::<Vec<_>>();
        Tensor::from_data(TensorData::new(values, dims), &Device::flex())
    }

    /// A person whose front and back bulge by up to 10 cm, with random colours and features.
    fn person<'a>(window: &'a Window, levels: &'a [Tensor<4>]) -> Photographed<'a> {
        let (h, w, device) = (window.rows.len(), window.columns.len(), Device::flex());
        let points = [View::Front, View::Back].map(|view| {
            let away = if view == View::Front { -1.0 } else { 1.0 };
            let off = (noise([1, h, w, 1], view as u32 + 1) + 1.2) * (0.05 * away);
            let z = Tensor::<1>::from_floats([0.0, 0.0, 1.0], &device).reshape([1, 1, 1, 3]);
            anchors(view, OPPOSITE, SIDE, window, &device) + off * z
        });
        Photographed {
            points: Tensor::stack(points.to_vec(), 1),
            colors: noise([1, 2, 3, h, w], 3),
            masks: (noise([1, 2, 1, h, w], 4) + 0.9).clamp(0.0, 1.0),
            features: noise([1, 8, h, w], 5),
            levels,
            window,
        }
    }

    fn network() -> Completion {
        let config = Config { network: config(), ..Config::default() };
        let predictor = random_predictor(&config, 3, &Device::flex());
        let PredictorBody::Convolution(net) = predictor.body else { panic!("the body is a transformer") };
        net.completion.expect("completed sides")
    }

    /// The right of a mirrored person is the mirrored left of the person, and the other way round.
    #[test]
    fn a_mirrored_person_has_mirrored_sides_exchanged() {
        let window = Window { rows: 8..56, columns: 16..48 };
        let (h, w) = (48, 32);
        let levels: Vec<Tensor<4>> =
            (0..4).map(|l| noise([1, WIDTHS[l], h >> l, w >> l], 7 + l as u32)).collect();
        let mirrored_levels: Vec<Tensor<4>> = levels.iter().map(|level| level.clone().flip([3])).collect();
        let (net, delta) = (network(), Tensor::full([1], 0.2, &Device::flex()));
        let plain = person(&window, &levels);
        let points = plain.points.clone().flip([3]);
        let x = -points.clone().narrow(4, 0, 1);
        let mirrored = Photographed {
            points: points.slice_assign([0..1, 0..2, 0..h, 0..w, 0..1], x),
            colors: plain.colors.clone().flip([4]),
            masks: plain.masks.clone().flip([4]),
            features: plain.features.clone().flip([3]),
            levels: &mirrored_levels,
            window: &window,
        };
        let (sides, exchanged) = (net.forward(&plain, &delta), net.forward(&mirrored, &delta));
        for (side, other) in [(0, 1), (1, 0), (2, 3), (3, 2)] {
            let expected = sides[side].clone().flip([3]);
            let x = -expected.clone().narrow(1, 0, 1);
            let expected = host(expected.slice_assign([0..1, 0..1, 0..h, 0..w], x));
            let got = host(exchanged[other].clone());
            let apart = got.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(apart < 2e-4, "{apart}");
        }
        assert!(
            host(sides[0].clone()) != host(sides[1].clone())
                && host(sides[0].clone()) != host(sides[2].clone())
        );
    }

    /// The depth of a pixel follows the point that it shows, and no other.
    #[test]
    fn gradients_reach_the_points_that_a_side_shows() {
        let window = Window { rows: 8..56, columns: 16..48 };
        let device = Device::flex().autodiff();
        let n = 2 * 48 * 32;
        let person = person(&window, &[]);
        let (known, inside) = (host(person.points.clone()), host(person.masks.clone()));
        let points =
            Tensor::<3>::from_data(TensorData::new(known.clone(), [1, n, 3]), &device).require_grad();
        let rows = Visible::new(View::Right, SIDE, &window, [&known, &inside], 1);
        let shown = rows.nearest.clone();
        let table = Tensor::cat(
            vec![Tensor::zeros([1, n, 3], &device), Tensor::ones([1, n, 2 + FEATURES], &device)],
            2,
        );
        // Two channels, front and back, mark that there is a point; here both are ½.
        let seen = SideInput::new(View::Right, SIDE, &window, (points.clone(), table * 0.5), rows);
        let gradients = seen.depths[0].clone().sum().backward();
        let gradient = host(points.grad(&gradients).expect("a gradient"));
        let side = nominal_camera(View::Right, OPPOSITE, SIDE).world_to_camera;
        let axis = side.rotation.row(2).as_vec3().to_array();
        for (i, gradient) in gradient.chunks_exact(3).enumerate() {
            let expected = if shown.contains(&(i as i32)) { axis } else { [0.0; 3] };
            assert!((0..3).all(|c| (gradient[c] - expected[c]).abs() < 1e-5), "{i}: {gradient:?}");
        }
    }

    /// The predictor, in which the output of the `layer` is this value everywhere.
    pub fn with_output(predictor: PointPredictor, layer: &str, value: f64) -> PointPredictor {
        struct Constant<'a>(&'a str, f64);
        impl NamedMapper for Constant<'_> {
            fn map<const D: usize>(
                &mut self,
                path: &ParameterPath,
                param: Param<Tensor<D>>,
            ) -> Param<Tensor<D>> {
                let name = path.name();
                if !name.contains(self.0) {
                    return param;
                }
                let value = if name.ends_with("bias") { self.1 } else { 0.0 };
                param.map(|values| values.zeros_like() + value)
            }
        }
        map_named(predictor, "", &mut Constant(layer, value))
    }

    /// Points of all views from random photographs, by a predictor whose completion network corrects nothing.
    fn uncorrected(both_ways: bool, b: usize) -> Vec<(View, Vec<f32>)> {
        let network = NetworkConfig { both_ways, delta: 0.02, ..config() };
        let config = Config { network, ..Config::default() };
        let net = random_predictor(&config, 3, &Device::flex());
        let net = with_output(net, "completion.decoder.conv_out", 0.0);
        let window = Window { rows: 0..SIDE, columns: 0..SIDE };
        let masks = (noise([2 * b, 1, SIDE, SIDE], 4) + 0.9).clamp(0.0, 1.0);
        let colors = noise([2 * b, 3, SIDE, SIDE], 3) * masks.clone();
        let input = Input::new(&config, colors, masks.clone(), &window);
        let points = |(view, map): (View, PointMap)| {
            let mask = ((view as usize) < 2).then(|| masks.clone().narrow(0, view as usize * b, b));
            (view, host(net.finished(&config, view, map, &window, mask.as_ref()).points))
        };
        net.forward(input, &window).into_iter().map(points).collect()
    }

    /// Without corrections, both surfaces of a side are points of the photographs or lie on the anchors' plane.
    #[test]
    fn uncorrected_sides_are_the_photographs_points() {
        let (window, size) = (Window::whole(SIDE), 3 * SIDE * SIDE);
        for (both_ways, b) in [(false, 2), (true, 1)] {
            let maps = uncorrected(both_ways, b);
            assert_eq!(maps.iter().map(|(view, _)| *view).collect::<Vec<_>>(), View::WITH_SECOND);
            for sample in 0..b {
                let of = |map: &'_ Vec<f32>| map[sample * size..(sample + 1) * size].to_vec();
                let known: Vec<f32> = maps[..2].iter().flat_map(|(_, map)| of(map)).collect();
                let mut covered = [0; 4];
                for ((view, map), covered) in maps[2..].iter().zip(&mut covered) {
                    let anchors = host(anchors(*view, OPPOSITE, SIDE, &window, &Device::flex()));
                    let camera = nominal_camera(*view, OPPOSITE, SIDE);
                    for (point, anchor) in of(map).chunks_exact(3).zip(anchors.chunks_exact(3)) {
                        let apart = |p: &[f32]| (0..3).map(|c| (p[c] - point[c]).powi(2)).sum::<f32>().sqrt();
                        if apart(anchor) < 1e-5 {
                            continue;
                        }
                        let nearest = known.chunks_exact(3).map(apart).fold(f32::INFINITY, f32::min);
                        let depth = camera.world_to_camera.apply(Vec3::from_slice(point).as_dvec3()).z;
                        let half_diagonal = 0.5_f64.sqrt() * depth / camera.focal.x;
                        assert!(
                            f64::from(nearest) < half_diagonal + 1e-4,
                            "{view:?}: {nearest} m at {depth} m"
                        );
                        *covered += 1;
                    }
                }
                assert!(covered.iter().all(|count| *count > 50), "{covered:?}");
            }
        }
    }
}
