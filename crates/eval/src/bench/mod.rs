//! Error against run time: the evaluation of several variants of a model, with time and memory.

pub mod config;
pub mod report;

use std::time::{Duration, Instant};

use burn::tensor::{Device, Tensor};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use snapsnap_base::FileError;
use snapsnap_net::weights::WeightFile;
use snapsnap_ops::host;
use snapsnap_splat::reference::{self, Cutoff, Scene};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render, scene};

use crate::evaluate::model::Model;
use crate::evaluate::person::{People, photograph};
use crate::evaluate::{Contestant, Kind, by_person, evaluate, rendered};
use crate::lpips::Lpips;
use crate::score::Score;
use crate::statistics::{Interval, difference, interval, mean, quantile_of_times};
use crate::variant::Variant;
use crate::{EvalError, Result};

use config::BenchConfig;

/// Largest number of timed readings and of timed renders.
const FEW: usize = 5;
/// Largest α of a splat in the oracle without cut-offs.
const WHOLE: f32 = 0.999_99;

/// Costs and errors of a variant.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Measured {
    /// Name of the variant.
    pub name: String,
    /// The varied property.
    pub knob: Option<String>,
    /// The scene, if the variant belongs to one.
    pub scene: Option<String>,
    /// The omitted work.
    pub omits: Option<String>,
    /// The steps that ran, and the omitted ones with reasons.
    pub plan: Vec<String>,
    /// Name of the device.
    pub device: String,
    /// Number of timed reconstructions.
    pub runs: usize,
    /// Seconds from the photographs on their canvas to the Gaussians, p50.
    pub p50: f64,
    /// Seconds from the photographs on their canvas to the Gaussians, p95.
    pub p95: f64,
    /// Seconds of each module, p50, and of the work before and after a reconstruction.
    pub modules: Vec<(String, f64)>,
    /// Largest memory, in bytes, of a process that does nothing else, before pictures are compared. The memory of a GPU
    /// is not included. `None` if the system does not report it.
    pub memory: Option<u64>,
    /// Seconds to render a view, p50.
    pub render: f64,
    /// Number of Gaussians of the first person.
    pub gaussians: usize,
    /// Protocol `masked`, mean over people and views.
    #[serde(flatten)]
    pub score: Score,
    /// PSNR of each person.
    pub people: Vec<PersonScore>,
    /// The weights of LPIPS, or the reason for their absence.
    pub lpips_weights: String,
    /// Mean distance of the predicted points of front and back from the ground truth, mm.
    pub points_mm: Option<f64>,
    /// Mean distance of the predicted points of the unseen sides from the ground truth, mm.
    pub sides_mm: Option<f64>,
    /// Largest difference of a colour from the f64 oracle with the same cut-offs.
    pub splat_error: f64,
    /// Largest difference of a colour between oracles with and without cut-offs.
    pub cutoff_error: f64,
    /// Failed parts with reasons.
    pub left_out: Vec<String>,
}

/// Score of one person's pictures.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PersonScore {
    /// The person.
    pub name: String,
    /// dB, protocol `masked`, mean over views.
    #[serde(with = "crate::statistics::number")]
    pub psnr: f64,
}

impl Measured {
    /// Seconds from the photographs on their canvas to a picture of another view.
    pub fn time(&self) -> f64 {
        self.p50 + self.render
    }
}

