//! snapsnap turns two photographs of a person into 3D Gaussians. This crate is its command line, one file per subcommand.
//!
//! The other crates are libraries. [`snapsnap_net::Reconstructor`] turns photographs into Gaussians. [`snapsnap_splat::render`]
//! is the differentiable renderer. [`snapsnap_train::points`] has the losses of stage 1. The folder `examples` of the
//! repository has a program for each: `cargo run --release --example reconstruct`, `fit_gaussians` or `train_predictor`.
// Only rustdoc reads the page, so that a change of it builds nothing.
#![cfg_attr(doc, doc = "\n", doc = include_str!("../../../docs/architecture.md"))]

mod commands;
mod device;
mod dump;
mod failure;
mod interrupt;
mod memory;
mod output;
mod perceptual;
mod pictures;
mod progress;
mod report;
mod say;
mod server;
mod turntable;
mod view_folder;
mod weights;

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};

/// Large tensors are allocated and freed on every operation; mimalloc keeps their pages, the system allocator returns
/// them to the kernel and faults them in again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// First steps for new users.
const FIRST_STEPS: &str = "First steps:
  snapsnap demo                                            the sample pair: Gaussians, turntable, report
  snapsnap reconstruct front.png back.png -o human.ply     your own photographs
  snapsnap view human.ply --open                           look at the result";

#[derive(Parser)]
#[command(
    name = "snapsnap",
    version,
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
    /// The sample pair that comes with the program: Gaussians, pictures and a report.
    #[command(after_help = "Example: snapsnap demo")]
    Demo(commands::demo::Arguments),
    /// Turn a front and a back photograph into a Gaussian PLY.
    #[command(
        after_help = "Example: snapsnap reconstruct front.png back.png -o human.ply --turntable turn.gif -v"
    )]
    Reconstruct(commands::reconstruct::Arguments),
    /// Render a Gaussian PLY into pictures.
    #[command(after_help = "Example: snapsnap render human.ply --orbit 12 --size 1024x1024 -o renders")]
    Render(commands::render::Arguments),
    /// Look at a file of Gaussians in the browser.
    #[command(after_help = "Example: snapsnap view human.ply --open")]
    View(commands::view::Arguments),
    /// Make one closed surface of Gaussians: a mesh for modelling programs and game engines.
    #[command(after_help = "Example: snapsnap mesh human.ply -o human.glb")]
    Mesh(commands::mesh::Arguments),
    /// Turn a file of Gaussians into another kind: PLY, or SPZ, which is an eighth as large.
    #[command(after_help = "Example: snapsnap convert human.ply human.spz")]
    Convert(commands::convert::Arguments),
    /// Make or check a data set of people to train on.
    #[command(
        after_help = "Example: snapsnap prepare synth --subjects 300 --seed 1 --config configs/data/small.toml -o people/synth"
    )]
    Prepare(commands::prepare::Arguments),
    /// Train the point predictor.
    #[command(
        name = "train-stage1",
        after_help = "Example: snapsnap train-stage1 --config configs/tiny/stage1.toml --data people/synth -o runs/points"
    )]
    TrainStage1(commands::train::Arguments),
    /// Train the Gaussian regressor on what a trained point predictor gives.
    #[command(
        name = "train-stage2",
        after_help = "Example: snapsnap train-stage2 --config configs/tiny/stage2.toml --data people/synth --weights runs/points/best.safetensors -o runs/human"
    )]
    TrainStage2(commands::train::Arguments),
    /// Judge a model on a data set, beside baselines and others.
    #[command(
        after_help = "Example: snapsnap evaluate --config configs/eval.toml --data people/test -o reports/human"
    )]
    Evaluate(commands::evaluate::Arguments),
    /// Error against run time: a model in different settings.
    #[command(
        after_help = "Example: snapsnap bench --config configs/bench.toml --data people/test -o reports/bench"
    )]
    Bench(commands::bench::Arguments),
    /// Extreme and degenerate inputs on every device, and what must hold of them.
    #[command(after_help = "Example: snapsnap stability -o reports/stability")]
    Stability(commands::stability::Arguments),
    /// How alike two pictures are, or two folders of pictures: PSNR, SSIM, LPIPS.
    #[command(after_help = "Example: snapsnap compare a.png b.png")]
    Compare(commands::compare::Arguments),
    /// Fetch published weights: DUSt3R, and AlexNet and the learned layers of LPIPS.
    #[command(after_help = "Example: snapsnap fetch-weights alexnet lpips")]
    FetchWeights(commands::fetch_weights::Arguments),
    /// Read checkpoints of Snap-Snap, DUSt3R or CroCo and write one weight file.
    #[command(after_help = "Example: snapsnap import-weights stage1.pth stage2.pth -o weights.safetensors")]
    ImportWeights(commands::import_weights::Arguments),
    /// Write random weights for a config.
    #[command(
        after_help = "Example: snapsnap init-weights --config configs/tiny.toml --seed 1 -o random.safetensors"
    )]
    InitWeights(commands::init_weights::Arguments),
    /// Write a weight file back in the authors' layout.
    #[command(after_help = "Example: snapsnap export-weights weights.safetensors -o authors.safetensors")]
    ExportWeights(commands::export_weights::Arguments),
    /// List devices, features, weights and missing parts, each with its remedy.
    #[command(after_help = "Example: snapsnap doctor --json")]
    Doctor(commands::doctor::Arguments),
    /// Print completions for a shell.
    #[command(
        after_help = "Example: snapsnap completions bash > ~/.local/share/bash-completion/completions/snapsnap"
    )]
    Completions(commands::manuals::CompletionArguments),
    /// Write a manual page for each command.
    #[command(after_help = "Example: snapsnap man -o ~/.local/share/man/man1")]
    Man(commands::manuals::ManArguments),
}

