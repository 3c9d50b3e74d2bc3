//! The command line of snapsnap: one file per subcommand, which parses, calls and reports.

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
mod turntable;
mod view_folder;
mod weights;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Large tensors are allocated and freed on every operation; mimalloc keeps their pages, the system allocator returns
/// them to the kernel and faults them in again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

#[derive(Parser)]
#[command(name = "snapsnap", version, about = "Two photographs of a person become a 3D Gaussian human.")]
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
    Demo(commands::demo::Arguments),
    /// Turn a front and a back photograph into a Gaussian PLY.
    Reconstruct(commands::reconstruct::Arguments),
    /// Render a Gaussian PLY into pictures.
    Render(commands::render::Arguments),
    /// Make or check a data set of people to train on.
    Prepare(commands::prepare::Arguments),
    /// Train the point predictor.
    #[command(name = "train-stage1")]
    TrainStage1(commands::train::Arguments),
    /// Train the Gaussian regressor on what a trained point predictor gives.
    #[command(name = "train-stage2")]
    TrainStage2(commands::train::Arguments),
    /// Judge a model on a data set, beside baselines and others.
    Evaluate(commands::evaluate::Arguments),
    /// Error against run time: a model in different settings.
    Bench(commands::bench::Arguments),
    /// Extreme and degenerate inputs on every device, and what must hold of them.
    Stability(commands::stability::Arguments),
    /// How alike two pictures are, or two folders of pictures: PSNR, SSIM, LPIPS.
    Compare(commands::compare::Arguments),
    /// Fetch published weights: DUSt3R, and AlexNet and the learned layers of LPIPS.
    FetchWeights(commands::fetch_weights::Arguments),
    /// Read checkpoints of Snap-Snap, DUSt3R or CroCo and write one weight file.
    ImportWeights(commands::import_weights::Arguments),
    /// Write random weights for a config.
    InitWeights(commands::init_weights::Arguments),
    /// Write a weight file back in the authors' layout.
    ExportWeights(commands::export_weights::Arguments),
}

fn main() -> ExitCode {
    // A library that panics on a damaged file is an error of that file's, which is reported as such.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !snapsnap_mesh::is_guarded() {
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
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            say::err(&format!("error: {failure}"));
            failure.exit_code()
        }
    }
}
