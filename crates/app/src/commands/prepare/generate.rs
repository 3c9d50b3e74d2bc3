//! `snapsnap prepare synth`, `snapsnap prepare makehuman` and `snapsnap prepare avatars`.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use clap::Args;
use snapsnap_base::FileError;
use snapsnap_data::dataset::Split;
use snapsnap_data::scan::Collection;
use snapsnap_mesh::export;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_people::avatars::{Avatars, Character};
use snapsnap_people::makehuman::{self, Library};
use snapsnap_people::poses::Poses;
use snapsnap_people::{Detail, synth};

use super::{Common, Person, SPLITS, Work, make, place};
use crate::arguments::one_of;
use crate::failure::{Failure, bail};
use crate::progress::Progress;
use crate::say;

/// Largest number of people of one command.
const MAX_SUBJECTS: usize = 1_000_000;

/// Options of the commands that generate people.
#[derive(Args)]
pub struct Generate {
    #[command(flatten)]
    common: Common,
    /// Number of people.
    #[arg(long, value_name = "N", default_value_t = 100)]
    subjects: usize,
    /// Split of the people. Different splits have different people.
    #[arg(long, value_parser = one_of(SPLITS), default_value = "train")]
    split: Split,
    /// Folder of motion files (BVH) with the joint names of Mixamo or MakeHuman; three in ten people take one of their
    /// standing poses [default of makehuman: its own folder].
    #[arg(long, value_name = "DIR")]
    poses: Option<PathBuf>,
    /// Also write each person as a scan, OBJ with texture, to scans/SPLIT/ID in the data set, standing as its views show it.
    #[arg(long)]
    save_scans: bool,
}

pub fn synth(generate: &Generate) -> Result<(), Failure> {
    generate.run("synth", &[], |name, poses, detail| Ok(synth::person(name, poses, detail)))
}

pub fn makehuman(folder: &Path, generate: &Generate) -> Result<(), Failure> {
    let library = Library::open(folder)?;
    generate.run("makehuman", &[library.root()], |name, poses, detail| {
        makehuman::person(&library, name, poses, detail)
    })
}

pub fn avatars(folder: &Path, generate: &Generate) -> Result<(), Failure> {
    let avatars = Avatars::open(folder, |person| match person % 9 {
        0 => generate.split == Split::Test,
        4 => generate.split == Split::Val,
        _ => generate.split == Split::Train,
    })?;
    let animated = Cell::new(0);
    let person = |name: &str, poses: Option<&Poses>, _| {
        let Character { mesh, has_animations } = avatars.person(name, poses)?;
        animated.set(animated.get() + usize::from(has_animations));
        Ok(mesh)
    };
    let made = generate.run("avatars", &[folder], person);
    if animated.get() > 0 {
        say::note(&format!(
            "{} subjects come from files with morph targets or animations, which were ignored",
            animated.get()
        ));
    }
    made
}

impl Generate {
    /// Generates people from their names.
    fn run(
        &self,
        kind: &str,
        inputs: &[&Path],
        person: impl Fn(&str, Option<&Poses>, Detail) -> Result<Mesh, FileError>,
    ) -> Result<(), Failure> {
        let Self { common, split, .. } = self;
        if self.subjects == 0 || self.subjects > MAX_SUBJECTS {
            bail!("--subjects is {}, must be 1 to {MAX_SUBJECTS}", self.subjects);
        }
        let config = common.config()?;
        let standing = |folder: &Path| {
            let none = || FileError::unsuitable(folder, "none of its files .bvh has a standing pose");
            Poses::open(folder)?.ok_or_else(none)
        };
        let poses = self.poses.as_deref().map(standing).transpose()?;
        let mut inputs = inputs.to_vec();
        inputs.extend(self.poses.as_deref());
        let works: Vec<Work> = (0..self.subjects)
            .map(|index| Work {
                split: *split,
                subject: format!("{index:04}"),
                identity: format!("{kind}/{}/{split}/{index}", common.seed),
            })
            .collect();
        let with = if self.poses.is_some() { ", with poses of files" } else { "" };
        let source = format!("{kind}, seed {}{with}", common.seed);
        let scan = |work: &Work| {
            let Work { split, subject, .. } = work;
            common.output.join("scans").join(split.name()).join(subject).join(format!("{subject}.obj"))
        };
        // A scan that exists may have been edited.
        let is_due = |work: &Work| self.save_scans && !scan(work).exists();
        // Scans are for other programs as well.
        let detail = if self.save_scans { Detail::Fine } else { Detail::of_pictures(config.largest_side()) };
        // Where the cameras of the data set see it.
        let placed = |work: &Work| {
            let mut mesh = person(&work.identity, poses.as_ref(), detail)?;
            place(&mut mesh, work, Collection::Other, &common.output)?;
            Ok(mesh)
        };
        let made = make(common, &config, &source, &inputs, &works, |_, work| {
            let mesh = placed(work)?;
            if is_due(work) {
                export::write_obj(&mesh, &scan(work))?;
            }
            Ok(Person { mesh, yaw_degrees: 0.0, origin: common.output.clone() })
        });
        // Older subjects without scans.
        let has = |work: &Work| common.pictures(work.split, &work.subject).is_dir();
        let mut due = common.mine(&works);
        due.retain(|(_, work)| is_due(work) && has(work));
        for (_, work) in Progress::over(due.iter(), "scans") {
            export::write_obj(&placed(work)?, &scan(work))?;
        }
        made
    }
}
