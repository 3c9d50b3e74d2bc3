//! Commands with many inputs: existing outputs are skipped, failures are listed in a file, and other inputs go on.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use clap::Args;
use snapsnap_base::folder::entries;
use snapsnap_base::{FileError, file};
use snapsnap_data::Shard;
use snapsnap_splat::scene::Kind;

use crate::arguments::one_of;
use crate::failure::Failure;
use crate::output::{make_folder, remove};
use crate::progress::Progress;
use crate::say;

const KINDS: [(&str, &str, Kind); 4] = [
    ("ply", "3D Gaussian splatting PLY", Kind::Ply),
    ("spz", "an eighth as large", Kind::Spz),
    ("glb", "KHR_gaussian_splatting", Kind::Glb),
    ("sog", "PlayCanvas", Kind::Sog),
];

/// Message for options of folders in a command for one file.
pub const ONE: &str = "is for a folder of many files";

/// The share of many inputs that one process makes.
#[derive(Args, Default, Clone)]
pub struct ShardArgument {
    /// With many inputs: make part I of N of them, from 0, so that several processes or machines share the work.
    #[arg(long, value_name = "I/N")]
    pub shard: Option<Shard>,
}

/// The kind of the files of Gaussians.
#[derive(Args, Default, Clone)]
pub struct KindArgument {
    /// With many inputs: kind of the files of Gaussians [default: ply].
    #[arg(long, value_parser = one_of(KINDS))]
    pub kind: Option<Kind>,
}

impl KindArgument {
    /// The extension of the files.
    pub fn extension(&self) -> &'static str {
        KINDS.iter().find(|(.., kind)| Some(*kind) == self.kind).map_or("ply", |(name, ..)| name)
    }
}

/// Refuses options that have no effect here. `given` says for each whether it is given.
pub fn must_be_unused(given: &[(&str, bool)], why: &str) -> Result<(), Failure> {
    match given.iter().find(|(_, is_given)| *is_given) {
        Some((name, _)) => Err(Failure::Input(format!("{name}: {why}"))),
        None => Ok(()),
    }
}

/// The results of a command in one folder.
pub struct Batch {
    folder: PathBuf,
    shard: Option<Shard>,
    /// The list of failures, from the first failure on.
    list: Option<csv::Writer<File>>,
    failed: usize,
    /// Number of consecutive internal errors.
    bugs: usize,
}

/// First line of a list of failures.
const HEADER: &str = "name,error";
/// Number of consecutive internal errors, for example of a lost GPU, after which a command ends.
const MOST_BUGS: usize = 5;

impl Batch {
    /// Makes the folder, and removes the list of an earlier run of the same shard. Refuses to remove another file.
    pub fn new(folder: &Path, shard: &ShardArgument) -> Result<Self, Failure> {
        make_folder(folder)?;
        let batch = Self { folder: folder.to_owned(), shard: shard.shard, list: None, failed: 0, bugs: 0 };
        let path = batch.path();
        if path.symlink_metadata().is_ok() {
            let mut start = [0; HEADER.len()];
            let read = file::open(&path).and_then(|mut there| there.read_exact(&mut start));
            if read.is_err() || start != *HEADER.as_bytes() {
                let message = "would be replaced by the list of failures, but is another file: move it away";
                return Err(Failure::file(&path, message));
            }
            remove(&path)?;
        }
        Ok(batch)
    }

    /// Path of the list of failures.
    fn path(&self) -> PathBuf {
        let name = self.shard.map_or("errors.csv".into(), |shard| format!("errors-{}.csv", shard.name()));
        self.folder.join(name)
    }

    /// The jobs of this shard whose file `output` does not exist yet or is empty.
    pub fn missing<T>(&self, jobs: Vec<T>, output: impl Fn(&T) -> PathBuf) -> Vec<T> {
        let all = jobs.into_iter().enumerate();
        let mine = all.filter(|(place, _)| self.shard.is_none_or(|shard| shard.has(*place)));
        let (there, missing): (Vec<T>, Vec<T>) = mine
            .map(|(_, job)| job)
            .partition(|job| output(job).metadata().is_ok_and(|there| there.len() > 0));
        if !there.is_empty() {
            let (kept, all) = (there.len(), there.len() + missing.len());
            say::note(&format!("{kept} of {all} outputs exist already and are kept"));
        }
        missing
    }

