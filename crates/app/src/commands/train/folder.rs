//! The folder of a run: its lock and its config.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use snapsnap_base::config::Schema;
use snapsnap_data::dataset::Folder;
use snapsnap_train::config::TrainConfig;
use snapsnap_train::run::{BEST, CONFIG, LAST, STATE};

use super::super::{is_same_file, outside_data};
use super::Arguments;
use crate::failure::Failure;
use crate::output::make_folder;

/// The config of --config or of the continued run, with the options of the command line.
pub fn config(arguments: &Arguments) -> Result<TrainConfig, Failure> {
    let own = || arguments.output.as_ref().map(|run| run.join(CONFIG));
    let path = arguments.config.clone().or_else(own);
    let path = path.ok_or_else(|| Failure::Input("give --config TOML".into()))?;
    let mut config = TrainConfig::from_file(&path, &arguments.set)?;
    if !arguments.data.is_empty() {
        config.data.folders.clone_from(&arguments.data);
    }
    config.training.weights = arguments.weights.clone().or(config.training.weights);
    // Absolute paths, since a run may be continued from another working directory.
    let lpips = config.stage2.lpips.iter_mut().flat_map(|lpips| &mut lpips.files);
    let others = config.training.weights.iter_mut().chain(&mut config.stage2.point_map_cache).chain(lpips);
    let paths = config.data.folders.iter_mut().chain(others);
    for path in paths {
        *path = std::path::absolute(&*path).unwrap_or_else(|_| path.clone());
        if path.to_str().is_none() {
            return Err(Failure::file(path, "the path is not UTF-8, which the run's config must be"));
        }
    }
    Ok(config)
}

/// The locked folder of a run.
pub struct RunFolder {
    pub path: PathBuf,
    /// Locked until it is dropped.
    _lock: File,
}

impl RunFolder {
    /// Makes or opens the folder, and locks it. Refuses runs of other networks or of other processes, and existing runs without
    /// --resume.
    pub fn open(
        path: &Path,
        arguments: &Arguments,
        config: &TrainConfig,
        data: &[Arc<Folder>],
    ) -> Result<Self, Failure> {
        let wrong = |message: &str| Failure::file(path, message);
        outside_data(path, data.iter().map(|folder| folder.root()))?;
        make_folder(path)?;
        let lock = path.join("lock");
        let file = File::options().create(true).truncate(false).write(true).open(&lock);
        let file = file.map_err(|e| Failure::cannot_write(&lock, &e))?;
        // Some file systems have no locks. The run goes on without one.
        if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) {
            return Err(wrong("is being trained by another process"));
        }
        let own = path.join(CONFIG);
        if path.join(STATE).exists() {
            if !arguments.resume {
                return Err(wrong("contains a run: add --resume to continue it, or give another folder"));
            }
            if TrainConfig::from_file(&own, &[])?.networks() != config.networks() {
                return Err(wrong(
                    "was begun with other [network], [regressor] or [mode] sections (its config.toml): give \
                     another folder",
                ));
            }
        } else {
            // A run without a checkpoint may be replaced, unless the new run begins with one of its files.
            if own.exists() {
                TrainConfig::from_file(&own, &[])?;
            }
            let start = config.training.weights.as_deref().into_iter();
            let lpips = config.stage2.lpips.iter().flat_map(|lpips| &lpips.files).map(PathBuf::as_path);
            let outputs = [BEST, LAST, CONFIG].map(|name| path.join(name));
            for input in start.chain(arguments.config.as_deref()).chain(lpips) {
                if outputs.iter().any(|output| is_same_file(input, output)) {
                    return Err(Failure::file(input, "would be replaced by the run: give another folder"));
                }
            }
        }
        Ok(Self { path: path.to_owned(), _lock: file })
    }
}
