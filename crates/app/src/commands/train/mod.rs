//! `snapsnap train-stage1` and `snapsnap train-stage2`.

mod folder;
mod report;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use clap::Args;
use snapsnap_base::config::Schema;
use snapsnap_base::file;
use snapsnap_data::dataset::Folder;
use snapsnap_net::weights::schema::{self, DETAILS, Part};
use snapsnap_net::weights::{WeightFile, random_predictor, random_regressors};
use snapsnap_train::config::TrainConfig;
use snapsnap_train::networks::Networks;
use snapsnap_train::ranks::Ranks;
use snapsnap_train::run::{self, BEST, CONFIG, LAST, Options, Outcome, STATE};
use snapsnap_train::stage1::PointTask;
use snapsnap_train::stage2::GaussianTask;
use snapsnap_train::task::Task;

use super::evaluate::check_data;
use crate::batch::unpanicked;
use crate::failure::{Failure, bail};
use crate::report::quoted;
use crate::{device, interrupt, memory, say};

use folder::RunFolder;
use report::Reporter;

#[derive(Args)]
pub struct Arguments {
    /// Networks, data and steps, as in configs/*/stage1.toml and stage2.toml [default with --resume: the run's config].
    #[arg(long, value_name = "TOML", required_unless_present = "resume")]
    config: Option<PathBuf>,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Data sets; their people are mixed [default: data.folders of the config].
    #[arg(long, value_name = "DATASET", num_args = 1..)]
    data: Vec<PathBuf>,
    /// Folder of the run: its config, weights, state, logs and previews.
    #[arg(short, long, value_name = "RUN", required_unless_present = "dry_run")]
    output: Option<PathBuf>,
    /// Weight file to begin with [default: training.weights of the config; stage 1: random weights].
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Time limit of this session in minutes. --resume continues the run.
    #[arg(long, value_name = "M")]
    minutes: Option<f64>,
    /// Continue the run in this folder, or begin it.
    #[arg(long)]
    resume: bool,
    /// With --resume: continue the run even if settings, data sets or the frozen predictor have changed since its last
    /// state.
    #[arg(long, requires = "resume")]
    force: bool,
    /// Check config and data, make a few steps without writing anything, and print how long the run will take.
    #[arg(long)]
    dry_run: bool,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter. Several ranks of MPI on one
    /// machine take the adapters in turn.
    #[arg(long, default_value = "auto")]
    device: String,
}

/// Exit code of a session that a signal ended early: EX_TEMPFAIL of sysexits.h. --resume continues the run.
const UNFINISHED: u8 = 75;

/// Delay of another rank's failure after the first rank's.
const LATER: Duration = Duration::from_secs(2);

/// A training with its data and its device.
struct Plan<'a> {
    arguments: &'a Arguments,
    config: TrainConfig,
    folders: Vec<Arc<Folder>>,
    /// The device with automatic differentiation.
    device: Device,
    ranks: &'a Ranks,
    /// The folder of the run that is continued, with its config.
    begun: Option<(&'a Path, TrainConfig)>,
}

/// Runs `stage` as one of the ranks of MPI, if a launcher started several. The failure of one rank ends all ranks.
pub fn among_ranks(
    arguments: &Arguments,
    stage: fn(&Arguments, &Ranks) -> Result<u8, Failure>,
) -> Result<u8, Failure> {
    let ranks = Ranks::join().map_err(Failure::Input)?;
    if ranks.size == 1 {
        return stage(arguments, &ranks);
    }
    if !ranks.is_first() {
        say::set_quiet(true);
    }
    // A panic must end the others as well, which would wait for this rank.
    let failure = match unpanicked(|| stage(arguments, &ranks)) {
        Ok(code) => return Ok(code),
        Err(failure) => failure,
    };
    // A failure of all ranks is printed once, since the first rank ends the others meanwhile.
    if !ranks.is_first() {
        thread::sleep(LATER);
    }
    let message = failure.to_string();
    let is_named = message.starts_with("rank ");
    let whose = if is_named { String::new() } else { format!("rank {} on {}: ", ranks.rank, ranks.host) };
    say::err(&format!("error: {whose}{message}"));
    file::remove_unfinished();
    ranks.abort(failure.code());
    Err(failure)
}

pub fn stage1(arguments: &Arguments, ranks: &Ranks) -> Result<u8, Failure> {
    let mut plan = Plan::new(arguments, ranks)?;
    plan.keep_start();
    if plan.config.stage1.only_details && plan.begun.is_none() && plan.config.training.weights.is_none() {
        bail!("`stage1.only_details` needs a trained point predictor: give --weights FILE");
    }
    let task = PointTask::new(&plan.folders, &plan.config, &plan.device)?;
    plan.check_validation(task.data().count);
    plan.run(&task, |tracked| {
        let networks = plan.config.networks();
        // The state of a continued run contains its weights.
        let start = plan.config.training.weights.as_deref();
        let predictor = match start.filter(|_| plan.begun.is_none()) {
            Some(path) => open(path, &plan.config, &[Part::PointPredictor])?.point_predictor(tracked)?,
            None => random_predictor(&networks, plan.config.training.seed, tracked),
        };
        let networks = Networks { predictor: Some(predictor), regressors: Vec::new() };
        Ok(if plan.config.stage1.only_details { networks.with_trained(DETAILS) } else { networks })
    })
}

