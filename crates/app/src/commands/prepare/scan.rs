//! `snapsnap prepare scan`.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use clap::Args;
use snapsnap_base::FileError;
use snapsnap_data::dataset::Split;
use snapsnap_data::scan::{Collection, Source, find};
use snapsnap_data::smplx;
use snapsnap_mesh::import;

use super::{Common, Person, SPLITS, Work, make};
use crate::arguments::one_of;
use crate::failure::Failure;
use crate::say;

const THUMAN20: &str = "Subjects 0 to 525. Subjects of the published validation list become val";
const THUMAN21: &str =
    "THuman2.0 and the subjects from 526 on. The published subjects in loose clothes become test";
const COLLECTIONS: [(&str, &str, Collection); 6] = [
    ("thuman2.0", THUMAN20, Collection::Thuman20),
    ("thuman2.1", THUMAN21, Collection::Thuman21),
    ("customhumans", "", Collection::CustomHumans),
    ("2k2k", "", Collection::TwoK2K),
    ("4d-dress", "", Collection::FourDDress),
    ("other", "Any scan, y up and facing +z", Collection::Other),
];

#[derive(Args)]
pub struct Arguments {
    /// A scan, or a folder of scans.
    source: PathBuf,
    #[command(flatten)]
    common: Common,
    /// Collection of the scans. It decides axes, positions and splits.
    #[arg(long, value_parser = one_of(COLLECTIONS), default_value = "other")]
    collection: Collection,
    /// Folder of SMPL-X parameters (ID/smplx_param.pkl or ID.pkl), which contain the direction that a subject faces
    /// [default: the scan's folder].
    #[arg(long, value_name = "DIR")]
    smplx: Option<PathBuf>,
    /// Split of all subjects [default: the published lists; the first 100 of 2K2K and all of 4D-Dress test, others
    /// train].
    #[arg(long, value_parser = one_of(SPLITS))]
    split: Option<Split>,
    /// Leave out the subjects of other splits.
    #[arg(long, value_parser = one_of(SPLITS), value_name = "SPLIT", conflicts_with = "split")]
    only: Option<Split>,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let Arguments { collection, only, .. } = *arguments;
    let (sources, works): (Vec<Source>, Vec<Work>) = find(&arguments.source)?
        .into_iter()
        .enumerate()
        .map(|(place, source)| {
            let subject = source.subject.clone();
            let split = arguments.split.unwrap_or_else(|| collection.split(&subject, place));
            let identity = format!("scan/{}/{split}/{subject}", arguments.common.seed);
            (source, Work { split, subject, identity })
        })
        .filter(|(_, work)| only.is_none_or(|only| work.split == only))
        .unzip();
    if works.is_empty() {
        let message = "none of its scans is in the split that --only names";
        return Err(FileError::unsuitable(&arguments.source, message).into());
    }
    let config = arguments.common.config()?;
    let description = describe(arguments);
    let mut inputs = vec![arguments.source.as_path()];
    inputs.extend(arguments.smplx.as_deref());
    let unknown = Cell::new(0);
    let made = make(&arguments.common, &config, &description, &inputs, &works, |place, work| {
        let path = &sources[place].path;
        // A test of a person who was trained on would not be fair.
        let is_in = |split: Split| arguments.common.pictures(split, &work.subject).exists();
        if let Some(other) = Split::ALL.into_iter().find(|other| *other != work.split && is_in(*other)) {
            let message = format!("subject {} is in {other} already", work.subject);
            return Err(FileError::unsuitable(path, message));
        }
        let collection = collection.of(&work.subject);
        let parameters = parameters(path, &work.subject, arguments.smplx.as_deref())?;
        let needs_parameters = collection.has_orientation() || arguments.smplx.is_some();
        let yaw_degrees = match parameters.filter(|_| needs_parameters) {
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
    // Without the folders of the path, which differ between machines.
    let path = arguments.source.canonicalize().unwrap_or_else(|_| arguments.source.clone());
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let collection = COLLECTIONS.iter().find(|(.., collection)| *collection == arguments.collection);
    let collection = collection.map_or("", |(name, ..)| name);
    let smplx = if arguments.smplx.is_some() { ", with SMPL-X parameters" } else { "" };
    format!("scans of {name} ({collection}{smplx}), seed {}", arguments.common.seed)
}

/// Path of the subject's SMPL-X parameters. It is an error if `folder` is given and has none.
fn parameters(scan: &Path, subject: &str, folder: Option<&Path>) -> Result<Option<PathBuf>, FileError> {
    const NAME: &str = "smplx_param.pkl";
    let Some(folder) = folder else {
        return Ok(Some(scan.with_file_name(NAME)).filter(|path| path.is_file()));
    };
    let stem = scan.file_stem().unwrap_or_default().to_string_lossy();
    let within = |name: &str| [folder.join(name).join(NAME), folder.join(format!("{name}.pkl"))];
    match [&*stem, subject].into_iter().flat_map(within).find(|path| path.is_file()) {
        Some(found) => Ok(Some(found)),
        None => Err(FileError::unsuitable(folder, format!("has no SMPL-X parameters of subject {subject}"))),
    }
}
