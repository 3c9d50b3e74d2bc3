//! snapsnap turns two photographs of a person into 3D Gaussians. This crate is its command line, as a library for the
//! program and for the Python package.
//!
//! The other crates are libraries: [`snapsnap_net::Reconstructor`] turns photographs into Gaussians,
//! [`snapsnap_splat::render`] is the differentiable renderer, and [`snapsnap_train::points`] has the losses of
//! stage 1. Examples of each: `cargo run --release --example reconstruct`, `fit_gaussians` or `train_predictor`.
// The page is part of the documentation only. A change of it does not rebuild the program.
#![cfg_attr(doc, doc = "\n", doc = include_str!("../../../docs/architecture.md"))]

mod arguments;
mod batch;
mod commands;
pub mod device;
mod downloads;
mod dump;
mod failure;
mod guests;
mod interrupt;
mod memory;
mod model;
mod output;
mod page;
mod perceptual;
mod pictures;
mod progress;
mod report;
mod say;
mod server;
mod turntable;
mod view_folder;
mod weights;

use std::ffi::OsString;
use std::path::PathBuf;

use clap::{CommandFactory, Parser, Subcommand};
use commands::train;
use failure::bail;

pub use commands::convert::drawable;
pub use failure::Failure;
pub use model::{CameraArguments, ModelArguments, check_memory};

/// Every operation allocates and frees large tensors. mimalloc keeps their pages, while the system allocator returns
/// them to the kernel and causes page faults.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Keeps free pages for ten seconds instead of ten milliseconds. A training step needs them again, and the system
/// would clear them first.
fn keep_pages() {
    /// `mi_option_purge_delay` of mimalloc 2 and 3.
    const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;
    // SAFETY: the function only sets a number.
    #[allow(unsafe_code, reason = "a function of C")]
    unsafe {
        libmimalloc_sys::mi_option_set(PURGE_DELAY, 10_000);
    }
}

/// Keeps compiled kernels of Vulkan in the user's cache, from one process to the next. Each version of the program has
/// its own cache, since CubeCL identifies kernels by name.
#[cfg(feature = "vulkan")]
fn keep_kernels() {
    use cubecl::config::{CubeClRuntimeConfig, RuntimeConfig};
    let mut config = CubeClRuntimeConfig::from_current_dir().override_from_env();
    config.compilation.cache = true;
    if config.environment.name == cubecl::environment::DEFAULT {
        config.environment.name =
            concat!("snapsnap-", env!("CARGO_PKG_VERSION"), "-", env!("SNAPSNAP_COMMIT")).into();
    }
    CubeClRuntimeConfig::try_set(config);
}

/// First steps for new users.
const FIRST_STEPS: &str = "First steps:
  snapsnap demo                                            the sample pair: Gaussians, turntable, report
  snapsnap reconstruct front.png back.png -o human.ply     your own photographs
  snapsnap view human.ply --open                           look at the result
  snapsnap studio --open                                   all of it in the browser";

