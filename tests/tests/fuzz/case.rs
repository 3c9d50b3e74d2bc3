//! One case: a sound sample, changed, and the program run on it.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use proptest::prelude::*;
use proptest::sample::{Index, select};
use snapsnap_tests::files;

use super::change::{self, Change, is_text};
use super::formats::Format;
use super::run::{self, Run};
use super::{envelope, samples};

/// Another name of the folder of inputs: a terminal would obey it, and it is no UTF-8.
const ODD_INPUTS: &[u8] = b"in \x1b[31m\xff\xc2\x9b32m \xe4\xba\xba";
/// Files that are lists of lines: the beginning of such a file may be a whole file.
const LISTS: [&str; 4] = ["obj", "mtl", "toml", "target"];
/// Shell commands that put something else in the place of the removed file `$1`. Nobody writes to the pipe.
const INSTEAD: [&str; 8] =
    ["true", "touch", "mkdir", "mkfifo", "ln -s /dev/zero", "ln -s /dev/null", "ln -s none", "ln -s \"$1\""];
/// Memory that the program may take beyond the sound sample's, and for each byte of a longer file: numbers and lists take
/// more room in memory than in text.
const MORE_MEMORY: u64 = 300 << 20;
const MEMORY_OF_BYTE: u64 = 50;

/// What happens to one file of the sample.
#[derive(Debug, Clone)]
pub struct Case {
    /// Kind of file, and file of the kind.
    target: [Index; 2],
    damage: Damage,
    /// Whether the output is there already.
    has_output: bool,
    /// Whether the folder of inputs has its odd name.
    is_odd: bool,
}

#[derive(Debug, Clone)]
enum Damage {
    /// The file's bytes, or the bytes of a part inside of it.
    Changes(Vec<Change>, Option<Index>),
    /// The file ends early, after this share of its length.
    Short(f64),
    /// One of [`INSTEAD`].
    Instead(&'static str),
}

/// All cases.
pub fn cases() -> impl Strategy<Value = Case> {
    let inside = prop::option::weighted(0.6, any::<Index>());
    let damage = prop_oneof![
        10 => (change::changes(), inside).prop_map(|(changes, part)| Damage::Changes(changes, part)),
        1 => (0.0..0.9).prop_map(Damage::Short),
        1 => select(&INSTEAD[..]).prop_map(Damage::Instead),
    ];
    (any::<[Index; 2]>(), damage, any::<bool>(), prop::bool::weighted(0.03))
        .prop_map(|(target, damage, has_output, is_odd)| Case { target, damage, has_output, is_odd })
}

/// A format's sound sample.
pub struct Sample {
    pub format: Format,
    files: BTreeMap<PathBuf, Vec<u8>>,
    /// Most memory that the program may take to read it.
    memory: u64,
}

impl Sample {
    /// Makes the sample in a new folder in `root` and reads it once.
    ///
    /// # Panics
    /// If the program refuses it: changes of such a sample would test nothing.
    pub fn new(format: Format, root: &Path) -> Self {
        let place = root.join(format.name);
        let inputs = place.join("sample");
        for name in format.command.split_whitespace().filter_map(|word| word.strip_prefix("in/")) {
            samples::make(&inputs, name);
        }
        let mut files = files(&inputs);
        for (path, bytes) in &mut files {
            // The program must take the parts as they are wrapped here.
            if let Some(parts) = envelope::open(ending(path), bytes) {
                *bytes = envelope::close(ending(path), &parts);
            }
        }
        let mut sample = Self { format, files, memory: u64::MAX };
        let Run { code, memory, printed, problems } = sample.run(None, &place);
        let name = sample.format.name;
        assert!(code == Some(0) && problems.is_empty(), "{name}: {code:?}, {problems:?}\n{printed}");
        sample.memory = memory.saturating_add(MORE_MEMORY);
        sample
    }

    /// The file that a case changes.
    ///
    /// # Panics
    /// If the format changes files that the sample does not have.
    pub fn target(&self, case: &Case) -> &Path {
        let end = self.format.changed[case.target[0].index(self.format.changed.len())];
        let targets: Vec<&PathBuf> =
            self.files.keys().filter(|path| path.to_string_lossy().ends_with(end)).collect();
        assert!(!targets.is_empty(), "{}: no file {end} to change", self.format.name);
        targets[case.target[1].index(targets.len())]
    }

    /// Runs a case, or the sound sample, in the new folder `place`.
    ///
    /// # Panics
    /// If `place` cannot be written.
    pub fn run(&self, case: Option<&Case>, place: &Path) -> Run {
        let work = place.join("work");
        let is_odd = case.is_some_and(|case| case.is_odd);
        let name = OsStr::from_bytes(if is_odd { ODD_INPUTS } else { b"in" });
        let inputs = work.join(name);
        for (path, bytes) in &self.files {
            samples::put(&inputs.join(path), bytes);
        }
        let (mut longer, mut is_short) = (0, false);
        if let Some(case) = case {
            let target = self.target(case);
            let (path, bytes) = (inputs.join(target), &self.files[target]);
            match &case.damage {
                Damage::Changes(changes, part) => {
                    let changed = self.changed(target, changes, part.as_ref());
                    longer = changed.len().saturating_sub(bytes.len()) as u64;
                    samples::put(&path, changed);
                }
                Damage::Short(share) => {
                    samples::put(&path, &bytes[..(share * bytes.len() as f64) as usize]);
                    is_short = !LISTS.contains(&ending(target));
                }
                Damage::Instead(instead) => {
                    let script = format!("rm \"$1\" && {instead} \"$1\"");
                    let done = Command::new("sh").args(["-c", &script, "sh"]).arg(path).status();
                    assert!(done.expect("a shell").success(), "{script}");
                }
            }
            // What was there before a refusal must be there after it.
            if let Some(output) = self.format.output().filter(|_| case.has_output) {
                samples::put(&work.join(output), "precious\n");
            }
        }
        let memory = self.memory.saturating_add(MEMORY_OF_BYTE * longer);
        let mut run = run::run(&self.format, name, place, memory);
        if is_short && run.code == Some(0) {
            run.problems.push("takes a file that ends early for whole".into());
        }
        run
    }

    /// A file with changes.
    fn changed(&self, target: &Path, changes: &[Change], part: Option<&Index>) -> Vec<u8> {
        let (ending, mut bytes) = (ending(target), self.files[target].clone());
        if let Some(part) = part
            && let Some(mut parts) = envelope::open(ending, &bytes)
        {
            // Text decides what the rest means, so it is changed more often.
            let texts = (0..parts.len()).filter(|row| is_text(&parts[*row].1));
            let rows: Vec<usize> = texts.cycle().take(2 * parts.len()).chain(0..parts.len()).collect();
            let row = *part.get(&rows);
            let other = parts[(row + 1) % parts.len()].1.clone();
            changes.iter().for_each(|change| change.apply(&mut parts[row].1, &other));
            return envelope::close(ending, &parts);
        }
        let mut siblings = self.files.iter().filter(|(path, _)| path.extension() == target.extension());
        let (_, other) = siblings.next_back().expect("the file itself");
        changes.iter().for_each(|change| change.apply(&mut bytes, other));
        bytes
    }
}

fn ending(path: &Path) -> &str {
    path.extension().and_then(OsStr::to_str).unwrap_or_default()
}
