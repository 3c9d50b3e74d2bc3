//! Atomic writing of files, and reading of regular files up to a limit.

use std::collections::HashSet;
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

/// Prefix of the names of temporary files.
const PREFIX: &str = ".snapsnap-";
/// Age after which a temporary file counts as left by a killed run.
const LEFT: Duration = Duration::from_secs(600);
/// Attempts to remove a folder.
const FOLDER_TRIES: usize = 100;

/// Temporary files that are being written; `None` when the program is about to end and new ones are refused.
static UNFINISHED: Mutex<Option<Vec<PathBuf>>> = Mutex::new(Some(Vec::new()));

fn unfinished() -> MutexGuard<'static, Option<Vec<PathBuf>>> {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes the temporary files of writes in progress and refuses new writes: for a program that is about to be ended
/// from outside.
pub fn remove_unfinished() {
    // The lock is held until the last file is gone.
    let mut unfinished = unfinished();
    for path in unfinished.take().into_iter().flatten() {
        // The path may be renamed or removed already. Other threads may still write into a folder, hence the attempts.
        for _ in 0..FOLDER_TRIES {
            let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            if removed.is_ok() || !path.is_dir() {
                break;
            }
            thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Whether [`remove_unfinished`] was called. Later failures are its consequence.
pub fn is_ending() -> bool {
    unfinished().is_none()
}

/// Makes the folder `path` and its parents, for files that are moved elsewhere once all of them are written. Until the
/// guard is dropped, [`remove_unfinished`] removes the folder with its content.
///
/// # Errors
/// The operating system's refusal, or [`io::ErrorKind::Interrupted`] after [`remove_unfinished`].
pub fn unfinished_folder(path: &Path) -> io::Result<Watch> {
    begun(path, || fs::create_dir_all(path))?;
    Ok(Watch(path.to_owned()))
}

/// Makes a file or a folder and registers it for [`remove_unfinished`], under one lock.
fn begun<T>(path: &Path, make: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
    let mut unfinished = unfinished();
    let Some(paths) = unfinished.as_mut() else {
        return Err(io::Error::new(io::ErrorKind::Interrupted, "the program is being ended"));
    };
    let made = make()?;
    paths.push(path.to_owned());
    Ok(made)
}

/// Guard of an unfinished folder or file. When the guard is dropped, [`remove_unfinished`] no longer removes the path.
#[derive(Debug)]
pub struct Watch(PathBuf);

impl Watch {
    /// Removes the file and drops the guard.
    pub fn remove(self) {
        let _ = fs::remove_file(&self.0);
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        unfinished().iter_mut().for_each(|paths| paths.retain(|path| *path != self.0));
    }
}

/// Registers a file, which [`remove_unfinished`] removes until the guard is dropped.
#[must_use = "the file is forgotten when the guard is dropped"]
pub fn unfinished_file(path: &Path) -> Watch {
    unfinished().iter_mut().for_each(|paths| paths.push(path.to_owned()));
    Watch(path.to_owned())
}

/// Creates a temporary file.
fn create(path: &Path) -> io::Result<File> {
    let file = File::options().read(true).write(true).create_new(true).open(path)?;
    // The lock distinguishes the file of a running process from a file that a killed run has left. Some file systems
    // have no locks.
    let _ = file.lock();
    // Before it was locked, another run may have removed the file as a leftover.
    if !path.exists() {
        return Err(io::ErrorKind::AlreadyExists.into());
    }
    Ok(file)
}

/// Folders that this run has tidied.
static TIDIED: LazyLock<Mutex<HashSet<PathBuf>>> = LazyLock::new(Mutex::default);

/// Removes the temporary files that killed runs have left in `folder`. Each process does this once per folder.
fn tidy(folder: &Path) {
    if !TIDIED.lock().unwrap_or_else(PoisonError::into_inner).insert(folder.to_owned()) {
        return;
    }
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        if !entry.file_type().is_ok_and(|kind| kind.is_file()) {
            continue;
        }
        let name = entry.file_name().to_string_lossy().into_owned();
        // Six characters follow the prefix.
        let is_ours = name.strip_prefix(PREFIX).is_some_and(|rest| rest.len() == 6);
        let is_old = |file: &File| {
            let age = file.metadata().and_then(|metadata| metadata.modified()).map(|time| time.elapsed());
            // Not every file system shares locks between machines, hence the age.
            age.is_ok_and(|age| age.is_ok_and(|age| age > LEFT))
        };
        let Ok(file) = File::open(entry.path()) else { continue };
        // The lock is held until the file is removed, so that a process that has just created the file waits.
        if is_ours && is_old(&file) && file.try_lock().is_ok() {
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// Fills `buffer` from byte `offset` on. Several threads may read one file at the same time.
///
/// # Errors
/// The operating system's refusal, or the end of the file before the buffer is full.
pub fn read_exact_at(file: &File, buffer: &mut [u8], offset: u64) -> io::Result<()> {
    #[cfg(unix)]
    {
        std::os::unix::fs::FileExt::read_exact_at(file, buffer, offset)
    }
    #[cfg(windows)]
    {
        let (mut buffer, mut offset) = (buffer, offset);
        while !buffer.is_empty() {
            match std::os::windows::fs::FileExt::seek_read(file, buffer, offset)? {
                0 => return Err(io::ErrorKind::UnexpectedEof.into()),
                n => {
                    buffer = &mut buffer[n..];
                    offset += n as u64;
                }
            }
        }
        Ok(())
    }
}

/// Writes `path`: `fill` writes a temporary file beside it, which is renamed after success. A failure leaves the
/// former file. The new file keeps the permissions of the former one; a write-protected file is refused. A symbolic
/// link stays and its target is replaced. A pipe or a device is written in place, since renaming would replace it.
/// After a power failure there is the former file or the whole new one.
///
/// # Errors
/// The error of `fill`, or the operating system's refusal to create, write or rename the file.
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
    let permissions = permissions_of(path)?;
    tidy(folder_of(path));
    // Created with the mode of an ordinary new file (the umask applies), not the private one of temporary files.
    let mut file = tempfile::Builder::new()
        .prefix(PREFIX)
        .make_in(folder_of(path), |path| begun(path, || create(path)))
        .map_err(|e| io::Error::from(e.kind()))?;
    let _unfinished = Watch(file.path().to_owned());
    if let Some(permissions) = permissions
        && file.as_file().metadata()?.permissions() != permissions
    {
        file.as_file().set_permissions(permissions)?;
    }
    let mut out = BufWriter::with_capacity(1 << 20, file.as_file_mut());
    let filled = fill(&mut out).and_then(|()| Ok(out.flush()?));
    drop(out);
    // A name must not reach the disk before its data.
    let synced = filled.and_then(|()| Ok(file.as_file().sync_all()?));
    synced.and_then(|()| file.persist(path).map(drop).map_err(|e| e.error.into()))?;
    sync_folder(folder_of(path));
    Ok(())
}

/// Renames a file or a folder of files. Afterwards the new name and the data survive a power failure.
///
/// # Errors
/// The operating system's refusal.
pub fn rename(from: &Path, to: &Path) -> io::Result<()> {
    let files = fs::read_dir(from).into_iter().flatten().flatten().map(|entry| entry.path());
    for path in files.chain([from.to_owned()]) {
        // Not all systems can sync a file that is only open for reading.
        let _ = File::open(path).and_then(|file| file.sync_all());
    }
    fs::rename(from, to)?;
    sync_folder(folder_of(to));
    Ok(())
}

/// Syncs the names in a folder to the disk. Where a folder cannot be opened, the system writes the names later.
pub fn sync_folder(folder: &Path) {
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
}

/// Whether `path` exists and is neither a regular file nor a folder.
pub fn is_special(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir())
}

/// Permissions of the file that is to be replaced, if there is one.
fn permissions_of(path: &Path) -> io::Result<Option<fs::Permissions>> {
    match fs::metadata(path) {
        Ok(there) if there.permissions().readonly() => {
            Err(io::Error::new(io::ErrorKind::PermissionDenied, "is write-protected"))
        }
        Ok(there) => Ok(Some(there.permissions())),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        // A name that is too long, or a cycle of links.
        Err(e) => Err(e),
    }
}

/// Follows symbolic links. The target need not exist.
pub fn target_of(path: &Path) -> PathBuf {
    /// Most links that are followed, since links may form a cycle.
    const LINKS: usize = 40;
    let mut path = path.to_owned();
    for _ in 0..LINKS {
        let Ok(target) = fs::read_link(&path) else { break };
        path = folder_of(&path).join(target);
    }
    path
}

/// Checks, before any work, that `path` can be written: a file can be created in its folder, and an existing file is
/// not write-protected. A pipe or a device is not opened, since its reader would notice.
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
    let path = &target_of(path);
    permissions_of(path)?;
    tempfile::tempfile_in(folder_of(path)).map(drop)
}

/// Opens a regular file for reading. Pipes and devices are refused: reading them may block or never end.
///
/// # Errors
/// The operating system's refusal, or that `path` is no regular file.
pub fn open(path: &Path) -> io::Result<File> {
    let metadata = fs::metadata(path)?;
    if metadata.is_dir() {
        return Err(io::Error::new(io::ErrorKind::IsADirectory, "is a directory"));
    }
    if !metadata.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "is no regular file"));
    }
    File::open(path)
}