    /// Lists a failure. An output that cannot be written ends the command, since later outputs would fail as well.
    pub fn failed(&mut self, name: &str, failure: Failure) -> Result<(), Failure> {
        // The program is ending, which causes errors.
        if file::is_ending() {
            thread::sleep(Duration::from_secs(60));
        }
        if matches!(failure, Failure::Write(_)) {
            return Err(failure);
        }
        let path = self.path();
        let wrong = |e: csv::Error| FileError::write(&path)(e.into());
        if self.list.is_none() {
            let mut list = csv::Writer::from_path(&path).map_err(wrong)?;
            list.write_record(HEADER.split(',')).map_err(wrong)?;
            self.list = Some(list);
        }
        let list = self.list.as_mut().expect("was just opened");
        // A spreadsheet would take some texts for formulas.
        let cell = |text: &str| {
            let is_formula = text.trim_start().starts_with(['=', '+', '-', '@']);
            format!("{}{}", if is_formula { "'" } else { "" }, say::printable(text))
        };
        list.write_record([cell(name), cell(&failure.to_string())]).map_err(wrong)?;
        list.flush().map_err(FileError::write(&path))?;
        self.failed += 1;
        say::err(&format!("{name}: {failure}"));
        self.bugs = if matches!(failure, Failure::Internal(_)) { self.bugs + 1 } else { 0 };
        if self.bugs == MOST_BUGS {
            return Err(Failure::Internal(format!("stopped after {MOST_BUGS} internal errors in a row")));
        }
        Ok(())
    }

    /// Ends the command, with a failure if one of its `count` jobs failed.
    pub fn end(self, count: usize) -> Result<(), Failure> {
        if self.failed == 0 {
            say::info(&format!("{}: {count} made", self.folder.display()));
            return Ok(());
        }
        let others = if self.failed < count { "; the others are there" } else { "" };
        let message = format!("{} of {count} failed{others}", self.failed);
        Err(Failure::Internal(format!("{}: {message}", self.path().display())))
    }
}

/// Turns a panic, whose message is printed, into a failure.
pub fn unpanicked<T>(work: impl FnOnce() -> Result<T, Failure>) -> Result<T, Failure> {
    let bug = |_| Err(Failure::Internal("a bug in this program; its message is above".into()));
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(bug)
}

/// Runs `work` on every file of Gaussians in a folder, with the file's name without extension. Files whose
/// `output(name)` exists are skipped.
pub fn each(
    folder: &Path,
    target: &Path,
    shard: &ShardArgument,
    output: impl Fn(&str) -> PathBuf,
    work: impl Fn(&Path, &str) -> Result<(), Failure>,
) -> Result<(), Failure> {
    if matches!([folder, target].map(Path::canonicalize), [Ok(a), Ok(b)] if a == b) {
        return Err(Failure::file(target, "is the folder of the inputs: give another one"));
    }
    let scenes = scenes(folder)?;
    let mut batch = Batch::new(target, shard)?;
    let missing = batch.missing(scenes, |(name, _)| output(name));
    for (name, path) in Progress::over(missing.iter(), "files") {
        if let Err(failure) = unpanicked(|| work(path, name)) {
            batch.failed(name, failure)?;
        }
    }
    batch.end(missing.len())
}

/// The files of Gaussians in a folder, by name without extension.
fn scenes(folder: &Path) -> Result<Vec<(String, PathBuf)>, Failure> {
    let mut found = BTreeMap::new();
    for path in files(folder)? {
        if Kind::named(&path).is_none_or(|kind| kind == Kind::Sog) {
            continue;
        }
        let name = stem(&path)?;
        // Some file systems do not tell upper from lower case.
        if let Some((_, other)) = found.insert(name.to_lowercase(), (name, path.clone())) {
            return Err(same_name(&path, &other));
        }
    }
    if found.is_empty() {
        return Err(Failure::file(folder, "has no PLY, SPZ or GLB"));
    }
    Ok(found.into_values().collect())
}

/// The failure of two files with one name.
pub fn same_name(path: &Path, other: &Path) -> Failure {
    Failure::file(path, format_args!("has the same name as {}: rename one of them", other.display()))
}

/// A file's name without extension.
pub fn stem(path: &Path) -> Result<String, Failure> {
    let name = path.file_stem().and_then(|name| name.to_str()).map(str::to_owned);
    name.ok_or_else(|| Failure::file(path, "its name is not UTF-8: rename the file"))
}

/// Extensions of pictures.
const PICTURES: [&str; 11] =
    ["jpg", "jpeg", "png", "webp", "tif", "tiff", "bmp", "gif", "heic", "heif", "hif"];

/// The pictures in a folder that are not hidden.
pub fn pictures(folder: &Path) -> Result<impl Iterator<Item = PathBuf>, Failure> {
    let is_picture = |path: &PathBuf| {
        let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
        extension.is_some_and(|extension| PICTURES.contains(&extension.as_str()))
    };
    Ok(files(folder)?.into_iter().filter(is_picture))
}

/// The files in a folder that are not hidden.
fn files(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    Ok(entries(folder)?.into_iter().filter(|path| path.is_file()).collect())
}