#[derive(Parser)]
#[command(
    name = "snapsnap",
    version = env!("SNAPSNAP_VERSION"),
    about = "Two photographs of a person become a 3D Gaussian human.",
    after_help = FIRST_STEPS
)]
struct Arguments {
    /// No progress, only errors.
    #[arg(long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Gaussians, pictures and a report of the program's sample pair.
    #[command(after_help = "Example: snapsnap demo")]
    Demo(commands::demo::Arguments),
    /// Turn a front and a back photograph into Gaussians.
    #[command(
        after_help = "Example: snapsnap reconstruct front.jpg back.jpg -o human.ply --turntable turn.gif -v"
    )]
    Reconstruct(Box<commands::reconstruct::Arguments>),
    /// Render a file of Gaussians into pictures.
    #[command(after_help = "Example: snapsnap render human.ply --orbit 12 --size 1024x1024 -o renders")]
    Render(commands::render::Arguments),
    /// Reconstruct people from photographs in the browser: remove backgrounds, correct masks, view and download.
    #[command(after_help = "Example: snapsnap studio --open")]
    Studio(commands::studio::Arguments),
    /// Show a file of Gaussians in the browser.
    #[command(after_help = "Example: snapsnap view human.ply --open")]
    View(commands::view::Arguments),
    /// Make one closed surface of Gaussians: a mesh for modelling programs and game engines.
    #[command(after_help = "Example: snapsnap mesh human.ply -o human.glb")]
    Mesh(commands::mesh::Arguments),
    /// Give a person a skeleton: a mesh that moves, or the person in another pose.
    #[command(after_help = "Example: snapsnap rig human.ply -o human.glb --motion walk")]
    Rig(commands::rig::Arguments),
    /// Turn a file of Gaussians into another kind: PLY, SPZ, which is an eighth as large, GLB or SOG.
    #[command(after_help = "Example: snapsnap convert human.ply human.spz")]
    Convert(commands::convert::Arguments),
    /// Make or check a data set of people to train on.
    #[command(
        subcommand,
        after_help = "Example: snapsnap prepare synth --subjects 300 --seed 1 --config configs/data/small.toml -o people/synth"
    )]
    Prepare(commands::prepare::Kind),
    /// Train the point predictor.
    #[command(
        name = "train-stage1",
        after_help = "Example: snapsnap train-stage1 --config configs/tiny/stage1.toml --data people/synth -o runs/points"
    )]
    TrainStage1(train::Arguments),
    /// Train the Gaussian regressor on the output of a trained point predictor.
    #[command(
        name = "train-stage2",
        after_help = "Example: snapsnap train-stage2 --config configs/tiny/stage2.toml --data people/synth --weights runs/points/best.safetensors -o runs/human"
    )]
    TrainStage2(train::Arguments),
    /// Evaluate a model on a data set, beside baselines and other models.
    #[command(
        after_help = "Example: snapsnap evaluate --config configs/eval.toml --data people/test -o reports/human"
    )]
    Evaluate(commands::evaluate::Arguments),
    /// Measure error and run time of a model in different settings.
    #[command(
        after_help = "Example: snapsnap bench --config configs/bench.toml --data people/test -o reports/bench"
    )]
    Bench(commands::bench::Arguments),
    /// Check the results of extreme and degenerate inputs on every device.
    #[command(after_help = "Example: snapsnap stability -o reports/stability")]
    Stability(commands::stability::Arguments),
    /// Compare two pictures, or two folders of pictures: PSNR, SSIM, LPIPS.
    #[command(after_help = "Example: snapsnap compare a.png b.png")]
    Compare(commands::compare::Arguments),
    /// Fetch published weights: DUSt3R, and AlexNet and the learned layers of LPIPS.
    #[command(after_help = "Example: snapsnap fetch-weights alexnet lpips")]
    FetchWeights(commands::fetch_weights::Arguments),
    /// Read checkpoints of Snap-Snap, DUSt3R or CroCo and write one weight file.
    #[command(after_help = "Example: snapsnap import-weights stage1.pth stage2.pth -o weights.safetensors")]
    ImportWeights(commands::weight_files::ImportArguments),
    /// Write random weights for a config.
    #[command(
        after_help = "Example: snapsnap init-weights --config configs/tiny.toml --seed 1 -o random.safetensors"
    )]
    InitWeights(commands::weight_files::InitArguments),
    /// Write a weight file back in the authors' layout.
    #[command(after_help = "Example: snapsnap export-weights weights.safetensors -o authors.safetensors")]
    ExportWeights(commands::weight_files::ExportArguments),
    /// List devices, features, weights and missing parts, each with its remedy.
    #[command(after_help = "Example: snapsnap doctor --json")]
    Doctor(commands::doctor::Arguments),
    /// List the graphics adapters as JSON.
    #[command(name = device::PROBE, hide = true)]
    ProbeAdapters,
    /// Print completions for a shell.
    #[command(
        after_help = "Example: snapsnap completions bash > ~/.local/share/bash-completion/completions/snapsnap"
    )]
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
    /// Write a manual page for each command.
    #[command(after_help = "Example: snapsnap man -o ~/.local/share/man/man1")]
    Man {
        /// Folder for the pages.
        #[arg(short, long, value_name = "DIR")]
        output: PathBuf,
    },
}

