//! `snapsnap convert`.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use snapsnap_splat::scene::{Kind, Stored};

use crate::batch::{self, KindArgument, ShardArgument, must_be_unused};
use crate::failure::Failure;
use crate::output::{self, check_kind, check_outputs};
use crate::{page, say};

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians: PLY, SPZ, or GLB; or a folder of such files.
    input: PathBuf,
    /// Output file: .ply, .spz, .glb (KHR_gaussian_splatting) or .sog; .html, a page that shows the scene by itself; or
    /// a folder.
    output: PathBuf,
    #[command(flatten)]
    axes: AxesArguments,
    #[command(flatten)]
    kind: KindArgument,
    #[command(flatten)]
    shard: ShardArgument,
}

/// Axes of an output file of Gaussians.
#[derive(Args, Debug, Serialize)]
pub struct AxesArguments {
    /// Write a PLY with y down, as SuperSplat and other viewers of INRIA's scenes expect it. Every command of this
    /// program recognises such a file.
    #[arg(long)]
    y_down: bool,
}

impl AxesArguments {
    /// Refuses y down for kinds of files whose axes viewers know.
    pub fn check(&self, output: &Path) -> Result<(), Failure> {
        if self.y_down && (Kind::of(output) != Kind::Ply || is_page(output)) {
            let message = "--y-down is for PLYs: an SPZ and a GLB have y up by definition, a SOG and a page are turned already";
            return Err(Failure::file(output, message));
        }
        Ok(())
    }

    /// Writes the file, whole or not at all.
    pub fn write(&self, stored: &Stored, output: &Path) -> Result<(), Failure> {
        Ok(stored.write(if self.y_down { Kind::YDown } else { Kind::of(output) }, output)?)
    }
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let Arguments { input, output, axes, kind, shard } = arguments;
    if input.is_dir() {
        let file = |name: &str| output.join(format!("{name}.{}", kind.extension()));
        axes.check(&file("x"))?;
        return batch::each(input, output, shard, file, |path, name| one(path, &file(name), axes));
    }
    must_be_unused(&[("--kind", kind.kind.is_some()), ("--shard", shard.shard.is_some())], batch::ONE)?;
    one(input, output, axes)
}

/// Whether a page is to be written.
fn is_page(output: &Path) -> bool {
    output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("html"))
}

fn one(input: &Path, output: &Path, axes: &AxesArguments) -> Result<(), Failure> {
    let is_page = is_page(output);
    let kind = if is_page { Kind::Spz } else { Kind::of(output) };
    if !is_page {
        check_kind(output)?;
    }
    axes.check(output)?;
    check_outputs(&[output], &[input])?;
    let stored = read(input)?;
    if is_page {
        let name = input.file_stem().unwrap_or_default().to_string_lossy();
        output::write(output, page::alone(&name, &stored.to_bytes(kind)?).as_bytes())?;
    } else {
        axes.write(&stored, output)?;
    }
    if say::is_quiet() {
        return Ok(());
    }
    let (say, file) = (say::beside(output), output.display());
    for loss in stored.losses(kind) {
        say(&format!("{file}: {loss}"));
    }
    let size = |path: &Path| std::fs::metadata(path).map_or(0.0, |metadata| metadata.len() as f64 / 1e6);
    let (count, degree, new, old) = (stored.len(), stored.degree(), size(output), size(input));
    say(&format!("{file}: {count} Gaussians of SH degree {degree}, {new:.1} MB instead of {old:.1}"));
    Ok(())
}

/// Reads a file's Gaussians and says how many cannot be drawn and were left out.
pub fn read(input: &Path) -> Result<Stored, Failure> {
    let (stored, dropped) = drawable(input)?;
    if dropped > 0 {
        let input = input.display();
        say::note(&format!(
            "{input}: {dropped} Gaussians were left out: a value is not finite, or the rotation is 0"
        ));
    }
    Ok(stored)
}

/// Reads a file's Gaussians that can be drawn, and counts the others. Refuses a file without a drawable Gaussian.
pub fn drawable(input: &Path) -> Result<(Stored, usize), Failure> {
    let mut stored = Stored::read(input)?;
    let dropped = stored.drop_undrawable();
    if stored.is_empty() && dropped > 0 {
        let message = format_args!(
            "none of its {dropped} Gaussians can be drawn: values are not finite, or rotations 0"
        );
        return Err(Failure::file(input, message));
    }
    Ok((stored, dropped))
}
