//! `snapsnap prepare pack`.

use std::path::PathBuf;

use clap::Args;
use snapsnap_data::dataset::{self, Folder};

use crate::failure::Failure;
use crate::output::outside_data;
use crate::progress::Progress;
use crate::say;

#[derive(Args)]
pub struct Arguments {
    /// Folder of the data set.
    dataset: PathBuf,
    /// New folder for the archives. It can be used wherever a data set is asked for.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Megabytes of an archive, about. Subjects are not divided.
    #[arg(long, value_name = "MB", default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    archive_size: u64,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let folder = Folder::open(&arguments.dataset)?;
    outside_data(&arguments.output, [arguments.dataset.as_path()])?;
    let progress = Progress::steps(0, "subjects");
    let size = 1_000_000 * arguments.archive_size;
    let packed = dataset::pack(&folder, &arguments.output, size, |done, all| {
        progress.step(done, all, "subjects");
    })?;
    drop(progress);
    let megabytes = packed.bytes as f64 / 1e6;
    say::info(&format!(
        "{}: {} subjects, {} files in {} archives of {megabytes:.1} MB together",
        arguments.output.display(),
        packed.subjects,
        packed.files,
        packed.archives
    ));
    Ok(())
}
