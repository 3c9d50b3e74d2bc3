//! `snapsnap stability`.

use std::path::PathBuf;

use burn::tensor::Device;
use clap::Args;
use snapsnap_eval::stability::{Case, Row, networks, report, run as run_case, splats};
use snapsnap_train::stability as training;

use crate::failure::Failure;
use crate::progress::Progress;
use crate::report::{ReportFolder, header};
use crate::{device, say};

/// What a report consists of.
const FILES: [&str; 2] = ["report.json", "report.md"];
/// AdamW steps that EVALUATION.md asks for, and those of a quick look.
const MANY: u64 = 1_000_000;
const FEW: u64 = 10_000;

#[derive(Args)]
pub struct Arguments {
    /// Devices to try [default: every one there is].
    #[arg(long, value_name = "DEVICE", num_args = 1..)]
    device: Vec<String>,
    /// Only cases with this in their area or input.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// Fewer steps where a case makes a million.
    #[arg(long)]
    quick: bool,
    /// Folder of the report.
    #[arg(short, long, value_name = "REPORT")]
    output: PathBuf,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let devices = match arguments.device.as_slice() {
        [] => device::all(),
        names => names.iter().map(|name| device::choose(name)).collect::<Result<_, _>>()?,
    };
    let mut cases = splats::cases();
    cases.extend(networks::cases());
    cases.extend(training::cases(if arguments.quick { FEW } else { MANY }));
    if let Some(text) = &arguments.only {
        cases.retain(|case| case.area.contains(text) || case.input.contains(text));
    }
    if cases.is_empty() {
        let text = arguments.only.as_deref().unwrap_or_default();
        return Err(Failure::Input(format!("--only {text}: no case has that in its area or input")));
    }
    let folder = ReportFolder::new(&arguments.output, &FILES, &[])?;
    let rounds: Vec<(&Case, &Device)> = cases
        .iter()
        .flat_map(|case| {
            devices.iter().take(if case.once { 1 } else { devices.len() }).map(move |d| (case, d))
        })
        .collect();
    let progress = Progress::steps(quiet, rounds.len(), "cases");
    // A case that panics is a row of the table, not lines on the terminal.
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let mut rows: Vec<Row> = Vec::new();
    for (done, (case, device)) in rounds.iter().enumerate() {
        rows.push(run_case(case, device, &device::describe(device)));
        progress.step(done + 1, rounds.len(), "cases");
    }
    std::panic::set_hook(hook);
    drop(progress);
    let names: Vec<String> = devices.iter().map(device::describe).collect();
    let header = header(&names.join(", "));
    folder.text("report.md", &report::markdown(&header, &rows))?;
    folder.json("report.json", &report::json(&header, &rows))?;
    let failed: Vec<&Row> = rows.iter().filter(|row| row.verdict == "fails").collect();
    if !quiet {
        let count = |verdict: &str| rows.iter().filter(|row| row.verdict == verdict).count();
        say::out(&format!("{} hold, {} fail, {} skipped", count("holds"), failed.len(), count("skipped")));
        say::out(&format!("{}: report.md, report.json", folder.path().display()));
    }
    if failed.is_empty() {
        return Ok(());
    }
    failed.iter().for_each(|row| say::err(&format!("fails: {}, on {}: {}", row.input, row.device, row.note)));
    Err(Failure::Internal(format!("{} of {} cases fail", failed.len(), rows.len())))
}
