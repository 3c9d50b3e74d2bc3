//! One case: a sound sample, changed, and the program run on it.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use proptest::prelude::*;
use proptest::sample::{Index, select};

use super::change::{self, Change, is_text};
use super::envelope;
use super::formats::Format;
use super::run::{self, Run, Tree};

/// Name of the folder of inputs, as commands call it.
pub const INPUTS: &str = "in";
/// Another name of the folder: a terminal would obey it, and it is no UTF-8.
pub const ODD_INPUTS: &[u8] = b"in \x1b[31m\xff\xc2\x9b32m \xe4\xba\xba";
/// Files that are lists of lines: the beginning of such a file may be a whole file.
const LISTS: [&str; 4] = ["obj", "mtl", "toml", "target"];

/// What happens to one file of the sample.
#[derive(Debug, Clone)]
pub struct Case {
    /// Kind of file, and file of the kind.
    target: [Index; 2],
    damage: Damage,
    has_old_output: bool,
    is_in_odd_folder: bool,
}

#[derive(Debug, Clone)]
enum Damage {
    /// The file's bytes, or those of a part inside of it.
    Changes(Vec<Change>, Option<Index>),
    /// The file ends early, after this share of its length.
    Short(f64),
    Instead(Instead),
}

/// What is there instead of the file.
#[derive(Debug, Clone, Copy)]
enum Instead {
    Nothing,
    Empty,
    Folder,
    /// A pipe that nobody writes to.
    Pipe,
    /// A link to this path.
    Link(&'static str),
    LinkToItself,
}

/// All cases.
pub fn cases() -> impl Strategy<Value = Case> {
    let instead = [
        Instead::Nothing,
        Instead::Empty,
        Instead::Folder,
        Instead::Pipe,
        Instead::Link("/dev/zero"),
        Instead::Link("/dev/null"),
        Instead::Link("no such file"),
        Instead::LinkToItself,
    ];
    let inside = prop::option::weighted(0.6, any::<Index>());
    let damage = prop_oneof![
        10 => (change::changes(), inside).prop_map(|(changes, part)| Damage::Changes(changes, part)),
        1 => (0.0..0.9).prop_map(Damage::Short),
        1 => select(instead.to_vec()).prop_map(Damage::Instead),
    ];
    (any::<[Index; 2]>(), damage, any::<bool>(), prop::bool::weighted(0.03)).prop_map(
        |(target, damage, has_old_output, is_in_odd_folder)| Case {
            target,
            damage,
            has_old_output,
            is_in_odd_folder,
        },
    )
}

/// A format's sound sample, and the memory that the program takes to read it.
pub struct Sample {
    files: Tree,
    memory: u64,
}

impl Sample {
    /// Makes the sample in a new folder and reads it once.
    ///
    /// # Panics
    /// If the program refuses it: changes of such a sample would test nothing.
    pub fn make(format: &Format, place: &Path) -> Self {
        let inputs = place.join("sample");
        fs::create_dir_all(&inputs).expect("a folder");
        (format.sample)(&inputs);
        let mut sample = Self { files: run::read_tree(&inputs), memory: 0 };
        for end in &format.changed {
            let targets = sample.targets(end);
            assert!(!targets.is_empty(), "{}: no file {end} to change", format.name);
            for target in targets {
                let (ending, bytes) = (ending(target), sample.bytes(target));
                let parts = envelope::open(ending, bytes);
                let again = parts.as_ref().and_then(|p| envelope::open(ending, &envelope::close(ending, p)));
                assert_eq!(again, parts, "{}: closed and opened again", target.display());
            }
        }
        let sound = sample.run(format, None, &place.join("sound"));
        let printed = String::from_utf8_lossy(&sound.printed);
        assert!(
            sound.code == Some(0) && sound.problems.is_empty(),
            "{}: {:?}\n{printed}",
            format.name,
            sound.problems
        );
        sample.memory = sound.memory;
        sample
    }

    /// Files whose paths end so.
    fn targets(&self, end: &str) -> Vec<&PathBuf> {
        let files = self.files.iter().filter(|(_, content)| content.is_some());
        files.map(|(path, _)| path).filter(|path| path.to_string_lossy().ends_with(end)).collect()
    }

    /// The file that a case changes.
    pub fn target(&self, format: &Format, case: &Case) -> &Path {
        let targets = self.targets(format.changed[case.target[0].index(format.changed.len())]);
        targets[case.target[1].index(targets.len())]
    }

