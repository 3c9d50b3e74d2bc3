//! Stage 2: trains the regressor, and the point predictor if asked for, by comparing renders with target views
//! (docs/method.md, "Losses of stage 2").

mod scene;
mod scores;

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use burn::tensor::{Device, Tensor, TensorData};
use image::RgbImage;
use rand::Rng;
use snapsnap_base::random::stream;
use snapsnap_data::dataset::Folder;
use snapsnap_data::sample::{SampleConfig, Stage2, Stage2Item};
use snapsnap_net::config::{Config, RegressorStart};
use snapsnap_net::network::{PointMap, PointPredictor, View, anchors};
use snapsnap_net::steps::Record;
use snapsnap_net::weights::random_regressors;
use snapsnap_net::{Prediction, Window};
use snapsnap_ops::{host, mean};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render};

use crate::Result;
use crate::config::TrainConfig;
use crate::data::Data;
use crate::networks::Networks;
use crate::points::losses as points_losses;
use crate::ranks::Ranks;
use crate::task::{Moment, Part, Task, Validation};
use snapsnap_eval::preview::{grid, heat, picture};

pub use scene::photometric;
use scene::{Phase, gaussians, targets};
use scores::Scores;

/// β: the share of the L1 loss, as published. The rest is the share of the structural dissimilarity.
const L1_SHARE: f64 = 0.8;
/// Samples of a preview.
const PREVIEWS: usize = 3;
/// Error that is white in previews.
const WORST: f32 = 0.5;

/// The training of the regressor on the points of a predictor, which is frozen or trained as well.
pub struct GaussianTask {
    config: TrainConfig,
    networks: Config,
    /// The predictor, unless it is trained as well: in f32 for validations, in the training's precision for steps.
    frozen: Option<[PointPredictor; 2]>,
    data: Data<Stage2Item>,
    /// Scores of the billboard baseline, computed once.
    billboard_scores: OnceLock<[f64; 4]>,
    /// With autodiff.
    device: Device,
    /// The same without autodiff.
    inner: Device,
}

impl GaussianTask {
    /// A training on these data sets and a device with autodiff. `predictor` is the frozen predictor on the device
    /// without autodiff, or `None` if it is trained as well.
    ///
    /// # Errors
    /// [`TrainError`](crate::TrainError) if a data set cannot be used with this config.
    pub fn new(
        folders: &[Arc<Folder>],
        config: &TrainConfig,
        predictor: Option<PointPredictor>,
        device: &Device,
    ) -> Result<Self> {
        let points = config.stage2.points_weight > 0.0;
        // Second surfaces are trained in stage 1 alone.
        let samples = SampleConfig { points, second_depth: false, ..config.samples() };
        let data = Data::new(folders, config, &samples, Stage2::new)?;
        let in_both =
            |predictor: PointPredictor| [predictor.clone(), config.training.precision.lower(predictor)];
        Ok(Self {
            config: config.clone(),
            networks: config.networks(),
            frozen: predictor.map(in_both),
            data,
            billboard_scores: OnceLock::new(),
            device: device.clone(),
            inner: device.clone().inner(),
        })
    }

    /// Points of a sample's photographs by the trained or the frozen predictor, in a step or a validation.
    fn predict(&self, networks: &Networks, item: &Stage2Item, is_step: bool) -> Prediction {
        let (predictor, device) = match (&networks.predictor, &self.frozen) {
            (Some(predictor), _) => (predictor, if is_step { &self.device } else { &self.inner }),
            (None, frozen) => {
                let frozen = frozen.as_ref().expect("a predictor that is not trained is frozen");
                (&frozen[usize::from(is_step)], &self.inner)
            }
        };
        let photographs = item.photographs.each_ref();
        Prediction::of_pair(predictor, &self.networks, photographs, device, &mut Record::default())
    }

    /// Gaussians of all views, for validations.
    fn whole(&self, networks: &Networks, item: &Stage2Item) -> Gaussians {
        let prediction = self.predict(networks, item, false);
        gaussians(&self.networks, networks, item, prediction, &Phase::new(false, 0), &self.inner)
    }