pub fn stage2(arguments: &Arguments, ranks: &Ranks) -> Result<u8, Failure> {
    let mut plan = Plan::new(arguments, ranks)?;
    let joint = plan.config.stage2.points_weight > 0.0;
    if joint {
        plan.keep_start();
    }
    // The latest weights of a continued run contain its frozen predictor; before the first checkpoint there are none.
    // A predictor of the command line is compared with the predictor of the run's state.
    let begun = plan.begun.as_ref().filter(|_| arguments.weights.is_none());
    let latest = begun.map(|(run, _)| run.join(LAST)).filter(|latest| latest.exists());
    let weights = match latest.or_else(|| plan.config.training.weights.clone()) {
        // The state of a continued joint run contains both networks.
        _ if joint && plan.begun.is_some() => None,
        Some(start) => Some(open(&start, &plan.config, &[Part::PointPredictor, Part::Regressor])?),
        None => bail!(
            "stage 2 needs a trained point predictor: give --weights FILE, as train-stage1 writes it, or \
             training.weights in the config"
        ),
    };
    let frozen = weights.as_ref().filter(|_| !joint);
    let frozen = frozen.map(|weights| weights.point_predictor(&plan.device.clone().inner())).transpose()?;
    let task = GaussianTask::new(&plan.folders, &plan.config, frozen, &plan.device)?;
    plan.check_validation(task.data().count);
    plan.run(&task, |tracked| {
        let (networks, seed) = (plan.config.networks(), plan.config.training.seed);
        let regressors = match weights.as_ref().filter(|weights| weights.require(Part::Regressor).is_ok()) {
            Some(weights) => weights.regressors(tracked)?,
            None => random_regressors(&networks, seed, tracked),
        };
        let predictor = joint.then(|| match &weights {
            Some(weights) => weights.point_predictor(tracked),
            None => Ok(random_predictor(&networks, seed, tracked)),
        });
        Ok(Networks { predictor: predictor.transpose()?, regressors })
    })
}

/// Opens the weights to begin with. They must fit the config, and the used parts must have been trained for it.
fn open(path: &Path, config: &TrainConfig, used: &[Part]) -> Result<WeightFile, Failure> {
    let weights = WeightFile::open(path, Some(config.networks()))?;
    used.iter().try_for_each(|part| weights.require_meaning(*part))?;
    Ok(weights)
}

impl<'a> Plan<'a> {
    fn new(arguments: &'a Arguments, ranks: &'a Ranks) -> Result<Self, Failure> {
        if let Some(minutes) = arguments.minutes.filter(|minutes| !(*minutes > 0.0 && *minutes <= 1e6)) {
            bail!("--minutes {minutes}: must be more than 0 and at most a million");
        }
        let config = folder::config(arguments)?;
        check_data(&config.data.folders)?;
        let folders = config.data.folders.iter().map(|path| Folder::open(path).map(Arc::new));
        let folders = folders.collect::<Result<_, _>>()?;
        let device = if ranks.size == 1 {
            device::choose(&arguments.device)?
        } else {
            device::choose_in_turn(&arguments.device, ranks.local)?
        };
        if ranks.size > config.training.batch {
            let (count, batch) = (ranks.size, config.training.batch);
            bail!("`training.batch` is {batch}, must be at least {count}, the number of ranks");
        }
        // Ranks on one machine share its memory.
        let hosts = ranks.gather(&ranks.host);
        if memory::is_cpu(&device) {
            let neighbours = hosts.iter().filter(|host| **host == ranks.host).count() as u64;
            let needed = neighbours * least_memory(&config, ranks.size);
            memory::check("this training", needed, "a smaller network or training.batch needs less")?;
        }
        // The first rank is about to write a state, which later ranks would find.
        let output = arguments.output.as_deref();
        let is_begun = arguments.resume && output.is_some_and(|run| run.join(STATE).exists());
        let begun = output.filter(|_| ranks.gather(&is_begun)[0]);
        let begun = begun.map(|run| Ok::<_, Failure>((run, TrainConfig::from_file(&run.join(CONFIG), &[])?)));
        let begun = begun.transpose()?;
        let precision = config.training.precision;
        if !device.supports_dtype(precision.dtype()) {
            let (name, precision) = (&arguments.device, precision.name());
            bail!("--device {name}: does not compute in {precision}: set training.precision to f32");
        }
        let device = device.autodiff();
        Ok(Self { arguments, config, folders, device, ranks, begun })
    }

    /// A continued run with all networks in its state does not read --weights. Its config keeps the weights of its
    /// start.
    fn keep_start(&mut self) {
        let Some((_, there)) = &self.begun else { return };
        let own = &mut self.config.training.weights;
        if self.arguments.weights.is_some() && *own != there.training.weights {
            say::note("note: --weights is not read: the run goes on from its own state");
        }
        own.clone_from(&there.training.weights);
    }

