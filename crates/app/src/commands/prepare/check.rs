//! `snapsnap prepare check`.

use std::path::PathBuf;

use clap::Args;
use snapsnap_data::dataset;

use crate::failure::Failure;
use crate::progress::Progress;
use crate::say;

#[derive(Args)]
pub struct Arguments {
    /// Folder of the data set, in this program's layout or in that of the authors' tools.
    dataset: PathBuf,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let progress = Progress::steps(0, "subjects");
    let checked = dataset::check(&arguments.dataset, |done, all| progress.step(done, all, "subjects"))?;
    drop(progress);
    for problem in &checked.problems {
        say::out(problem);
    }
    let looked = format!("{} subjects, {} views", checked.subjects, checked.views);
    if !checked.problems.is_empty() {
        return Err(Failure::Input(format!("{looked}: {} faults", checked.problems.len())));
    }
    say::info(&format!("{looked}: no fault"));
    Ok(())
}
