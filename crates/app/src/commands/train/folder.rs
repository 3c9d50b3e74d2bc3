//! The folder of a run: who may write into it, and the config that it was begun with.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use snapsnap_data::dataset::Folder;
use snapsnap_splat::file;
use snapsnap_train::config::TrainConfig;
use snapsnap_train::run::STATE;

use super::Arguments;
use crate::failure::Failure;
use crate::output;

/// Name of the config in force.
const CONFIG: &str = "config.toml";
/// Longest config that is read.
const MOST: u64 = 1 << 20;

/// The config of a run: of --config, or of the run that goes on, with what the command line says on top.
pub fn config(arguments: &Arguments) -> Result<TrainConfig, Failure> {
    let own = arguments.output.as_ref().map(|run| run.join(CONFIG));
    let path = match (&arguments.config, own) {
        (Some(path), _) => path.clone(),
        (None, Some(path)) => path,
        (None, None) => return Err(Failure::Input("give --config TOML".into())),
    };
    let mut config = read(&path, &arguments.set)?;
    if !arguments.data.is_empty() {
        config.data.folders.clone_from(&arguments.data);
    }
    if let Some(weights) = &arguments.weights {
        config.training.start = Some(weights.clone());
    }
    Ok(config)
}

fn read(path: &Path, overrides: &[String]) -> Result<TrainConfig, Failure> {
    let text = file::read_text(path, MOST)
        .map_err(|e| Failure::Input(format!("{}: cannot read the config: {e}", path.display())))?;
    Ok(TrainConfig::from_toml(&text, &path.display().to_string(), overrides)?)
}

/// The folder of a run, which nobody else writes into.
pub struct RunFolder {
    path: PathBuf,
    /// Locked until it is dropped.
    _lock: File,
}

impl RunFolder {
    /// Makes or enters the folder and notes the config in it.
    ///
    /// # Errors
    /// [`Failure::Input`] if it holds a run that is not to go on, one of other networks, or one that is under way.
    pub fn open(
        path: &Path,
        arguments: &Arguments,
        config: &TrainConfig,
        data: &[Arc<Folder>],
    ) -> Result<Self, Failure> {
        let wrong = |message: &str| Failure::Input(format!("{}: {message}", path.display()));
        fs::create_dir_all(path).map_err(|e| Failure::cannot_write(path, &e))?;
        let place = path.canonicalize().map_err(|e| Failure::cannot_write(path, &e))?;
        for folder in data {
            if folder.root().canonicalize().is_ok_and(|root| place.starts_with(root)) {
                return Err(wrong("lies in a data set"));
            }
        }
        let lock = path.join("lock");
        let file = File::create(&lock).map_err(|e| Failure::cannot_write(&lock, &e))?;
        if file.try_lock().is_err() {
            return Err(wrong("is being trained by another process"));
        }
        let (own, resolved) = (path.join(CONFIG), config.to_toml());
        if path.join(STATE).exists() {
            if !arguments.resume {
                return Err(wrong("holds a run: add --resume to go on, or give another folder"));
            }
            let before = read(&own, &[])?;
            if before.networks() != config.networks() {
                return Err(wrong(
                    "was begun with other [network], [regressor] or [mode] sections (its config.toml): give \
                     another folder",
                ));
            }
        } else if own.exists() && !arguments.resume {
            // Of a run that never came to a checkpoint: nothing is lost, unless it is what the config is read from.
            let given = arguments.config.as_deref();
            if given.is_some_and(|given| super::super::is_same_file(given, &own)) {
                return Err(wrong("holds the config itself, which would be replaced: give another folder"));
            }
        }
        if fs::read(&own).ok().as_deref() != Some(resolved.as_bytes()) {
            output::write(&own, resolved.as_bytes())?;
        }
        Ok(Self { path: path.to_owned(), _lock: file })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }
}
