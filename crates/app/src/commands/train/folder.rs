//! The folder of a run: its lock and its config.

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use snapsnap_base::FileError;
use snapsnap_base::config::Schema;
use snapsnap_data::dataset::Folder;
use snapsnap_train::config::TrainConfig;
use snapsnap_train::log::PREVIEWS;
use snapsnap_train::run::{CONFIG, FILES, STATE};

use super::Arguments;
use crate::arguments::check_utf8;
use crate::failure::Failure;
use crate::output::{make_folder, outside_data};

/// The file that a training process locks.
const LOCK: &str = "lock";

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
    let paths = config.data.folders.iter_mut().chain(config.training.weights.iter_mut());
    for path in paths {
        *path = std::path::absolute(&*path).unwrap_or_else(|_| path.clone());
    }
    check_utf8(config.data.folders.iter().chain(&config.training.weights))?;
    Ok(config)
}

/// The locked folder of a run.
pub struct RunFolder {
    pub path: PathBuf,
    /// Folders that were made for the run, the innermost first.
    made: Vec<PathBuf>,
    /// Whether the lock's file was made for the run.
    has_new_lock: bool,
    /// Locked until it is dropped.
    _lock: File,
}

impl RunFolder {
    /// Makes or opens the folder, and locks it. Refuses runs of other networks or of other processes, existing runs
    /// without --resume, and folders in which the run would replace something.
    pub fn open(
        path: &Path,
        arguments: &Arguments,
        config: &TrainConfig,
        data: &[Arc<Folder>],
    ) -> Result<Self, Failure> {
        let wrong = |message: &str| Failure::file(path, message);
        outside_data(path, data.iter().map(|folder| folder.root()))?;
        for name in FILES.iter().chain(&[LOCK, STATE]) {
            check_kind(&path.join(name))?;
        }
        let missing =
            path.ancestors().take_while(|folder| !folder.as_os_str().is_empty() && !folder.exists());
        let made = missing.map(Path::to_owned).collect();
        make_folder(path)?;
        let lock = path.join(LOCK);
        let is_new = !lock.exists();
        let file = File::options().create(true).truncate(false).write(true).open(&lock);
        let file = file.map_err(FileError::write(&lock))?;
        // Some file systems have no locks. The run goes on without one.
        if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) {
            return Err(wrong("is being trained by another process"));
        }
        let folder = Self { path: path.to_owned(), made, has_new_lock: is_new, _lock: file };
        if path.join(STATE).exists() {
            if !arguments.resume {
                return Err(wrong("contains a run: add --resume to continue it, or give another folder"));
            }
            // Another precision has the same layers; the state tells it apart.
            let mut there = TrainConfig::from_file(&path.join(CONFIG), &[])?;
            there.training.precision = config.training.precision;
            if there.networks() != config.networks() {
                return Err(wrong(
                    "was begun with other [network], [regressor] or [mode] sections (its config.toml): give \
                     another folder",
                ));
            }
        } else if let Some(replaced) = replaced(path, config) {
            let message = "would be replaced by a new run, and the folder has no state to continue from: give another \
                           folder, or move it away";
            return Err(Failure::file(&replaced, message));
        }
        Ok(folder)
    }
}

impl Drop for RunFolder {
    /// A run that could not begin leaves nothing.
    fn drop(&mut self) {
        if self.has_new_lock && !self.path.join(STATE).exists() {
            let _ = fs::remove_file(self.path.join(LOCK));
            for folder in &self.made {
                let _ = fs::remove_dir(folder);
            }
        }
    }
}

/// Refuses a link, a pipe or a folder in place of a file of the run: a run writes only its own files.
fn check_kind(path: &Path) -> Result<(), Failure> {
    match fs::symlink_metadata(path) {
        Ok(there) if there.is_symlink() => {
            Err(Failure::file(path, "is a link; a run writes only its own files"))
        }
        Ok(there) if !there.is_file() => Err(Failure::file(path, "is no regular file")),
        _ => Ok(()),
    }
}

/// The first file of the folder that a new run would replace. Its config may be there already.
fn replaced(folder: &Path, config: &TrainConfig) -> Option<PathBuf> {
    let is_own = |path: &Path| fs::read(path).is_ok_and(|bytes| bytes == config.to_toml().as_bytes());
    let mut files = FILES.map(|name| folder.join(name)).into_iter();
    let file = files.find(|path| path.exists() && !(path.ends_with(CONFIG) && is_own(path)));
    let previews = folder.join(PREVIEWS);
    file.or_else(|| {
        fs::read_dir(&previews).is_ok_and(|mut entries| entries.next().is_some()).then_some(previews)
    })
}