/// Prepares a process for this library's work.
pub fn set_up() {
    keep_pages();
    #[cfg(feature = "vulkan")]
    keep_kernels();
    // Panics of libraries on damaged files become errors, which are reported without this hook.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !snapsnap_base::is_guarded() {
            hook(panic);
        }
    }));
}

/// Runs the command line `arguments` after [`set_up`]. `program` starts this program. Returns the exit code.
pub fn main(program: &[OsString], arguments: Vec<OsString>) -> u8 {
    device::set_program(program);
    interrupt::listen();
    let named = std::iter::once(OsString::from("snapsnap")).chain(arguments.iter().cloned());
    let Arguments { quiet, command } = match Arguments::try_parse_from(named) {
        Ok(arguments) => arguments,
        Err(e) => {
            // clap prints usage errors and help with exit codes 2 and 0, but does not escape control characters.
            let mut arguments = arguments.iter().map(|argument| argument.to_string_lossy());
            let is_printable = arguments.all(|argument| say::printable(&argument) == argument);
            if is_printable && e.use_stderr() {
                e.exit();
            }
            if !e.use_stderr() {
                // Help and version are the result of the command.
                return ended(say::written(e.print()).and_then(|()| say::result(b"")).map(|()| 0));
            }
            say::err(e.to_string().trim_end());
            return e.exit_code() as u8;
        }
    };
    say::set_quiet(quiet);
    if let Err(failure) = check_threads() {
        return ended(Err(failure));
    }
    let result = match command {
        Command::Demo(arguments) => commands::demo::run(&arguments),
        Command::Reconstruct(arguments) => commands::reconstruct::run(&arguments),
        Command::Render(arguments) => commands::render::run(&arguments),
        Command::Studio(arguments) => commands::studio::run(&arguments),
        Command::View(arguments) => commands::view::run(&arguments),
        Command::Mesh(arguments) => commands::mesh::run(&arguments),
        Command::Rig(arguments) => commands::rig::run(&arguments),
        Command::Convert(arguments) => commands::convert::run(&arguments),
        Command::Prepare(kind) => commands::prepare::run(&kind),
        Command::TrainStage1(arguments) => return ended(train::among_ranks(&arguments, train::stage1)),
        Command::TrainStage2(arguments) => return ended(train::among_ranks(&arguments, train::stage2)),
        Command::Evaluate(arguments) => commands::evaluate::run(&arguments),
        Command::Bench(arguments) => commands::bench::run(&arguments),
        Command::Stability(arguments) => commands::stability::run(&arguments),
        Command::Compare(arguments) => commands::compare::run(&arguments),
        Command::FetchWeights(arguments) => commands::fetch_weights::run(&arguments),
        Command::ImportWeights(arguments) => commands::weight_files::import(&arguments),
        Command::InitWeights(arguments) => commands::weight_files::init(&arguments),
        Command::ExportWeights(arguments) => commands::weight_files::export(&arguments),
        Command::Doctor(arguments) => commands::doctor::run(&arguments),
        Command::ProbeAdapters => say::json(&device::probe()),
        Command::Completions { shell } => commands::manuals::completions(shell, Arguments::command()),
        Command::Man { output } => commands::manuals::pages(&output, Arguments::command()),
    };
    ended(result.map(|()| 0))
}

/// Refuses a number of threads at whose start the program would hang.
fn check_threads() -> Result<(), Failure> {
    const VARIABLE: &str = "RAYON_NUM_THREADS";
    const MAX_THREADS: usize = 1024;
    let threads = std::env::var(VARIABLE).ok().and_then(|text| text.parse::<usize>().ok());
    match threads.filter(|threads| *threads > MAX_THREADS) {
        Some(threads) => bail!("{VARIABLE}={threads}: must be at most {MAX_THREADS}"),
        None => Ok(()),
    }
}

fn ended(result: Result<u8, Failure>) -> u8 {
    result.unwrap_or_else(|failure| {
        say::err(&format!("error: {failure}"));
        failure.code()
    })
}
