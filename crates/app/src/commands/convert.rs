//! `snapsnap convert`.

use std::path::{Path, PathBuf};

use clap::Args;
use snapsnap_base::file;
use snapsnap_splat::scene::{Kind, Stored};

use super::{check_kind, check_outputs};
use crate::failure::Failure;
use crate::say;

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians, PLY or SPZ.
    input: PathBuf,
    /// Output file: .ply or .spz.
    output: PathBuf,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let Arguments { input, output } = arguments;
    check_kind(output)?;
    check_outputs(&[output], &[input])?;
    let (stored, dropped) = finite(input)?;
    stored.write(output)?;
    if quiet {
        return Ok(());
    }
    // Messages must not enter a pipe of data.
    let say = if file::is_special(output) { say::err } else { say::out };
    if dropped > 0 {
        say(&format!(
            "{}: {dropped} Gaussians with values that are not finite were left out",
            input.display()
        ));
    }
    for loss in stored.losses(Kind::of(output)) {
        say(&format!("{}: {loss}", output.display()));
    }
    let size = |path: &PathBuf| std::fs::metadata(path).map_or(0.0, |metadata| metadata.len() as f64 / 1e6);
    say(&format!(
        "{}: {} Gaussians of SH degree {}, {:.1} MB instead of {:.1}",
        output.display(),
        stored.len(),
        stored.degree(),
        size(output),
        size(input)
    ));
    Ok(())
}

/// Reads the Gaussians whose values are finite, and how many others there are.
///
/// # Errors
/// For a file that cannot be read, or that has Gaussians of which none is finite.
pub fn finite(input: &Path) -> Result<(Stored, usize), Failure> {
    let mut stored = Stored::read(input)?;
    let dropped = stored.drop_not_finite();
    if stored.is_empty() && dropped > 0 {
        return Err(Failure::Input(format!(
            "{}: none of its {dropped} Gaussians is finite",
            input.display()
        )));
    }
    Ok((stored, dropped))
}
