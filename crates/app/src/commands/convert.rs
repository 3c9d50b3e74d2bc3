//! `snapsnap convert`.

use std::path::{Path, PathBuf};

use clap::Args;
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

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let Arguments { input, output } = arguments;
    check_kind(output)?;
    check_outputs(&[output], &[input])?;
    let (stored, dropped) = finite(input)?;
    stored.write(output)?;
    if say::is_quiet() {
        return Ok(());
    }
    let say = say::beside(output);
    if dropped > 0 {
        let input = input.display();
        say(&format!("{input}: {dropped} Gaussians with values that are not finite were left out"));
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

/// Reads a file's finite Gaussians, and counts the others. Refuses a file of which no Gaussian is finite.
pub fn finite(input: &Path) -> Result<(Stored, usize), Failure> {
    let mut stored = Stored::read(input)?;
    let dropped = stored.drop_not_finite();
    if stored.is_empty() && dropped > 0 {
        return Err(Failure::file(input, format_args!("none of its {dropped} Gaussians is finite")));
    }
    Ok((stored, dropped))
}