    /// Scores of the billboard baseline: both photographs as flat cut-outs in the plane through the person's axis. Its
    /// points are the ray anchors, which lie on that plane. The last layer of a regressor with a geometric start is
    /// zero, so that random weights leave each Gaussian in its pixel's colour. Confidences of 0 leave the sides out.
    fn billboard(&self, ranks: &Ranks) -> Result<[f64; 4]> {
        if let Some(scores) = self.billboard_scores.get() {
            return Ok(*scores);
        }
        let device = &self.inner;
        let mut config = self.networks.clone();
        config.mode.compat = false;
        config.network.on_rays = false;
        config.regressor.start = Some(RegressorStart::Geometric);
        let networks = Networks { predictor: None, regressors: random_regressors(&config, 0, device) };
        let all = self.data.validated(ranks, |sums: &mut Scores, item| {
            let window = Window::whole(item.side);
            let map = |view: View| {
                let points = anchors(view, config.network.pair_degrees, item.side, &window, device);
                (view, PointMap { conf: Tensor::zeros([1, item.side, item.side], device), points })
            };
            let prediction = Prediction { maps: View::ALL.map(map).to_vec(), window: window.clone() };
            let gaussians = gaussians(&config, &networks, &item, prediction, &Phase::new(false, 0), device);
            Ok(sums.add(&item, pictures(&gaussians, &item.target_cameras, item.background)?.0)?)
        })?;
        Ok(*self.billboard_scores.get_or_init(|| Scores::mean(&all)))
    }
}

/// Rendered pictures `[V,3,h,w]` and coverage `[V,h,w]`. Without Gaussians the pictures show the background.
fn pictures(shown: &Gaussians, cameras: &[Camera], background: [f32; 3]) -> Result<(Tensor<4>, Tensor<3>)> {
    let color = Tensor::<1>::from_floats(background, &shown.device());
    let options = RenderOptions { background: Some(color), ..RenderOptions::inria() };
    let rendered = render(shown, cameras, &options)?;
    Ok((rendered.color.permute([0, 3, 1, 2]), rendered.alpha))
}

impl Task for GaussianTask {
    type Item = Stage2Item;
    const STAGE: u32 = 2;

    fn data(&self) -> &Data<Stage2Item> {
        &self.data
    }

    fn name(item: &Stage2Item) -> &str {
        &item.name
    }

    fn losses(&self, networks: &Networks, items: Vec<Stage2Item>, at: Moment) -> Result<Vec<Part>> {
        let Moment { step, first, .. } = at;
        let (config, seed) = (&self.config.stage2, self.config.training.seed);
        let (phase, device) = (Phase::new(config.curriculum, step), &self.device);
        let mut sums: BTreeMap<&'static str, (f64, Vec<Tensor<1>>)> = BTreeMap::new();
        for (place, item) in items.iter().enumerate() {
            let mut random = stream(&format!("stage2/{seed}/{step}/{}", first + place));
            let count = item.target_cameras.len();
            // While only the Gaussians of the sides are drawn, the target is one of the sides: the last two.
            let first = if phase.views.start == 2 { count - 2 } else { 0 };
            let chosen =
                if phase.one_view { vec![random.random_range(first..count)] } else { (0..count).collect() };
            let prediction = self.predict(networks, item, true);
            let mut add = |name, weight: f64, value: Tensor<1>| {
                sums.entry(name).or_insert((weight, Vec::new())).1.push(value);
            };
            if networks.predictor.is_some() {
                let (side, points, valid) = (item.side, item.points.clone(), item.valid.clone());
                let views = valid.len() / (side * side);
                let points = Tensor::from_data(TensorData::new(points, [1, views, side, side, 3]), device);
                let valid = Tensor::from_data(TensorData::new(valid, [1, views, side, side]), device);
                let parts = points_losses(&prediction, &points, &valid, self.config.stage1.relief_weight);
                let value = parts.into_iter().map(|part| part.value * part.weight);
                add("points", config.points_weight, value.reduce(|a, b| a + b).expect("there are points"));
            }
            let gaussians = gaussians(&self.networks, networks, item, prediction, &phase, device);
            // A sample without a valid pixel has no picture, and counts as one without an error.
            if gaussians.is_empty() {
                continue;
            }
            let cameras: Vec<Camera> = chosen.iter().map(|v| item.target_cameras[*v]).collect();
            let (image, coverage) = pictures(&gaussians, &cameras, item.background)?;
            let (target, mask) = targets(item, &chosen, device);
            let [l1, ssim] = photometric(image, target);
            add("l1", L1_SHARE, l1);
            add("dissimilarity", 1.0 - L1_SHARE, 1.0 - ssim);
            if config.alpha_weight > 0.0 {
                add("alpha", config.alpha_weight, mean((coverage - mask).abs()));
            }
            if phase.scale_weight > 0.0 {
                add("scale", phase.scale_weight, mean(gaussians.scales.clone()));
            }
        }
        let samples = items.len() as f64;
        let mean =
            |(name, (weight, values))| Part { name, weight, value: Tensor::cat(values, 0).sum() / samples };
        Ok(sums.into_iter().map(mean).collect())
    }

