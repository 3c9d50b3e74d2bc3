//! Error against run time: the same people, reconstructed in different settings.

pub mod config;
mod oracle;
pub mod report;
mod tune;

use snapsnap_data::sample::Handling;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use snapsnap_base::FileError;
use snapsnap_net::weights::WeightFile;
use snapsnap_splat::{Camera, Gaussians, scene};

use crate::EvalError;
use crate::evaluate::config::{DataSection, EvalConfig, Protocol};
use crate::evaluate::model::{Leave, Model};
use crate::evaluate::person::{People, photograph};
use crate::evaluate::{Contestant, evaluate, rendered};
use crate::lpips::Lpips;
use crate::score::Score;
use crate::statistics::{Interval, difference, interval, quantile};

use config::{BenchConfig, Setting};

/// What a setting costs and how far off its result is.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Measured {
    /// Of the setting.
    pub name: String,
    /// What it turns.
    pub knob: Option<String>,
    /// The scene that it belongs to, if it is about one.
    pub scene: Option<String>,
    /// What is left out.
    pub omits: Option<String>,
    /// What ran, what was left out and why, in its own words.
    pub plan: Vec<String>,
    /// Seconds of a step of fitting the Gaussians to the photographs, p50.
    pub tuning: Option<f64>,
    /// In words.
    pub device: String,
    /// Reconstructions that were timed.
    pub runs: usize,
    /// Seconds from the photographs on their canvas to the Gaussians.
    pub p50: f64,
    /// The same.
    pub p95: f64,
    /// Seconds of each module, p50; those outside a reconstruction as well.
    pub modules: Vec<(String, f64)>,
    /// Bytes of memory of a process that does nothing else, at most, without comparing pictures; `None` where the system does
    /// not tell. A card's memory is not in it.
    pub memory: Option<u64>,
    /// Seconds to render a view, p50.
    pub render: f64,
    /// Gaussians of the first person.
    pub gaussians: usize,
    /// dB, protocol `masked`, mean over people and views.
    #[serde(with = "crate::statistics::number")]
    pub psnr: f64,
    /// The same of each person.
    pub people: Vec<PersonScore>,
    /// The same.
    pub ssim: Option<f64>,
    /// The same.
    pub lpips: Option<f64>,
    /// What it was computed with, or why there is none.
    pub lpips_weights: String,
    /// Mean distance of the predicted points from the true ones, mm: front and back.
    pub points_mm: Option<f64>,
    /// The same of the sides.
    pub sides_mm: Option<f64>,
    /// Largest difference of a colour from the f64 oracle with the same cut-offs.
    pub splat_error: f64,
    /// Largest difference that the cut-offs make, between oracles with and without.
    pub cutoff_error: f64,
    /// What could not be compared.
    pub left_out: Vec<String>,
}

/// What one person's pictures gave.
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