    fn bytes(&self, file: &Path) -> &[u8] {
        self.files[file].as_deref().expect("a file")
    }

    /// Runs a case, or the sound sample, in the new folder `place`.
    ///
    /// # Panics
    /// If `place` cannot be written.
    pub fn run(&self, format: &Format, case: Option<&Case>, place: &Path) -> Run {
        let work = place.join("work");
        let mut inputs = work.join(INPUTS);
        fs::create_dir_all(&inputs).expect("a folder");
        for (path, content) in &self.files {
            match content {
                Some(bytes) => fs::write(inputs.join(path), bytes).expect("a file"),
                None => fs::create_dir_all(inputs.join(path)).expect("a folder"),
            }
        }
        let (mut longer, mut is_short) = (0, false);
        if let Some(case) = case {
            let target = self.target(format, case);
            let path = inputs.join(target);
            match &case.damage {
                Damage::Changes(changes, part) => {
                    let bytes = self.changed(target, changes, part.as_ref());
                    longer = (bytes.len() as u64).saturating_sub(self.bytes(target).len() as u64);
                    fs::write(path, bytes).expect("a file");
                }
                Damage::Short(share) => {
                    let bytes = self.bytes(target);
                    fs::write(path, &bytes[..(share * bytes.len() as f64) as usize]).expect("a file");
                    is_short = !LISTS.contains(&ending(target));
                }
                Damage::Instead(instead) => instead.put(&path),
            }
            // What was there before a refusal must be there after it.
            if let Some(output) = format.file.filter(|_| case.has_old_output) {
                fs::write(work.join(output), "precious\n").expect("a file");
            }
            if case.is_in_odd_folder {
                let odd = work.join(OsStr::from_bytes(ODD_INPUTS));
                fs::rename(&inputs, &odd).expect("renamed");
                inputs = odd;
            }
        }
        let inputs = inputs.file_name().expect("a name");
        let argument = |word: &str| match word.strip_prefix(INPUTS) {
            Some(rest) if rest.is_empty() || rest.starts_with('/') => {
                let mut path = inputs.to_owned();
                path.push(rest);
                path
            }
            _ => word.into(),
        };
        let arguments: Vec<OsString> = format.command.split_whitespace().map(argument).collect();
        let memory = if self.memory == 0 { u64::MAX } else { run::most_memory(self.memory, longer) };
        let mut run = run::run(format, &arguments, &work, place, memory);
        if is_short && run.code == Some(0) {
            run.problems.push("takes a file that ends early for whole".into());
        }
        run
    }

    /// A file with changes.
    fn changed(&self, target: &Path, changes: &[Change], part: Option<&Index>) -> Vec<u8> {
        let ending = ending(target);
        if let Some(part) = part
            && let Some(mut parts) = envelope::open(ending, self.bytes(target))
        {
            // Text decides what the rest means, so it is changed more often.
            let mut rows: Vec<usize> = (0..parts.len()).collect();
            let texts: Vec<usize> = rows.iter().copied().filter(|row| is_text(&parts[*row].1)).collect();
            rows.extend(texts.iter().cycle().take(if texts.is_empty() { 0 } else { 2 * parts.len() }));
            let row = *part.get(&rows);
            let other = parts[(row + 1) % parts.len()].1.clone();
            changes.iter().for_each(|change| change.apply(&mut parts[row].1, &other));
            return envelope::close(ending, &parts);
        }
        let mut bytes = self.bytes(target).to_vec();
        let siblings = self
            .files
            .iter()
            .filter(|(path, content)| content.is_some() && path.extension() == target.extension());
        let other = siblings.filter_map(|(_, content)| content.as_deref()).next_back().unwrap_or_default();
        changes.iter().for_each(|change| change.apply(&mut bytes, other));
        bytes
    }
}

fn ending(path: &Path) -> &str {
    path.extension().and_then(OsStr::to_str).unwrap_or_default()
}

impl Instead {
    fn put(self, path: &Path) {
        fs::remove_file(path).expect("removed");
        match self {
            Self::Nothing => {}
            Self::Empty => fs::write(path, "").expect("a file"),
            Self::Folder => fs::create_dir(path).expect("a folder"),
            Self::Pipe => {
                assert!(Command::new("mkfifo").arg(path).status().expect("mkfifo").success(), "a pipe");
            }
            Self::Link(to) => symlink(to, path).expect("a link"),
            Self::LinkToItself => symlink(path.file_name().expect("a name"), path).expect("a link"),
        }
    }
}
