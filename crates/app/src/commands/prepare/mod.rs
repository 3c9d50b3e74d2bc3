//! `snapsnap prepare`: renders data sets of scanned or generated people.

mod check;
mod makehuman;
mod preview;
mod scan;
mod synth;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use snapsnap_base::FileError;
use snapsnap_base::config::Schema;
use snapsnap_base::file;
use snapsnap_base::random::stream;
use snapsnap_data::dataset::{Folder, Made, Split};
use snapsnap_data::prepare::{DataConfig, Shard, Subject};
use snapsnap_data::scan::{Collection, normalise};
use snapsnap_mesh::export;
use snapsnap_mesh::mesh::Mesh;

use crate::failure::Failure;
use crate::progress::Progress;
use crate::{output, say};

/// Name of the config in force, beside the data.
const CONFIG: &str = "prepare.config.toml";
/// Most people of one call.
const MAX_SUBJECTS: usize = 1_000_000;

#[derive(Args)]
pub struct Arguments {
    #[command(subcommand)]
    kind: Kind,
}

#[derive(Subcommand)]
enum Kind {
    /// Render scans, OBJ, PLY or GLB, into a data set.
    #[command(
        after_help = "Example: snapsnap prepare scan path/to/scans --split train --config configs/data/small.toml -o people/scans"
    )]
    Scan(scan::Arguments),
    /// Make people of simple shapes in clothes with fine patterns.
    #[command(
        after_help = "Example: snapsnap prepare synth --subjects 300 --seed 1 --config configs/data/small.toml -o people/synth"
    )]
    Synth(synth::Arguments),
    /// Make people from MakeHuman's free data.
    #[command(
        after_help = "Example: snapsnap prepare makehuman path/to/makehuman/data --subjects 300 --seed 2 -o people/makehuman"
    )]
    Makehuman(makehuman::Arguments),
    /// List the faults of a data set.
    #[command(after_help = "Example: snapsnap prepare check people/synth")]
    Check(check::Arguments),
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    match &arguments.kind {
        Kind::Scan(arguments) => scan::run(arguments, quiet),
        Kind::Synth(arguments) => synth::run(arguments, quiet),
        Kind::Makehuman(arguments) => makehuman::run(arguments, quiet),
        Kind::Check(arguments) => check::run(arguments, quiet),
    }
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SplitArgument {
    /// For training.
    Train,
    /// For the choice of the best weights.
    Val,
    /// For reports.
    Test,
}

impl From<SplitArgument> for Split {
    fn from(split: SplitArgument) -> Self {
        match split {
            SplitArgument::Train => Self::Train,
            SplitArgument::Val => Self::Val,
            SplitArgument::Test => Self::Test,
        }
    }
}

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
    /// Folder of a subject's pictures.
    fn pictures(&self, split: Split, subject: &str) -> PathBuf {
        self.output.join(split.name()).join("img").join(subject)
    }

    fn config(&self) -> Result<DataConfig, Failure> {
        Ok(match &self.config {
            Some(path) => DataConfig::from_file(path, &self.set)?,
            None => DataConfig::from_toml("", "the built-in config", &self.set)?,
        })
    }
}