/// Measures one setting in this process; `most_used` tells how much memory it took so far.
///
/// # Errors
/// [`EvalError`] for data and weights that cannot be used.
pub fn measure(
    config: &BenchConfig,
    name: &str,
    setting: &Setting,
    weights: &WeightFile,
    (device, device_name): (&Device, &str),
    (lpips, lpips_weights): (Option<&Lpips>, &str),
    most_used: &dyn Fn() -> Option<u64>,
) -> Result<Measured, EvalError> {
    let mut data = DataSection { subjects: config.bench.people, ..config.data.clone() };
    if let Some(only) = &setting.only {
        data.only.clone_from(only);
    }
    // What is fitted is the first person's.
    if setting.tune.is_some() {
        data.subjects = 1;
    }
    let folder = setting.data.as_ref().or(config.data.folders.first());
    let folder = folder.ok_or_else(|| EvalError::Empty("there is no data set".into()))?;
    let mut eval = EvalConfig { data, ..EvalConfig::default() };
    eval.views.inputs = setting.inputs.clone().unwrap_or_default();
    eval.views.resolution = config.bench.resolution;
    eval.views.supersampling = setting.supersampling.unwrap_or(2);
    eval.views.preset = setting.preset.unwrap_or_default();
    eval.views.antialiased = setting.antialiased.unwrap_or(false);
    eval.metrics.protocols = vec![Protocol::Masked];
    eval.metrics.geometry = false;
    let people = People::open(folder, &eval.data, &eval.views)?;
    let count = people.views();
    eval.views.compared = (0..config.bench.views.min(count))
        .map(|i| (2 * i + 1) * count / (2 * config.bench.views.min(count)))
        .collect();

    let mut modules: Vec<(String, f64)> = Vec::new();
    let start = Instant::now();
    let leave = Leave {
        // Scenes of more than two photographs have no unseen sides.
        sides: setting.sides.unwrap_or(eval.views.inputs.len() <= 2),
        side_colors: setting.side_colors.unwrap_or(true),
        stride: setting.stride.unwrap_or(1),
        min_opacity: setting.min_opacity.unwrap_or(0.0),
        precision: setting.precision.unwrap_or_default(),
    };
    let model = Model::load(weights, device, leave)?;
    device.sync().expect("the device finishes its work");
    modules.push(("loading weights".into(), start.elapsed().as_secs_f64()));

    let nobody = || match eval.data.only.as_slice() {
        [] => EvalError::Empty(format!("{}: there is nobody", folder.display())),
        only => EvalError::Empty(format!("{}: has nobody called {}", folder.display(), only.join(", "))),
    };
    let first = people.chosen().first().copied().ok_or_else(nobody)?;
    let inputs = people.inputs(&eval.views, 0);
    let mut readings = Vec::new();
    let mut item = people.item(first, &inputs, &Handling::default())?;
    for _ in 0..config.bench.runs.min(5) {
        let start = Instant::now();
        item = people.item(first, &inputs, &Handling::default())?;
        let canvases: Vec<_> =
            (0..inputs.len()).map(|place| photograph(&item, place, model.side())).collect();
        readings.push(start.elapsed());
        drop(canvases);
    }
    modules.push(("reading photographs".into(), p(&readings, 0.5)));

    for _ in 0..config.bench.warm_up {
        drop(model.reconstruct(&item, &inputs));
    }
    let (mut times, mut parts) = (Vec::new(), Vec::<(&'static str, Vec<Duration>)>::new());
    let mut made = None;
    for _ in 0..config.bench.runs {
        let run = model.reconstruct(&item, &inputs);
        times.push(run.time);
        // Several pairs of photographs go through each module one after another.
        let mut seen: Vec<&str> = Vec::new();
        for (name, time) in &run.modules {
            let again = seen.contains(name);
            seen.push(name);
            match parts.iter_mut().find(|(there, _)| there == name) {
                Some((_, times)) if again => *times.last_mut().expect("of this run") += *time,
                Some((_, times)) => times.push(*time),
                None => parts.push((name, vec![*time])),
            }
        }
        made = Some(run);
    }
    let mut made = made.expect("at least one run");
    modules.extend(parts.iter().map(|(name, times)| ((*name).to_owned(), p(times, 0.5))));
    if made.gaussians.is_empty() {
        return Err(EvalError::Empty("no Gaussian came out".into()));
    }
    let mut tuning = None;
    if let Some(what) = setting.tune {
        let steps = tune::STEPS.min(20 * config.bench.runs);
        let (tuned, times) = tune::fit(&made.gaussians, &people, (first, &inputs, &item), what, steps)?;
        made.gaussians = tuned;
        tuning = Some(p(&times, 0.5));
    }
    let memory = most_used();
    let temporary = tempfile::tempdir().map_err(FileError::write(&std::env::temp_dir()))?;
    let start = Instant::now();
    scene::write(&made.gaussians, &temporary.path().join("human.ply"))?;
    modules.push(("writing the PLY".into(), start.elapsed().as_secs_f64()));
    let side = people.side(&eval.views);
    let camera = item.cameras[eval.views.compared[0]];
    let mut renders = Vec::new();
    for _ in 0..config.bench.runs.min(5) {
        let start = Instant::now();
        drop(rendered(&made.gaussians, &camera, side, &eval.views)?);
        renders.push(start.elapsed());
    }
    let render = p(&renders, 0.5);
    modules.push((format!("rendering a view of {side}²"), render));

    let options = eval.views.render_options();
    let patch = patch(&made.gaussians, &camera.resized(side as u32, side as u32), config.bench.oracle);
    let (splat_error, cutoff_error) = oracle::errors(&made.gaussians, &patch, &options)?;
    let (gaussians, plan) = (made.gaussians.len(), made.plan);
    let contestants = match setting.tune {
        Some(_) => [Contestant::fixed(name, made.gaussians)],
        None => [Contestant::model(name, model)],
    };
    let outcome = evaluate(&eval, std::slice::from_ref(&people), &contestants, lpips, &|_, _| ());
    let judged = &outcome.judged[0];
    let scores: Vec<Score> = judged.rows.iter().map(|row| row.scores[0]).collect();
    let Score { psnr, ssim, lpips } =
        Score::mean(&scores).ok_or_else(|| EvalError::Empty("no view could be compared".into()))?;
    let points = |sides: bool| {
        let errors = judged.points.iter().flat_map(|(_, errors)| errors);
        let errors: Vec<f64> =
            errors.filter(|error| (error.view > 1) == sides).map(|error| 1e3 * error.mean).collect();
        (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64)
    };
    let of_person = |(row, name): (usize, &String)| {
        let rows = judged.rows.iter().filter(|r| r.person == row);
        let scores: Vec<Score> = rows.map(|r| r.scores[0]).collect();
        Some(PersonScore { name: name.clone(), psnr: Score::mean(&scores)?.psnr })
    };
    let left_out = outcome.left_out.iter().map(|l| format!("{}: {}", l.name, l.why)).collect();
    Ok(Measured {
        name: name.into(),
        knob: setting.knob.clone(),
        scene: setting.scene.clone(),
        omits: setting.omits.clone(),
        plan,
        tuning,
        device: device_name.into(),
        runs: config.bench.runs,
        p50: p(&times, 0.5),
        p95: p(&times, 0.95),
        modules,
        memory,
        render,
        gaussians,
        psnr,
        people: outcome.people.iter().enumerate().filter_map(of_person).collect(),
        ssim,
        lpips,
        lpips_weights: lpips_weights.into(),
        points_mm: points(false),
        sides_mm: points(true),
        splat_error,
        cutoff_error,
        left_out,
    })
}

/// A quantile of times, seconds.
fn p(times: &[Duration], share: f64) -> f64 {
    let mut seconds: Vec<f64> = times.iter().map(Duration::as_secs_f64).collect();
    seconds.sort_by(f64::total_cmp);
    quantile(&seconds, share)
}

/// The part of a picture around the middle of what it shows, as a camera of its own.
fn patch(shown: &Gaussians, camera: &Camera, side: u32) -> Camera {
    let side = side.min(camera.width).min(camera.height);
    let mean = snapsnap_ops::host(shown.means.clone().mean_dim(0));
    let middle = DVec3::new(mean[0].into(), mean[1].into(), mean[2].into());
    let middle = camera.project(middle).map_or(camera.principal_point, |(at, _)| at);
    let most = DVec2::new(f64::from(camera.width - side), f64::from(camera.height - side));
    let corner = (middle - 0.5 * f64::from(side)).round().clamp(DVec2::ZERO, most);
    Camera { width: side, height: side, principal_point: camera.principal_point - corner, ..*camera }
}

/// Share of time below which a difference is noise.
const FASTER: f64 = 0.03;

/// Which settings others beat: clearly better pictures (the paired interval over people is above 0) in no more time, or as good
/// ones in clearly less time. Time is that of a reconstruction and a view. By place, the place of the best of those that beat
/// it. Scenes, tuned Gaussians and other people are not compared.
pub fn dominated(measured: &[Measured]) -> Vec<Option<usize>> {
    let names = |m: &Measured| m.people.iter().map(|person| person.name.clone()).collect::<Vec<_>>();
    let is_alike = |a: &Measured, b: &Measured| {
        [a, b].iter().all(|m| m.scene.is_none() && m.tuning.is_none()) && names(a) == names(b)
    };
    let beats = |a: &Measured, b: &Measured| {
        let pairs = a.people.iter().zip(&b.people);
        let differences: Vec<f64> = pairs.map(|(a, b)| difference(a.psnr, b.psnr)).collect();
        let Some(Interval { mean, low, .. }) = interval(&differences) else { return false };
        let time = a.time() / b.time();
        low > 0.0 && time < 1.0 + FASTER || mean >= 0.0 && time < 1.0 - FASTER
    };
    let by = |b: &Measured| {
        let better = measured.iter().enumerate().filter(|(_, a)| is_alike(a, b) && beats(a, b));
        better.max_by(|a, b| a.1.psnr.total_cmp(&b.1.psnr)).map(|(place, _)| place)
    };
    measured.iter().map(by).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reconstructs in that time and renders in a second; a person's PSNR and that of another, who is 2 dB better.
    fn measured(p50: f64, psnr: f64) -> Measured {
        let person = |name: &str, psnr| PersonScore { name: name.into(), psnr };
        Measured {
            name: String::new(),
            knob: None,
            scene: None,
            omits: None,
            plan: Vec::new(),
            tuning: None,
            device: String::new(),
            runs: 1,
            p50,
            p95: p50,
            modules: Vec::new(),
            memory: None,
            render: 1.0,
            gaussians: 0,
            psnr: psnr + 1.0,
            people: vec![person("a", psnr), person("b", psnr + 2.0)],
            ssim: None,
            lpips: None,
            lpips_weights: String::new(),
            points_mm: None,
            sides_mm: None,
            splat_error: 0.0,
            cutoff_error: 0.0,
            left_out: Vec::new(),
        }
    }

    #[test]
    fn what_is_slower_and_no_better_is_dominated_by_the_best_of_its_betters() {
        let all = [(10.0, 20.0), (20.0, 19.0), (5.0, 19.5), (30.0, 21.0), (10.2, 20.0)];
        let mut all = all.map(|(p50, psnr)| measured(p50, psnr));
        // The last one is slower by less than noise.
        assert_eq!(dominated(&all), [None, Some(4), None, None, None]);
        // Better of one person, worse of the other: not clearly better, though in the mean.
        all[4].people[0].psnr -= 1.0;
        all[4].people[1].psnr += 1.5;
        assert_eq!(dominated(&all), [None, Some(4), None, None, None]);
        // What renders slowly is slow.
        all[4].render = 20.0;
        assert_eq!(dominated(&all), [None, Some(0), None, None, None]);
        all[4].render = 1.0;
        // Scenes, fitted Gaussians and other people are not compared.
        let others: [fn(&mut Measured); 3] =
            [|m| m.scene = Some("another".into()), |m| m.tuning = Some(1.0), |m| m.people[1].name.push('c')];
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
        assert!(back.psnr == f64::INFINITY && back.people[0].psnr == f64::INFINITY, "{text}");
    }
}
