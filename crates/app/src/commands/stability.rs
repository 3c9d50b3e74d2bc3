//! `snapsnap stability`.

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::Args;
use snapsnap_eval::stability::{Case, Row, networks, report, run as run_case, splats};
use snapsnap_mesh::view::{Renderer, ViewOptions};
use snapsnap_net::Photograph;
use snapsnap_people::{Detail, synth};
use snapsnap_splat::Camera;
use snapsnap_train::stability as training;

use crate::arguments::ConfigArguments;
use crate::failure::Failure;
use crate::progress::Progress;
use crate::report::{ReportFolder, header};
use crate::{device, say, weights};

/// AdamW steps of a full run (docs/method.md, "Stability cases"), and of a quick run.
const MANY: u64 = 1_000_000;
const FEW: u64 = 10_000;

#[derive(Args)]
pub struct Arguments {
    /// Devices [default: all].
    #[arg(long, value_name = "DEVICE", num_args = 1..)]
    device: Vec<String>,
    /// Also compare the results of these weights in 16 and in 32 bits.
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    /// Only cases whose area or input contains this text.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// Run fewer steps than the full million.
    #[arg(long)]
    quick: bool,
    /// Folder of the report.
    #[arg(short, long, value_name = "REPORT")]
    output: PathBuf,
}

/// A synthetic person from the front and the back, on a canvas of `side`² pixels.
fn photographs(side: usize) -> [Photograph; 2] {
    let mesh = synth::person("stability", None, Detail::Fine);
    let renderer = Renderer::new(&mesh).expect("a synthetic person can be drawn");
    [0.0, 180.0].map(|yaw| {
        let view = renderer.draw(&Camera::orbit_at_yaw_degrees(yaw, side as u32), &ViewOptions::default());
        // Colours are multiplied by coverage. The input of networks is [−1, 1] times the mask.
        let rgb = (0..3)
            .flat_map(|c| {
                view.color.iter().zip(&view.alpha).map(move |(color, alpha)| 2.0 * color[c] - alpha)
            })
            .collect();
        Photograph::new(rgb, view.alpha)
    })
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let devices = match arguments.device.as_slice() {
        [] => device::all(),
        names => names.iter().map(|name| device::choose(name)).collect::<Result<_, _>>()?,
    };
    let mut cases = splats::cases();
    cases.extend(networks::cases());
    if let Some(path) = &arguments.weights {
        let weights = weights::open(Some(path), &ConfigArguments::default())?;
        let photographs = photographs(weights.config.network.resolution);
        cases.extend(networks::sixteen_bits(weights, photographs));
    }
    cases.extend(training::cases(if arguments.quick { FEW } else { MANY }));
    if let Some(text) = &arguments.only {
        let text = text.to_lowercase();
        cases.retain(|case| [case.area, &case.input].iter().any(|name| name.to_lowercase().contains(&text)));
    }
    if cases.is_empty() {
        let text = arguments.only.as_deref().unwrap_or_default();
        return Err(Failure::Input(format!("--only {text}: no case has that in its area or input")));
    }
    let inputs: Vec<&Path> = arguments.weights.iter().map(PathBuf::as_path).collect();
    let folder = ReportFolder::new(&arguments.output, &inputs)?;
    let rounds: Vec<(&Case, &Device)> = cases
        .iter()
        .flat_map(|case| {
            let count = if case.once { 1 } else { devices.len() };
            devices[..count].iter().map(move |device| (case, device))
        })
        .collect();
    // The table contains panics. They print nothing.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let rows: Vec<Row> = Progress::over(rounds.iter(), "cases")
        .map(|(case, device)| run_case(case, device, &device::describe(device)))
        .collect();
    std::panic::set_hook(hook);
    let names: Vec<String> = devices.iter().map(device::describe).collect();
    let header = header(&names.join(", "));
    folder.text("report.md", &report::markdown(&header, &rows))?;
    folder.finish(&report::json(&header, &rows))?;
    let failed: Vec<&Row> = rows.iter().filter(|row| row.verdict == "fails").collect();
    let count = |verdict: &str| rows.iter().filter(|row| row.verdict == verdict).count();
    say::info(&format!("{} hold, {} fail, {} skipped", count("holds"), failed.len(), count("skipped")));
    say::info(&format!("{}: report.md, report.json", folder.path.display()));
    if failed.is_empty() {
        return Ok(());
    }
    for row in &failed {
        say::err(&format!("fails: {}, on {}: {}", row.case.input, row.device, row.note));
    }
    Err(Failure::Internal(format!("{} of {} cases fail", failed.len(), rows.len())))
}