    fn check_validation(&self, samples: usize) {
        if samples == 0 && self.config.training.validation_samples > 0 {
            say::note(
                "note: no data set has held-out people (split val) for validations: only the latest weights are kept",
            );
        }
    }

    /// A rehearsal, or a session in the run's folder.
    fn run<T: Task>(
        &self,
        task: &T,
        networks: impl Fn(&Device) -> Result<Networks, Failure> + Sync,
    ) -> Result<u8, Failure> {
        let (tracked, ranks) = (&self.device, self.ranks);
        if self.arguments.dry_run {
            return run::on_best_thread(tracked, || {
                let rehearsal = run::rehearse(task, &self.config, networks(tracked)?, tracked, ranks)?;
                if ranks.is_first() {
                    report::rehearsed(&self.config, tracked, rehearsal);
                }
                Ok(0)
            });
        }
        let path = self.arguments.output.as_deref().expect("required by clap");
        let open = || RunFolder::open(path, self.arguments, &self.config, &self.folders);
        let _folder = ranks.is_first().then(open).transpose()?;
        let limit = self.arguments.minutes.map(|minutes| Duration::from_secs_f64(60.0 * minutes));
        let stop = interrupt::patiently();
        let options =
            Options { folder: path, device: tracked, ranks, limit, stop, force: self.arguments.force };
        let mut reporter = Reporter::new(&self.config, limit);
        let start = Instant::now();
        let outcome = run::on_best_thread(tracked, || {
            let trained = run::train(task, &self.config, networks(tracked)?, &options, &mut reporter);
            // With several ranks a full disk is a failure of the job.
            trained.map_err(|e| match e.into() {
                Failure::Write(message) if ranks.size > 1 => Failure::Internal(message),
                failure => failure,
            })
        })?;
        drop(reporter);
        self.summarise(T::STAGE, path, &outcome, start.elapsed());
        let is_cut = !outcome.finished && ranks.gather(&interrupt::was_terminated()).contains(&true);
        Ok(if is_cut { UNFINISHED } else { 0 })
    }

    /// Prints the outcome of a session and the next commands.
    fn summarise(&self, stage: u32, folder: &Path, outcome: &Outcome, session: Duration) {
        let run = folder.display();
        let state = if outcome.finished { "finished" } else { "interrupted" };
        let [total, session] = [outcome.seconds, session.as_secs_f64()].map(|seconds| seconds / 60.0);
        let step = outcome.step;
        say::info(&format!(
            "{run}: {state} after {step} steps, {total:.1} minutes of training, {session:.1} of them in this session"
        ));
        if outcome.skipped > 0 {
            say::info(&format!("{} steps were skipped", outcome.skipped));
        }
        let weights = match outcome.best {
            Some((step, score)) => {
                let score = match stage {
                    1 => format!("{score:.2} mm from the true points"),
                    _ => format!("{:.2} dB PSNR of the person", -score),
                };
                say::info(&format!("best validation: {score} after step {step}, {run}/{BEST}"));
                BEST
            }
            None => LAST,
        };
        let run = quoted(folder);
        say::info(&format!("curves: {run}/curves.svg; TensorBoard: tensorboard --logdir {run}"));
        if !outcome.finished {
            say::info(&format!("resume:  snapsnap train-stage{stage} --resume -o {run}"));
        }
        let weights = quoted(&folder.join(weights));
        let next = match stage {
            1 if self.config.stage1.only_details => {
                format!(
                    "import-weights --fill {weights} puts `details.*` beside other layers (docs/training.md)"
                )
            }
            1 => format!("a training of stage 2, which begins with --weights {weights} (docs/training.md)"),
            _ => format!(
                "snapsnap reconstruct FRONT BACK --weights {weights} -o human.ply --turntable turn.png"
            ),
        };
        say::info(&format!("next:    {next}"));
    }
}

/// Lower bound of the memory in bytes of one of several ranks of a training: weights, gradients, two moments and
/// averages, samples, and the last layers of the heads. --dry-run measures the actual memory.
fn least_memory(config: &TrainConfig, ranks: usize) -> u64 {
    let (n, batch) = (&config.network, config.training.batch.div_ceil(ranks) as u64);
    let parameters =
        schema::tensors(&config.networks()).into_iter().filter(|tensor| tensor.part == Part::PointPredictor);
    // Frozen layers have no gradients and moments.
    let is_trained = |name: &str| !config.stage1.only_details || name.starts_with(DETAILS);
    let parameters: usize =
        parameters.map(|tensor| tensor.elements() * if is_trained(&tensor.name) { 5 } else { 2 }).sum();
    // Two photographs with masks and four point maps with masks, each as loaded and as used.
    let sample = 2 * (2 * 4 + 4 * 4) * n.resolution.pow(2) as u64;
    // A window may be as small as a tenth of the canvas.
    let share = if n.window { 10 } else { 1 };
    let heads = 4 * (2 * n.last_dim + n.feature_dim) as u64 * n.net_resolution.pow(2) as u64 / share;
    4 * (parameters as u64 + batch * (sample + heads))
}