    fn validate(&self, networks: &Networks, ranks: &Ranks) -> Result<Option<Validation>> {
        if self.data.count == 0 {
            return Ok(None);
        }
        let all = self.data.validated(ranks, |sums: &mut Scores, item| {
            let gaussians = self.whole(networks, &item);
            Ok(sums.add(&item, pictures(&gaussians, &item.target_cameras, item.background)?.0)?)
        })?;
        let [full, masked, sides, ssim] = Scores::mean(&all);
        let [_, billboard_masked, billboard_sides, _] = self.billboard(ranks)?;
        let figures = vec![
            ("psnr_masked", masked),
            ("psnr_masked_sides", sides),
            ("psnr", full),
            ("ssim", ssim),
            ("billboard_psnr_masked", billboard_masked),
            ("billboard_psnr_masked_sides", billboard_sides),
        ];
        Ok(Some(Validation { score: -masked, figures }))
    }

    fn preview(&self, networks: &Networks) -> Result<Option<RgbImage>> {
        let mut rows = Vec::new();
        for item in self.data.validation(PREVIEWS) {
            let item = item?;
            let (side, area) = (item.side, item.side * item.side);
            let photo = |view: usize| {
                picture([side; 2], |i| {
                    [0, 1, 2].map(|c| item.photographs[view].rgb[c * area + i] * 0.5 + 0.5)
                })
            };
            let mut row = vec![photo(0), photo(1)];
            let views = [0, item.target_cameras.len() - 2];
            let cameras = views.map(|v| item.target_cameras[v]);
            let seen = host(pictures(&self.whole(networks, &item), &cameras, item.background)?.0);
            let (side, area) = (item.target_side, item.target_side.pow(2));
            for (place, view) in views.into_iter().enumerate() {
                let at = |values: &[f32], view: usize, i: usize| {
                    [0, 1, 2].map(|c| values[(3 * view + c) * area + i])
                };
                let (got, truth) = (|i| at(&seen, place, i), |i| at(&item.targets, view, i));
                let error = |i: usize| {
                    let (a, b) = (got(i), truth(i));
                    (0..3).map(|c| (a[c] - b[c]).abs()).sum::<f32>() / 3.0
                };
                row.extend([
                    picture([side; 2], got),
                    picture([side; 2], truth),
                    picture([side; 2], |i| heat(error(i), WORST)),
                ]);
            }
            rows.push(row);
        }
        let captions = ["front", "back", "render", "truth", "error", "render", "truth", "error"];
        let note = format!("two views; white errors: {WORST} of 1 or more");
        Ok(grid(&rows, &captions, &note))
    }

    fn frozen(&self) -> BTreeMap<String, Vec<f32>> {
        let predictor = self.frozen.as_ref().map(|[whole, _]| whole.clone());
        Networks { predictor, regressors: Vec::new() }.checkpoint()
    }
}
