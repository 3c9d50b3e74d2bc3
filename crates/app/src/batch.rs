//! Many inputs of one command: what is there already is skipped, what fails is listed in a file, and the rest goes on.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use clap::Args;
use snapsnap_base::file;
use snapsnap_data::prepare::Shard;
use snapsnap_splat::scene::Kind;

use crate::commands::{is_same_file, is_same_folder, one_of};
use crate::failure::{Failure, bail};
use crate::output::{make_folder, remove};
use crate::progress::Progress;
use crate::say;

const KINDS: [(&str, &str, Kind); 4] = [
    ("ply", "3D Gaussian splatting PLY", Kind::Ply),
    ("spz", "an eighth as large", Kind::Spz),
    ("glb", "KHR_gaussian_splatting", Kind::Glb),
    ("sog", "PlayCanvas", Kind::Sog),
];

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
    kind: Option<Kind>,
}

impl KindArgument {
    /// The extension of the files.
    pub fn extension(&self) -> &'static str {
        KINDS.iter().find(|(.., kind)| Some(*kind) == self.kind).map_or("ply", |(name, ..)| name)
    }

    /// Refuses the option in a command with one input.
    pub fn must_be_unused(&self, shard: &ShardArgument, why: &str) -> Result<(), Failure> {
        match (self.kind.is_some(), shard.shard.is_some()) {
            (true, _) => bail!("--kind: {why}"),
            (_, true) => bail!("--shard: {why}"),
            _ => Ok(()),
        }
    }
}

/// The results of a command in one folder.
pub struct Batch {
    folder: PathBuf,
    shard: Option<Shard>,
    /// The list of what failed, from the first failure on.
    list: Option<csv::Writer<File>>,
    failed: usize,
}

impl Batch {
    /// Makes the folder, and removes the list of an earlier run of the same part, which must not be `input`.
    pub fn new(folder: &Path, shard: &ShardArgument, input: &Path) -> Result<Self, Failure> {
        make_folder(folder)?;
        let batch = Self { folder: folder.to_owned(), shard: shard.shard, list: None, failed: 0 };
        if is_same_file(input, &batch.path()) {
            return Err(Failure::file(input, "is an input of this command and would be overwritten"));
        }
        remove(&batch.path())?;
        Ok(batch)
    }

    /// The list of what failed.
    fn path(&self) -> PathBuf {
        let name = self.shard.map_or("errors.csv".into(), |shard| format!("errors-{}.csv", shard.name()));
        self.folder.join(name)
    }

    /// The jobs of this part whose file `output` is not there yet.
    pub fn missing<T>(&self, jobs: Vec<T>, output: impl Fn(&T) -> PathBuf) -> Vec<T> {
        let all = jobs.into_iter().enumerate();
        let mine = all.filter(|(place, _)| self.shard.is_none_or(|shard| shard.has(*place)));
        let (there, missing): (Vec<T>, Vec<T>) =
            mine.map(|(_, job)| job).partition(|job| output(job).exists());
        if !there.is_empty() {
            say::note(&format!("{} of {} are there already", there.len(), there.len() + missing.len()));
        }
        missing
    }

    /// Lists a failure. An output that cannot be written ends the command, since the next ones could not be written either.
    pub fn failed(&mut self, name: &str, failure: Failure) -> Result<(), Failure> {
        if matches!(failure, Failure::Write(_)) {
            return Err(failure);
        }
        // The program is ending, which causes errors.
        if file::is_ending() {
            std::thread::sleep(std::time::Duration::from_secs(60));
        }
        let path = self.path();
        let wrong = |e: csv::Error| Failure::cannot_write(&path, &e.into());
        if self.list.is_none() {
            let mut list =
                csv::Writer::from_writer(File::create(&path).map_err(|e| Failure::cannot_write(&path, &e))?);
            list.write_record(["name", "error"]).map_err(wrong)?;
            self.list = Some(list);
        }
        let list = self.list.as_mut().expect("was just opened");
        list.write_record([name, &failure.to_string()]).map_err(wrong)?;
        list.flush().map_err(|e| Failure::cannot_write(&path, &e))?;
        self.failed += 1;
        say::err(&format!("{name}: {failure}"));
        Ok(())
    }

    /// Ends the command, with a failure if one of its `count` jobs failed.
    pub fn end(self, count: usize) -> Result<(), Failure> {
        if self.failed == 0 {
            say::info(&format!("{}: {count} made", self.folder.display()));
            return Ok(());
        }
        let message = format!("{} of {count} failed; the others are there", self.failed);
        Err(Failure::Internal(format!("{}: {message}", self.path().display())))
    }
}

/// Runs `work` on every file of Gaussians in a folder, with its name without extension. Its result is `output(name)`, whose existence shows
/// that it is done.
pub fn each(
    folder: &Path,
    target: &Path,
    shard: &ShardArgument,
    output: impl Fn(&str) -> PathBuf,
    work: impl Fn(&Path, &str) -> Result<(), Failure>,
) -> Result<(), Failure> {
    if is_same_folder(folder, target) {
        return Err(Failure::file(target, "is the folder of the inputs: give another one"));
    }
    let scenes: Vec<(String, PathBuf)> = scenes(folder)?.into_iter().collect();
    let mut batch = Batch::new(target, shard, folder)?;
    let missing = batch.missing(scenes, |(name, _)| output(name));
    for (name, path) in Progress::over(missing.iter(), "files") {
        if let Err(failure) = work(path, name) {
            batch.failed(name, failure)?;
        }
    }
    batch.end(missing.len())
}

/// The files of Gaussians in a folder, by name without extension.
fn scenes(folder: &Path) -> Result<BTreeMap<String, PathBuf>, Failure> {
    let mut found = BTreeMap::new();
    for path in files(folder)? {
        let is_scene = Kind::named(&path).is_some_and(|kind| kind != Kind::Sog);
        let Some(name) = path.file_stem().and_then(|name| name.to_str()).filter(|_| is_scene) else {
            continue;
        };
        if let Some(other) = found.insert(name.to_owned(), path.clone()) {
            return Err(Failure::file(&path, format_args!("has the name of {}", other.display())));
        }
    }
    if found.is_empty() {
        return Err(Failure::file(folder, "has no PLY, SPZ or GLB"));
    }
    Ok(found)
}

/// The files in a folder.
pub fn files(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let cannot = |e: std::io::Error| Failure::file(folder, format_args!("cannot read: {e}"));
    let entries = fs::read_dir(folder).map_err(cannot)?.map(|entry| entry.map(|entry| entry.path()));
    let entries = entries.collect::<Result<Vec<_>, _>>().map_err(cannot)?;
    Ok(entries.into_iter().filter(|path| path.is_file()).collect())
}
