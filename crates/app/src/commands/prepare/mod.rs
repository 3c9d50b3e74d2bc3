//! `snapsnap prepare`: renders data sets of scanned or generated people, checks data sets.

mod generate;
mod preview;
mod scan;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand};
use snapsnap_base::FileError;
use snapsnap_base::config::Schema;
use snapsnap_base::file;
use snapsnap_base::random::stream;
use snapsnap_data::Shard;
use snapsnap_data::dataset::{self, Folder, Split};
use snapsnap_data::prepare::{DataConfig, Subject};
use snapsnap_data::scan::{Collection, normalise};
use snapsnap_mesh::mesh::Mesh;

use crate::failure::{Failure, bail};
use crate::output::{check_folder, check_outputs, check_settings, is_same_file, outside_data};
use crate::progress::Progress;
use crate::{output, say};

use generate::Generate;

/// Name of the resolved config in the data set.
const CONFIG: &str = "prepare.config.toml";

#[derive(Subcommand)]
pub enum Kind {
    /// Render scans, OBJ, PLY or GLB, into a data set.
    #[command(
        after_help = "Example: snapsnap prepare scan path/to/scans --split train --config configs/data/small.toml -o people/scans"
    )]
    Scan(scan::Arguments),
    /// Make people of simple shapes in clothes with fine patterns.
    #[command(
        after_help = "Example: snapsnap prepare synth --subjects 300 --seed 1 --config configs/data/small.toml -o people/synth"
    )]
    Synth(Generate),
    /// Make people from MakeHuman's free data.
    #[command(
        after_help = "Example: snapsnap prepare makehuman path/to/makehuman/data --subjects 300 --seed 2 -o people/makehuman"
    )]
    Makehuman {
        /// MakeHuman's folder `data`, or a checkout that contains it.
        folder: PathBuf,
        #[command(flatten)]
        generate: Generate,
    },
    /// Make people from rigged characters.
    #[command(
        after_help = "Example: snapsnap prepare avatars path/to/characters --subjects 300 --seed 3 -o people/avatars"
    )]
    Avatars {
        /// Folder of rigged characters, GLB, with the joint names of Mixamo or MakeHuman. Files whose names are equal up to
        /// the last `_` show one person. Of nine people, one is for test and one for val.
        folder: PathBuf,
        #[command(flatten)]
        generate: Generate,
    },
    /// List the faults of a data set.
    #[command(after_help = "Example: snapsnap prepare check people/synth")]
    Check {
        /// Folder of the data set, in this program's layout or in the layout of the authors' tools.
        dataset: PathBuf,
    },
}

pub fn run(kind: &Kind) -> Result<(), Failure> {
    match kind {
        Kind::Scan(arguments) => scan::run(arguments),
        Kind::Synth(generate) => generate::synth(generate),
        Kind::Makehuman { folder, generate } => generate::makehuman(folder, generate),
        Kind::Avatars { folder, generate } => generate::avatars(folder, generate),
        Kind::Check { dataset } => check(dataset),
    }
}

fn check(folder: &Path) -> Result<(), Failure> {
    let checked = dataset::check(folder, Progress::counted("subjects"))?;
    for problem in &checked.problems {
        say::out(problem);
    }
    let looked = format!("{} subjects, {} views", checked.subjects, checked.views);
    if !checked.problems.is_empty() {
        return Err(Failure::Input(format!("{looked}: {} faults", checked.problems.len())));
    }
    say::info(&format!("{looked}: no fault"));
    Ok(())
}

const SPLITS: [(&str, &str, Split); 3] = [
    ("train", "For training", Split::Train),
    ("val", "For the choice of the best weights", Split::Val),
    ("test", "For reports", Split::Test),
];

/// Options of all commands that make a data set.
#[derive(Args)]
struct Common {
    /// Folder of the data set. Subjects that it contains already are kept.
    #[arg(short, long, value_name = "DATASET")]
    output: PathBuf,
    /// Views and cameras, as in configs/data [default: 24 views of 1024 pixels, lossless].
    #[arg(long, value_name = "TOML")]
    config: Option<PathBuf>,
    /// Override one config key; may be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Seed of everything that is random.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Only every n-th subject, from the i-th (counted from 0): to share the work among machines.
    #[arg(long, value_name = "i/n", default_value = "0/1")]
    shard: Shard,
    /// Also write one picture of the first subjects' front, back and side.
    #[arg(long, value_name = "SHEET.png")]
    preview: Option<PathBuf>,
}

impl Common {
    fn config(&self) -> Result<DataConfig, Failure> {
        Ok(match &self.config {
            Some(path) => DataConfig::from_file(path, &self.set)?,
            None => DataConfig::from_toml("", "the built-in config", &self.set)?,
        })
    }

