//! `snapsnap prepare scan`.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use snapsnap_base::FileError;
use snapsnap_data::dataset::Split;
use snapsnap_data::scan::{Collection, Source, find};
use snapsnap_data::smplx;
use snapsnap_mesh::import;

use super::{Common, Person, SplitArgument, Work, make};
use crate::failure::Failure;
use crate::say;

#[derive(Clone, Copy, ValueEnum)]
enum CollectionArgument {
    /// Subjects 0 to 525. Subjects of the published validation list become val.
    #[value(name = "thuman2.0")]
    Thuman20,
    /// THuman2.0 and the subjects from 526 on. The published subjects in loose clothes become test.
    #[value(name = "thuman2.1")]
    Thuman21,
    #[value(name = "customhumans")]
    CustomHumans,
    #[value(name = "2k2k")]
    TwoK2K,
    #[value(name = "4d-dress")]
    FourDDress,
    /// Any scan, y up and facing +z.
    Other,
}

impl From<CollectionArgument> for Collection {
    fn from(collection: CollectionArgument) -> Self {
        match collection {
            CollectionArgument::Thuman20 => Self::Thuman20,
            CollectionArgument::Thuman21 => Self::Thuman21,
            CollectionArgument::CustomHumans => Self::CustomHumans,
            CollectionArgument::TwoK2K => Self::TwoK2K,
            CollectionArgument::FourDDress => Self::FourDDress,
            CollectionArgument::Other => Self::Other,
        }
    }
}

#[derive(Args)]
pub struct Arguments {
    /// A scan, or a folder of scans.
    source: PathBuf,
    #[command(flatten)]
    common: Common,
    /// Collection of the scans. It decides axes, positions and splits.
    #[arg(long, value_enum, default_value = "other")]
    collection: CollectionArgument,
    /// Folder of SMPL-X parameters (ID/smplx_param.pkl, ID.pkl or .json), which contain the direction that a subject
    /// faces [default: the scan's folder].
    #[arg(long, value_name = "DIR")]
    smplx: Option<PathBuf>,
    /// Split of all subjects [default: the published lists; the first 100 of 2K2K and all of 4D-Dress test, others
    /// train].
    #[arg(long, value_enum)]
    split: Option<SplitArgument>,
    /// Leave out the subjects of other splits.
    #[arg(long, value_enum, value_name = "SPLIT", conflicts_with = "split")]
    only: Option<SplitArgument>,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let collection = Collection::from(arguments.collection);
    let sources = find(&arguments.source)?;
    let only = arguments.only.map(Split::from);
    let (sources, works): (Vec<Source>, Vec<Work>) = sources
        .into_iter()
        .enumerate()
        .map(|(place, source)| {
            let subject = source.subject.clone();
            let split = arguments.split.map_or_else(|| collection.split(&subject, place), Split::from);
            let identity = format!("scan/{}/{split}/{subject}", arguments.common.seed);
            (source, Work { split, subject, identity })
        })
        .filter(|(_, work)| only.is_none_or(|only| work.split == only))
        .unzip();
    if works.is_empty() {
        let message = "none of its scans is in the split that --only names";
        return Err(FileError::unsuitable(&arguments.source, message).into());
    }
    let description = describe(arguments);
    let mut inputs = vec![arguments.source.as_path()];
    inputs.extend(arguments.smplx.as_deref());
    let unknown = Cell::new(0);
    let made = make(&arguments.common, quiet, &description, &inputs, &works, |place, work| {
        let path = &sources[place].path;
        // A test of a person who was trained on would not be fair.
        let is_in = |split: Split| arguments.common.pictures(split, &work.subject).exists();
        if let Some(other) = Split::ALL.into_iter().find(|other| *other != work.split && is_in(*other)) {
            let message = format!("subject {} is in {other} already", work.subject);
            return Err(FileError::unsuitable(path, message));
        }
        let collection = collection.of(&work.subject);
        let parameters = parameters(path, &work.subject, arguments.smplx.as_deref())?;
        let yaw_degrees =
            match parameters.filter(|_| collection.has_orientation() || arguments.smplx.is_some()) {
                Some(parameters) => smplx::yaw_degrees(&parameters)?,
                None => {
                    unknown.set(unknown.get() + usize::from(collection.has_orientation()));
                    0.0
                }
            };
        let mut mesh = import::read(path)?;
        super::place(&mut mesh, work, collection, path)?;
        Ok(Person { mesh, yaw_degrees, origin: path.clone() })
    });
    if unknown.get() > 0 {
        say::err(&format!(
            "{} subjects have no SMPL-X parameters and are assumed to face +z; with --smplx, make them again in another folder",
            unknown.get()
        ));
    }
    made
}

/// The source in the data set's description: everything on which the subjects depend.
fn describe(arguments: &Arguments) -> String {
    // Without the path, which differs from machine to machine.
    let path = arguments.source.canonicalize().unwrap_or_else(|_| arguments.source.clone());
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let collection =
        arguments.collection.to_possible_value().map_or(String::new(), |v| v.get_name().to_owned());
    let smplx = if arguments.smplx.is_some() { ", with SMPL-X parameters" } else { "" };
    format!("scans of {name} ({collection}{smplx}), seed {}", arguments.common.seed)
}

/// Path of the subject's SMPL-X parameters. It is an error if `folder` is given and has none.
fn parameters(scan: &Path, subject: &str, folder: Option<&Path>) -> Result<Option<PathBuf>, FileError> {
    let stem = scan.file_stem().unwrap_or_default();
    let names = [stem.to_string_lossy().into_owned(), subject.to_owned()];
    let beside = scan.parent().unwrap_or(Path::new("."));
    let mut candidates = Vec::new();
    match folder {
        Some(folder) => {
            for name in &names {
                let below = folder.join(name);
                candidates.extend(["smplx_param.pkl", "smplx_param.json"].map(|file| below.join(file)));
                candidates.extend(["pkl", "json"].map(|kind| folder.join(format!("{name}.{kind}"))));
            }
        }
        None => candidates.extend(["smplx_param.pkl", "smplx_param.json"].map(|file| beside.join(file))),
    }
    let found = candidates.into_iter().find(|path| path.is_file());
    match (folder, &found) {
        (Some(folder), None) => {
            Err(FileError::unsuitable(folder, format!("has no SMPL-X parameters of subject {subject}")))
        }
        _ => Ok(found),
    }
}