/// Measures one variant in this process. `most_used` returns the largest memory of the process so far, in bytes.
///
/// # Errors
/// [`EvalError`] for data and weights that cannot be used.
pub fn measure(
    config: &BenchConfig,
    (name, variant): (&str, &Variant),
    weights: &WeightFile,
    (device, device_name): (&Device, &str),
    (lpips, lpips_weights): (Option<&Lpips>, &str),
    most_used: &dyn Fn() -> Option<u64>,
) -> Result<Measured> {
    let runs = config.bench.runs;
    let mut eval = config.evaluation(variant);
    let folder = variant.data.as_ref().or(config.data.folders.first());
    let folder = folder.ok_or_else(|| EvalError::new("there is no data set"))?;
    let people = People::open(folder, &eval.data, &eval.views)?;
    let (all, compared) = (people.views(), config.bench.views.min(people.views()));
    eval.views.compared = (0..compared).map(|i| (2 * i + 1) * all / (2 * compared)).collect();
    let nobody = || match eval.data.only.as_slice() {
        [] => EvalError::new(format!("{}: has no people", folder.display())),
        only => EvalError::new(format!("{}: has no person named {}", folder.display(), only.join(", "))),
    };
    let first = people.chosen.first().copied().ok_or_else(nobody)?;

    let (model, loading) = timed(1, || {
        let model = Model::load(weights, device, variant)?;
        device.sync().expect("the device finishes its work");
        Ok(model)
    })?;
    let inputs = people.inputs(&eval.views);
    let read = || people.item(first, &inputs, &model.photographs);
    read()?;
    let (item, reading) = timed(runs.min(FEW), || {
        let item = read()?;
        (0..inputs.len()).for_each(|place| drop(photograph(&item, place, model.side())));
        Ok(item)
    })?;
    for _ in 0..config.bench.warm_up {
        model.reconstruct(&item, &inputs)?;
    }
    let mut reconstructions = Vec::new();
    let (made, _) = timed(runs, || {
        let mut made = model.reconstruct(&item, &inputs)?;
        reconstructions.push((made.time, std::mem::take(&mut made.modules)));
        Ok(made)
    })?;
    let times: Vec<Duration> = reconstructions.iter().map(|(time, _)| *time).collect();
    let mut modules =
        vec![("loading weights".to_owned(), loading), ("reading photographs".to_owned(), reading)];
    for (module, _) in &reconstructions[0].1 {
        let of_all = reconstructions.iter().flat_map(|(_, modules)| modules);
        let times: Vec<Duration> = of_all.filter(|(name, _)| name == module).map(|(_, time)| *time).collect();
        modules.push(((*module).to_owned(), quantile_of_times(&times, 0.5)));
    }
    let memory = most_used();

    let temporary = tempfile::tempdir().map_err(FileError::write(&std::env::temp_dir()))?;
    let ply = temporary.path().join("human.ply");
    let ((), writing) = timed(1, || Ok(scene::write(&made.gaussians, &ply)?))?;
    modules.push(("writing the PLY".into(), writing));
    let side = people.side(&eval.views);
    let camera = item.cameras[eval.views.compared[0]];
    let (_, render) = timed(runs.min(FEW), || rendered(&made.gaussians, &camera, side, &eval.views))?;
    modules.push((format!("rendering a view of {side}²"), render));
    let patch = patch(&made.gaussians, &camera.resized(side as u32, side as u32), config.bench.oracle);
    let (splat_error, cutoff_error) = splat_errors(&made.gaussians, &patch, &eval.views.render_options())?;

    let gaussians = made.gaussians.len();
    let plan = made.steps.iter().map(ToString::to_string).collect();
    let contestant = Contestant::Model(name.into(), Kind::Model, Box::new(model));
    let outcome = evaluate(&eval, std::slice::from_ref(&people), &[contestant], lpips, &|_, _| ());
    let judged = &outcome.judged[0];
    let scores: Vec<Score> = judged.rows.iter().map(|row| row.scores[0]).collect();
    let score = Score::mean(&scores).ok_or_else(|| EvalError::new("no view could be compared"))?;
    let points = |sides: bool| {
        let errors = judged.points.iter().filter(|error| (error.view > 1) == sides);
        mean(&errors.map(|error| 1e3 * error.mean).collect::<Vec<_>>())
    };
    let of_person =
        |(row, score): (usize, Score)| PersonScore { name: outcome.people[row].clone(), psnr: score.psnr };
    Ok(Measured {
        name: name.into(),
        knob: variant.knob.clone(),
        scene: variant.scene.clone(),
        omits: variant.omits.clone(),
        plan,
        device: device_name.into(),
        runs,
        p50: quantile_of_times(&times, 0.5),
        p95: quantile_of_times(&times, 0.95),
        modules,
        memory,
        render,
        gaussians,
        score,
        people: by_person(judged.rows.iter(), 0).into_iter().map(of_person).collect(),
        lpips_weights: lpips_weights.into(),
        points_mm: points(false),
        sides_mm: points(true),
        splat_error,
        cutoff_error,
        left_out: outcome.left_out.iter().map(|l| format!("{}: {}", l.name, l.why)).collect(),
    })
}

/// The result of the last of `count` calls, and the median of their seconds.
fn timed<T>(count: usize, mut call: impl FnMut() -> Result<T>) -> Result<(T, f64)> {
    let (mut times, mut last) = (Vec::new(), None);
    for _ in 0..count {
        let start = Instant::now();
        last = Some(call()?);
        times.push(start.elapsed());
    }
    Ok((last.expect("at least one call"), quantile_of_times(&times, 0.5)))
}

/// A camera for the patch of a picture around the middle of the Gaussians.
fn patch(shown: &Gaussians, camera: &Camera, side: u32) -> Camera {
    let side = side.min(camera.width).min(camera.height);
    let mean = host(shown.means.clone().mean_dim(0));
    let middle = DVec3::new(mean[0].into(), mean[1].into(), mean[2].into());
    let middle = camera.project(middle).map_or(camera.principal_point, |(at, _)| at);
    let most = DVec2::new(f64::from(camera.width - side), f64::from(camera.height - side));
    let corner = (middle - 0.5 * f64::from(side)).round().clamp(DVec2::ZERO, most);
    Camera { width: side, height: side, principal_point: camera.principal_point - corner, ..*camera }
}