/// The content of a regular file of at most `limit` bytes.
///
/// # Errors
/// As [`open`], or that the file is longer.
pub fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, format!("has more than {limit} bytes")));
    }
    Ok(bytes)
}

/// The text of a regular file of at most `limit` bytes.
///
/// # Errors
/// As [`read`], or that the file is not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    let text = String::from_utf8(read(path, limit)?);
    text.map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "is no text (UTF-8)"))
}

/// The folder that contains `path`.
pub fn folder_of(path: &Path) -> &Path {
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
    fn what_a_killed_run_left_is_removed_and_what_is_being_written_is_not() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let [path, left, other] =
            ["a.txt", ".snapsnap-aBc123", ".snapsnap-notes"].map(|name| folder.path().join(name));
        let old = |path: &Path| {
            let time = std::time::SystemTime::now() - 2 * LEFT;
            File::options().append(true).open(path).and_then(|f| f.set_modified(time)).expect("sets");
        };
        for path in [&left, &other] {
            fs::write(path, "half").expect("write");
            old(path);
        }
        write_whole::<io::Error>(&path, |out| {
            assert!(!left.exists() && other.exists());
            // A file that is being written stays, however old it is.
            for entry in fs::read_dir(folder.path()).expect("lists") {
                old(&entry.expect("entry").path());
            }
            // As if another run began now.
            TIDIED.lock().unwrap_or_else(PoisonError::into_inner).clear();
            tidy(folder.path());
            out.write_all(b"whole")
        })
        .expect("writes");
        assert_eq!(fs::read_to_string(&path).expect("read"), "whole");
    }

    #[test]
    fn only_regular_files_of_a_sensible_length_are_read() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("a.txt");
        fs::write(&path, "12345").expect("write");
        assert_eq!(read_text(&path, 5).expect("reads"), "12345");
        assert_eq!(read(&path, 4).expect_err("refuses").to_string(), "has more than 4 bytes");
        assert_eq!(open(folder.path()).expect_err("refuses").kind(), io::ErrorKind::IsADirectory);
    }

    #[test]
    fn a_missing_folder_and_a_directory_are_refused_before_any_work() {
        let folder = tempfile::tempdir().expect("temporary folder");
        assert!(check_writable(&folder.path().join("no/such/file")).is_err());
        assert!(check_writable(folder.path()).is_err());
        assert!(check_writable(&folder.path().join("long".repeat(64))).is_err());
        assert!(check_writable(&folder.path().join("new")).is_ok());
        assert_eq!(fs::read_dir(folder.path()).expect("list").count(), 0);
    }
}
