//! Files that appear whole or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

/// How often the removal of a folder is tried.
const FOLDER_TRIES: usize = 100;

/// Temporary files that are being written.
#[derive(Default)]
struct Unfinished {
    paths: Vec<PathBuf>,
    /// The program is about to end: no new ones.
    ending: bool,
}

static UNFINISHED: Mutex<Unfinished> = Mutex::new(Unfinished { paths: Vec::new(), ending: false });

fn unfinished() -> MutexGuard<'static, Unfinished> {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes the temporary files of writes in progress and lets no new ones begin: for a program that is about to be ended
/// from outside.
pub fn remove_unfinished() {
    let mut unfinished = unfinished();
    unfinished.ending = true;
    for path in unfinished.paths.drain(..) {
        // Whoever renamed or removed it first has done the work. Others may still be writing into a folder.
        for _ in 0..FOLDER_TRIES {
            let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            if removed.is_ok() || !path.is_dir() {
                break;
            }
            thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Whether [`remove_unfinished`] was called, in which case what fails now fails for that.
pub fn is_ending() -> bool {
    unfinished().ending
}

/// Makes the folder `path`, and those around it, for files that are to be moved elsewhere once all of them are written.
/// [`remove_unfinished`] removes it with all that is in it, until the guard is dropped.
///
/// # Errors
/// The operating system's refusal, or that the program is being ended.
pub fn unfinished_folder(path: &Path) -> io::Result<UnfinishedFolder> {
    let mut unfinished = unfinished();
    if unfinished.ending {
        return Err(io::Error::new(io::ErrorKind::Interrupted, "the program is being ended"));
    }
    fs::create_dir_all(path)?;
    unfinished.paths.push(path.to_owned());
    Ok(UnfinishedFolder(path.to_owned()))
}

/// Ends the watch over a folder of [`unfinished_folder`]; the folder itself stays.
#[derive(Debug)]
pub struct UnfinishedFolder(PathBuf);

impl Drop for UnfinishedFolder {
    fn drop(&mut self) {
        unfinished().paths.retain(|path| *path != self.0);
    }
}

/// Creates a temporary file and notes it, in one step as seen from [`remove_unfinished`].
fn create(path: &Path) -> io::Result<File> {
    let mut unfinished = unfinished();
    if unfinished.ending {
        return Err(io::Error::new(io::ErrorKind::Interrupted, "the program is being ended"));
    }
    let mut options = File::options();
    options.read(true).write(true).create_new(true);
    let file = options.open(path)?;
    unfinished.paths.push(path.to_owned());
    Ok(file)
}

/// Writes `path` through `fill`: into a temporary file beside it, which is renamed when `fill` has succeeded, so that
/// a failure leaves whatever was there before. A symbolic link keeps pointing at the file, which is replaced; a path
/// that exists and is no regular file (a pipe, a device) is written in place: renaming would replace the device itself.
///
/// # Errors
/// What `fill` returns, or the operating system's refusal to create, write or rename the file.
pub fn write_whole<E: From<io::Error>>(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<&mut File>) -> Result<(), E>,
) -> Result<(), E> {
    if is_special(path) {
        let mut file = File::options().write(true).open(path)?;
        let mut out = BufWriter::new(&mut file);
        fill(&mut out)?;
        return Ok(out.flush()?);
    }
    let path = &target_of(path);
    // Created with the mode of an ordinary new file (the umask applies), not the private one of temporary files.
    let mut file = tempfile::Builder::new()
        .prefix(".snapsnap-")
        .make_in(folder_of(path), create)
        .map_err(|e| io::Error::from(e.kind()))?;
    let temporary = file.path().to_owned();
    let mut out = BufWriter::with_capacity(1 << 20, file.as_file_mut());
    let filled = fill(&mut out).and_then(|()| Ok(out.flush()?));
    drop(out);
    let written = filled.and_then(|()| file.persist(path).map(drop).map_err(|e| e.error.into()));
    unfinished().paths.retain(|p| *p != temporary);
    written
}

/// Whether `path` exists and is neither a regular file nor a folder.
pub fn is_special(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir())
}

/// The file behind a symbolic link.
fn target_of(path: &Path) -> PathBuf {
    if path.is_symlink() { path.canonicalize().unwrap_or_else(|_| path.to_owned()) } else { path.to_owned() }
}

/// Checks, before any work, that `path` can be written: its folder exists and lets us create a file. A pipe or a device
/// is not touched: opening it is already an event for whoever reads it.
///
/// # Errors
/// The operating system's reason.
pub fn check_writable(path: &Path) -> io::Result<()> {
    if path.is_dir() || path.as_os_str().to_string_lossy().ends_with(['/', std::path::MAIN_SEPARATOR]) {
        return Err(io::Error::new(io::ErrorKind::IsADirectory, "is a directory"));
    }
    if is_special(path) {
        return Ok(());
    }
    tempfile::tempfile_in(folder_of(&target_of(path))).map(drop)
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("a.txt");
        fs::write(&path, "old").expect("write");
        let failed: io::Result<()> = write_whole(&path, |out| {
            out.write_all(b"half")?;
            Err(io::Error::other("stop"))
        });
        assert_eq!(failed.expect_err("fails").to_string(), "stop");
        assert_eq!(fs::read_to_string(&path).expect("read"), "old");
        assert_eq!(fs::read_dir(folder.path()).expect("list").count(), 1);
    }

    #[test]
    fn a_missing_folder_and_a_directory_are_refused_before_any_work() {
        let folder = tempfile::tempdir().expect("temporary folder");
        assert!(check_writable(&folder.path().join("no/such/file")).is_err());
        assert!(check_writable(folder.path()).is_err());
        assert!(check_writable(&folder.path().join("new")).is_ok());
        assert_eq!(fs::read_dir(folder.path()).expect("list").count(), 0);
    }
}