/// Largest differences of a colour in a view: between renderer and oracle with the same cut-offs, and between oracles
/// with and without cut-offs. Without cut-offs pixels never close, and splats fade smoothly and may be opaque.
fn splat_errors(gaussians: &Gaussians, camera: &Camera, options: &RenderOptions) -> Result<(f64, f64)> {
    let got = host(render(gaussians, std::slice::from_ref(camera), options)?.color);
    let Gaussians { means, rotations, scales, opacities, colors } = gaussians.clone();
    let rows = host(Tensor::cat(vec![means, rotations, scales, opacities.unsqueeze_dim(1), colors], 1));
    let rows = rows.as_chunks().0.iter().map(|row| row.map(f64::from));
    let scene = Scene { gaussians: rows.collect(), background: [0.0; 3] };
    let hard = reference::render(&scene, camera, options, Cutoff::Hard);
    let whole = RenderOptions { max_alpha: WHOLE, ..options.clone() };
    let smooth = reference::render(&scene, camera, &whole, Cutoff::Smooth);
    let (mut rounding, mut cutoffs) = (0.0_f64, 0.0_f64);
    for ((hard, smooth), got) in hard.iter().zip(&smooth).zip(got.chunks_exact(3)) {
        for ((hard, smooth), got) in hard.iter().zip(smooth).zip(got) {
            rounding = rounding.max((f64::from(*got) - hard).abs());
            cutoffs = cutoffs.max((hard - smooth).abs());
        }
    }
    Ok((rounding, cutoffs))
}

/// Relative difference of times. Smaller differences are noise.
const FASTER: f64 = 0.03;

/// For each variant, the index of the best variant that dominates it: with better pictures (the paired interval over
/// people is above 0) in at most 3 % more time, or with equally good pictures in at least 3 % less time. The time is
/// the sum of a reconstruction and a view. Scenes and different people are not compared.
pub fn dominated(measured: &[Measured]) -> Vec<Option<usize>> {
    let names = |m: &Measured| m.people.iter().map(|person| person.name.clone()).collect::<Vec<_>>();
    let is_alike =
        |a: &Measured, b: &Measured| a.scene.is_none() && b.scene.is_none() && names(a) == names(b);
    let beats = |a: &Measured, b: &Measured| {
        let pairs = a.people.iter().zip(&b.people);
        let differences: Vec<f64> = pairs.map(|(a, b)| difference(a.psnr, b.psnr)).collect();
        let Some(Interval { mean, low, .. }) = interval(&differences) else { return false };
        let time = a.time() / b.time();
        low > 0.0 && time < 1.0 + FASTER || mean >= 0.0 && time < 1.0 - FASTER
    };
    let by = |b: &Measured| {
        let better = measured.iter().enumerate().filter(|(_, a)| is_alike(a, b) && beats(a, b));
        better.max_by(|a, b| a.1.score.psnr.total_cmp(&b.1.score.psnr)).map(|(place, _)| place)
    };
    measured.iter().map(by).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A variant that reconstructs in `p50` seconds and renders in one, with the PSNR of two people that differ by 2
    /// dB.
    fn measured(p50: f64, psnr: f64) -> Measured {
        let person = |name: &str, psnr| PersonScore { name: name.into(), psnr };
        let people = vec![person("a", psnr), person("b", psnr + 2.0)];
        let score = Score { psnr: psnr + 1.0, ..Score::default() };
        Measured { p50, render: 1.0, score, people, ..Measured::default() }
    }

    #[test]
    fn slower_and_no_better_variants_are_dominated_by_the_best_better_one() {
        let all = [(10.0, 20.0), (20.0, 19.0), (5.0, 19.5), (30.0, 21.0), (10.2, 20.0)];
        let mut all = all.map(|(p50, psnr)| measured(p50, psnr));
        // The difference from the last variant's time is noise.
        assert_eq!(dominated(&all), [None, Some(4), None, None, None]);
        // Better for one person and worse for the other: better in the mean, but not clearly.
        all[4].people[0].psnr -= 1.0;
        all[4].people[1].psnr += 1.5;
        assert_eq!(dominated(&all), [None, Some(4), None, None, None]);
        // Time to render counts.
        all[4].render = 20.0;
        assert_eq!(dominated(&all), [None, Some(0), None, None, None]);
        all[4].render = 1.0;
        // Scenes and different people are not compared.
        let others: [fn(&mut Measured); 2] =
            [|m| m.scene = Some("another".into()), |m| m.people[1].name.push('c')];
        for other in others {
            let mut all = all.clone();
            [0, 4].into_iter().for_each(|place| other(&mut all[place]));
            assert_eq!(dominated(&all)[1], Some(2));
        }
    }

    #[test]
    fn equal_pictures_travel_between_processes() {
        let text = serde_json::to_string(&measured(1.0, f64::INFINITY)).expect("JSON");
        let back: Measured = serde_json::from_str(&text).expect("the same");
        assert!(back.score.psnr == f64::INFINITY && back.people[0].psnr == f64::INFINITY, "{text}");
    }
}