/// Refuses a sheet that is no PNG, or that lies in the data set or in its source.
fn check_preview(sheet: &Path, common: &Common, inputs: &[&Path]) -> Result<(), Failure> {
    let wrong = |problem: &str| Err(Failure::Input(format!("--preview {}: {problem}", sheet.display())));
    if !sheet.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")) {
        return wrong("must end in .png");
    }
    super::check_outputs(&[sheet], &[])?;
    let folder = sheet.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    for taken in inputs.iter().copied().chain([common.output.as_path()]) {
        // The folder of a scan contains its materials and textures.
        let taken = if taken.is_file() { taken.parent().unwrap_or(taken) } else { taken };
        let taken = if taken.as_os_str().is_empty() { Path::new(".") } else { taken };
        if taken.canonicalize().is_ok_and(|taken| taken.is_dir() && folder.starts_with(taken)) {
            return wrong("lies inside the data set or its source");
        }
    }
    Ok(())
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
    quiet: bool,
    source: &str,
    inputs: &[&Path],
    works: &[Work],
    person: impl Fn(usize, &Work) -> Result<Person, FileError>,
) -> Result<(), Failure> {
    let config = common.config()?;
    if let Some(sheet) = &common.preview {
        check_preview(sheet, common, inputs)?;
    }
    let folder = Folder::create(&common.output, config.description(source))?;
    let (path, resolved) = (common.output.join(CONFIG), config.to_toml());
    let given = common.config.as_deref().is_some_and(|given| super::is_same_file(given, &path));
    if !given && fs::read(&path).ok().as_deref() != Some(resolved.as_bytes()) {
        output::write(&path, resolved.as_bytes())?;
    }
    let mine: Vec<(usize, &Work)> =
        works.iter().enumerate().filter(|(place, _)| common.shard.has(*place)).collect();
    let missing: Vec<&(usize, &Work)> =
        mine.iter().filter(|(_, work)| !folder.has(work.split, &work.subject)).collect();
    if missing.len() < mine.len() && !quiet {
        say::err(&format!("{} of {} subjects are there already", mine.len() - missing.len(), mine.len()));
    }
    let progress = Progress::steps(quiet, missing.len(), "subjects");
    let (mut failed, mut elsewhere) = (0, 0);
    for (done, (place, work)) in missing.iter().enumerate() {
        progress.step(done, missing.len(), "subjects");
        let Work { split, subject, identity } = work;
        let made = person(*place, work).and_then(|Person { mesh, yaw_degrees, origin }| {
            let subject = Subject { split: *split, name: subject, identity, yaw_degrees, origin: &origin };
            config.add(&folder, &subject, &mesh)
        });
        match made {
            Ok(Made::Whole) => {}
            Ok(Made::Elsewhere) => elsewhere += 1,
            // The program is ending. The subject's error is no fault of the subject.
            Err(_) if file::is_ending() => std::thread::sleep(Duration::from_secs(60)),
            // The next subjects could not be written either.
            Err(e @ FileError::Write { .. }) => return Err(e.into()),
            Err(e) => {
                failed += 1;
                say::err(&format!("skipped {subject}: {e}"));
            }
        }
    }
    progress.step(missing.len(), missing.len(), "subjects");
    drop(progress);
    folder.tidy();
    if elsewhere > 0 {
        say::err(&format!("{elsewhere} subjects are being made by another run"));
    }
    let there: Vec<(Split, &str)> = works
        .iter()
        .map(|work| (work.split, work.subject.as_str()))
        .filter(|(split, subject)| folder.has(*split, subject))
        .collect();
    if let Some(sheet) = common.preview.as_deref().filter(|_| !there.is_empty()) {
        preview::write(sheet, &folder, &there)?;
    }
    if failed > 0 {
        let message =
            format!("{failed} of {} subjects could not be made; the others are there", missing.len());
        return Err(Failure::Input(message));
    }
    Ok(())
}

/// Options of the commands that generate people.
#[derive(Args)]
struct Generate {
    /// Number of people.
    #[arg(long, value_name = "N", default_value_t = 100)]
    subjects: usize,
    /// Split of the people. Different splits have different people.
    #[arg(long, value_enum, default_value = "train")]
    split: SplitArgument,
    /// Also write each person as a scan, OBJ with texture, to scans/SPLIT/ID in the data set.
    #[arg(long)]
    save_scans: bool,
}

/// Generates people from their names.
fn generate(
    common: &Common,
    generate: &Generate,
    quiet: bool,
    kind: &str,
    inputs: &[&Path],
    person: impl Fn(&str) -> Result<Mesh, FileError>,
) -> Result<(), Failure> {
    if generate.subjects == 0 || generate.subjects > MAX_SUBJECTS {
        let message = format!("--subjects is {}, must be 1 to {MAX_SUBJECTS}", generate.subjects);
        return Err(Failure::Input(message));
    }
    let split = Split::from(generate.split);
    let works: Vec<Work> = (0..generate.subjects)
        .map(|index| Work {
            split,
            subject: format!("{index:04}"),
            identity: format!("{kind}/{}/{split}/{index}", common.seed),
        })
        .collect();
    let source = format!("{kind}, seed {}", common.seed);
    let scan = |work: &Work| {
        let Work { split, subject, .. } = work;
        common.output.join("scans").join(split.name()).join(subject).join(format!("{subject}.obj"))
    };
    // A scan that exists may have been edited.
    let is_due = |work: &Work| generate.save_scans && !scan(work).exists();
    let made = make(common, quiet, &source, inputs, &works, |_, work| {
        let mut mesh = person(&work.identity)?;
        if is_due(work) {
            export::write_obj(&mesh, &scan(work))?;
        }
        place(&mut mesh, work, Collection::Other, &common.output)?;
        Ok(Person { mesh, yaw_degrees: 0.0, origin: common.output.clone() })
    });
    // Older subjects without scans.
    let there = |work: &Work| common.pictures(work.split, &work.subject).is_dir();
    let mine = works
        .iter()
        .enumerate()
        .filter(|(place, work)| common.shard.has(*place) && is_due(work) && there(work));
    let due: Vec<&Work> = mine.map(|(_, work)| work).collect();
    if due.is_empty() {
        return made;
    }
    let progress = Progress::steps(quiet, due.len(), "scans");
    for (done, work) in due.iter().enumerate() {
        progress.step(done, due.len(), "scans");
        export::write_obj(&person(&work.identity)?, &scan(work))?;
    }
    progress.step(due.len(), due.len(), "scans");
    made
}

/// Normalises the mesh for the cameras. Training subjects get a random offset, seeded by their names.
fn place(mesh: &mut Mesh, work: &Work, collection: Collection, origin: &Path) -> Result<(), FileError> {
    let mut random = stream(&format!("place/{}", work.identity));
    let jitter = (work.split == Split::Train).then_some(&mut random);
    normalise(mesh, collection, jitter).map_err(|e| FileError::unsuitable(origin, e))
}
