//! The weights of LPIPS.

use std::path::{Path, PathBuf};

use clap::Args;
use snapsnap_eval::lpips::Lpips;

use crate::device;
use crate::failure::Failure;

/// Default folder of the weights.
pub const FOLDER: &str = "weights";

#[derive(Args)]
pub struct Arguments {
    /// Folder with the published weights of AlexNet and LPIPS (`snapsnap fetch-weights alexnet lpips`), or your own
    /// weight files [default: weights].
    #[arg(long = "lpips", value_name = "DIR|FILE", num_args = 1..)]
    pub files: Vec<PathBuf>,
}

impl Arguments {
    /// The network, or the reason for its absence. The device called `device` is chosen only if weights exist.
    ///
    /// # Errors
    /// If weights of the command line are missing, or weights are damaged.
    pub fn load(&self, default: &Path, device: &str) -> Result<Result<Lpips, String>, Failure> {
        let folder = match self.files.as_slice() {
            [] => default,
            [folder] if folder.is_dir() => folder,
            files => return Ok(Ok(Lpips::load(files, &device::choose(device)?)?)),
        };
        match missing(folder) {
            None => Ok(Ok(Lpips::published(folder, &device::choose(device)?)?)),
            Some(why) if self.files.is_empty() => Ok(Err(why)),
            Some(why) => Err(Failure::Input(format!("--lpips: {why}"))),
        }
    }
}

/// The weights of LPIPS, or the reason for their absence, for reports.
pub fn describe(lpips: &Result<Lpips, String>) -> String {
    match lpips {
        Ok(network) if network.is_published() => "published weights".into(),
        Ok(_) => "other weights than the published ones: not to be compared with other reports".into(),
        Err(why) => format!("n/a ({why})"),
    }
}

/// Remark after a distance that other weights than the published ones gave.
pub fn mark(lpips: &Result<Lpips, String>) -> &'static str {
    match lpips {
        Ok(network) if !network.is_published() => " (not with the published weights)",
        _ => "",
    }
}

fn missing(folder: &Path) -> Option<String> {
    let files: Vec<String> = Lpips::missing(folder).iter().map(|file| file.display().to_string()).collect();
    (!files.is_empty()).then(|| format!("weights missing: {}", files.join(", ")))
}