    /// Folder of a subject's pictures.
    fn pictures(&self, split: Split, subject: &str) -> PathBuf {
        self.output.join(split.name()).join("img").join(subject)
    }

    /// The subjects of this shard, each with its place among all of them.
    fn mine<'a>(&self, works: &'a [Work]) -> Vec<(usize, &'a Work)> {
        works.iter().enumerate().filter(|(place, _)| self.shard.has(*place)).collect()
    }
}

/// Refuses a sheet that is no PNG, or that lies in the data set or in its source.
fn check_preview(sheet: &Path, common: &Common, inputs: &[&Path]) -> Result<(), Failure> {
    if !sheet.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")) {
        bail!("--preview {}: must end in .png", sheet.display());
    }
    let within = file::folder_of(sheet);
    if within.exists() {
        check_outputs(&[sheet], &[])?;
    } else {
        check_folder(within)?;
    }
    outside_data(sheet, inputs.iter().copied().chain([common.output.as_path()]))
}

/// One subject to be made.
struct Work {
    split: Split,
    /// Its name in the data set.
    subject: String,
    /// Its name among the subjects of all data sets. It seeds everything that is random about the subject.
    identity: String,
}

/// A subject, standing at the origin.
struct Person {
    mesh: Mesh,
    /// Direction in which it faces, degrees around y.
    yaw_degrees: f64,
    /// Its source.
    origin: PathBuf,
}

/// Makes this shard's missing subjects. A subject that cannot be made is reported and left out.
fn make(
    common: &Common,
    config: &DataConfig,
    source: &str,
    inputs: &[&Path],
    works: &[Work],
    person: impl Fn(usize, &Work) -> Result<Person, FileError>,
) -> Result<(), Failure> {
    if let Some(sheet) = &common.preview {
        check_preview(sheet, common, inputs)?;
    }
    let folder = Folder::create(&common.output, config.description(source))?;
    let is_begun =
        folder.splits().into_iter().any(|split| folder.subjects(split).is_ok_and(|all| !all.is_empty()));
    let (path, resolved) = (common.output.join(CONFIG), config.to_toml());
    // People that are there already have the cameras of this config; `dataset.toml` does not have all of them.
    if let (true, Ok(there)) = (is_begun, DataConfig::from_file(&path, &[])) {
        check_settings(&path, &there, config)?;
    }
    let given = common.config.as_deref().is_some_and(|given| is_same_file(given, &path));
    if !given && fs::read(&path).ok().as_deref() != Some(resolved.as_bytes()) {
        output::write(&path, resolved.as_bytes())?;
    }
    let has = |work: &Work| folder.has(work.split, &work.subject);
    let mine = common.mine(works);
    let missing: Vec<&(usize, &Work)> = mine.iter().filter(|(_, work)| !has(work)).collect();
    if missing.len() < mine.len() {
        say::note(&format!("{} of {} subjects are there already", mine.len() - missing.len(), mine.len()));
    }
    let (mut failed, mut elsewhere) = (0, 0);
    for (place, work) in Progress::over(missing.iter(), "subjects") {
        let Work { split, subject, identity } = work;
        let made = person(*place, work).and_then(|Person { mesh, yaw_degrees, origin }| {
            let subject = Subject { split: *split, name: subject, identity, yaw_degrees, origin: &origin };
            config.add(&folder, &subject, &mesh)
        });
        match made {
            Ok(is_whole) => elsewhere += u32::from(!is_whole),
            // The program is ending, which causes errors of subjects.
            Err(_) if file::is_ending() => std::thread::sleep(Duration::from_secs(60)),
            // The next subjects could not be written either.
            Err(e @ FileError::Write { .. }) => return Err(e.into()),
            Err(e) => {
                failed += 1;
                say::err(&format!("skipped {subject}: {e}"));
            }
        }
    }
    folder.tidy();
    if elsewhere > 0 {
        say::err(&format!("{elsewhere} subjects are being made by another run"));
    }
    let there: Vec<&Work> = works.iter().filter(|work| has(work)).collect();
    if let Some(sheet) = common.preview.as_deref().filter(|_| !there.is_empty()) {
        preview::write(sheet, &folder, &there)?;
    }
    if failed == 0 {
        return Ok(());
    }
    let all = missing.len();
    let others = if failed < all { "; the others are there" } else { "" };
    Err(Failure::Input(format!("{failed} of {all} subjects could not be made{others}")))
}

/// Normalises the mesh for the cameras. Training subjects get a random offset, seeded by their names.
fn place(mesh: &mut Mesh, work: &Work, collection: Collection, origin: &Path) -> Result<(), FileError> {
    let mut random = stream(&format!("place/{}", work.identity));
    let jitter = (work.split == Split::Train).then_some(&mut random);
    normalise(mesh, collection, jitter).map_err(|e| FileError::unsuitable(origin, e))
}