fn main() -> ExitCode {
    // A library that panics on a damaged file is an error of that file's, which is reported as such.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !snapsnap_base::is_guarded() {
            hook(panic);
        }
    }));
    interrupt::listen();
    let Arguments { quiet, command } = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        // clap prints usage errors and help itself, with exit codes 2 and 0, but arguments as they are.
        Err(e) => {
            let mut arguments = std::env::args_os().map(|argument| argument.to_string_lossy().into_owned());
            if arguments.all(|argument| say::printable(&argument) == argument) {
                e.exit();
            }
            let say = if e.use_stderr() { say::err } else { say::out };
            say(e.to_string().trim_end());
            return if e.use_stderr() { ExitCode::from(2) } else { ExitCode::SUCCESS };
        }
    };
    let result = match command {
        Command::Demo(arguments) => commands::demo::run(&arguments, quiet),
        Command::Reconstruct(arguments) => commands::reconstruct::run(&arguments, quiet),
        Command::Render(arguments) => commands::render::run(&arguments, quiet),
        Command::View(arguments) => commands::view::run(&arguments, quiet),
        Command::Mesh(arguments) => commands::mesh::run(&arguments, quiet),
        Command::Convert(arguments) => commands::convert::run(&arguments, quiet),
        Command::Prepare(arguments) => commands::prepare::run(&arguments, quiet),
        Command::TrainStage1(arguments) => commands::train::stage1(&arguments, quiet),
        Command::TrainStage2(arguments) => commands::train::stage2(&arguments, quiet),
        Command::Evaluate(arguments) => commands::evaluate::run(&arguments, quiet),
        Command::Bench(arguments) => commands::bench::run(&arguments, quiet),
        Command::Stability(arguments) => commands::stability::run(&arguments, quiet),
        Command::Compare(arguments) => commands::compare::run(&arguments),
        Command::FetchWeights(arguments) => commands::fetch_weights::run(&arguments, quiet),
        Command::ImportWeights(arguments) => commands::import_weights::run(&arguments, quiet),
        Command::InitWeights(arguments) => commands::init_weights::run(&arguments, quiet),
        Command::ExportWeights(arguments) => commands::export_weights::run(&arguments, quiet),
        Command::Doctor(arguments) => commands::doctor::run(&arguments),
        Command::Completions(arguments) => commands::manuals::completions(&arguments, Arguments::command()),
        Command::Man(arguments) => commands::manuals::pages(&arguments, Arguments::command(), quiet),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            say::err(&format!("error: {failure}"));
            failure.exit_code()
        }
    }
}
