//! One case: a sound sample, changed as the case's seed says, and the program run on it.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fmt;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use rand::{Rng, SeedableRng};

use super::child::{self, Ended, Ran};
use super::envelope::Envelope;
use super::tree::{self, Entry, Tree};
use super::{Format, INPUTS, ODD_INPUTS, Random, bytes, judge, text};

/// Most changes to one file.
const MOST_CHANGES: usize = 4;
/// Files that are lists of lines, whose beginning may be a whole file.
const LISTS: [&str; 4] = ["obj", "mtl", "toml", "target"];
/// Largest share of another file that can never be taken for the whole.
const CUT: f64 = 0.9;

/// A format, a seed, and how many of the seed's changes are made.
#[derive(Clone, Copy)]
pub struct Case {
    /// What is read.
    pub format: &'static Format,
    /// Decides what is changed.
    pub seed: u64,
    /// Only the first so many changes.
    pub changes: usize,
}

impl Case {
    /// With all of its changes.
    pub fn new(format: &'static Format, seed: u64) -> Self {
        Self { format, seed, changes: MOST_CHANGES }
    }
}

impl fmt::Display for Case {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.format.name, self.seed)?;
        if self.changes < MOST_CHANGES { write!(f, ":{}", self.changes) } else { Ok(()) }
    }
}

/// A format's sound sample, and what the program takes to read it.
pub struct Sample {
    /// Input files.
    pub files: Tree,
    /// Resident memory, bytes.
    pub memory: u64,
}

/// What came of a case.
pub struct Outcome {
    /// How the run ended and what it took.
    pub ran: Ran,
    /// What was changed.
    pub changes: Vec<String>,
    /// What was put in the file's place.
    pub instead: Option<&'static str>,
    /// What must not be.
    pub problems: Vec<String>,
}

impl Sample {
    /// Makes the sample in an empty folder and reads it once.
    ///
    /// # Panics
    /// If the program refuses it: changes to such a sample would test nothing.
    pub fn make(format: &'static Format, program: &Path, place: &Path) -> Self {
        let inputs = place.join("sample");
        fs::create_dir_all(&inputs).expect("a folder");
        (format.sample)(&inputs);
        let mut sample = Self { files: tree::read(&inputs), memory: 0 };
        for end in format.changed {
            assert!(!sample.targets(end).is_empty(), "{}: no file {end} to change", format.name);
        }
        let case = Case { changes: 0, ..Case::new(format, 0) };
        let Outcome { ran, problems, .. } = sample.run(case, program, &place.join("sound"));
        let printed = String::from_utf8_lossy(&ran.printed);
        assert!(
            ran.ended == Ended::Code(0) && problems.is_empty(),
            "{}: {problems:?}\n{printed}",
            format.name
        );
        sample.memory = ran.memory;
        sample
    }

    /// Files whose paths end so.
    fn targets(&self, end: &str) -> Vec<&PathBuf> {
        let files = self.files.iter().filter(|(_, entry)| matches!(entry, Entry::File(_)));
        files.map(|(path, _)| path).filter(|path| path.to_string_lossy().ends_with(end)).collect()
    }

    /// Runs a case in the folder `place`, which is made; what it changed and left is there afterwards.
    ///
    /// # Panics
    /// If `place` cannot be written.
    pub fn run(&self, case: Case, program: &Path, place: &Path) -> Outcome {
        let work = place.join("work");
        let mut inputs = work.join(INPUTS);
        let mut random = seeded(case);
        tree::write(&self.files, &inputs);
        // Kinds of files in turn, however many there are of each.
        let ends = case.format.changed;
        let targets = self.targets(ends[random.random_range(0..ends.len())]);
        let target = targets[random.random_range(0..targets.len())];
        // What was there before a refusal must be there after it.
        if let Some(output) = case.format.file.filter(|_| random.random_bool(0.5)) {
            fs::write(work.join(output), "precious\n").expect("a file");
        }
        let mut changes = Vec::new();
        let (mut cut, mut instead, mut longer) = (false, None, 0);
        if case.changes > 0 {
            let dice: f64 = random.random();
            if dice < 0.12 {
                let what = misplace(&inputs.join(target), &mut random);
                instead = Some(what);
                changes.push(what.to_owned());
            } else if dice < 0.2 {
                let file = fs::File::options().write(true).open(inputs.join(target)).expect("a file");
                let whole = file.metadata().expect("a file").len();
                let length = random.random_range(0..=(CUT * whole as f64) as u64);
                file.set_len(length).expect("cut");
                cut = !LISTS.iter().any(|list| target.extension().is_some_and(|ending| ending == *list));
                changes.push(format!("cut to {length} of {whole} bytes"));
            } else {
                // A name shows where something is said about the file.
                if dice < 0.23 {
                    let odd = work.join(OsStr::from_bytes(ODD_INPUTS));
                    fs::rename(&inputs, &odd).expect("renamed");
                    inputs = odd;
                    changes.push("in a folder whose name is no text".into());
                }
                let (bytes, said) = self.damage(case, target, &mut random);
                longer = (bytes.len() as u64).saturating_sub(self.length(target));
                fs::write(inputs.join(target), bytes).expect("a file");
                changes.extend(said);
            }
            changes.iter_mut().for_each(|change| *change = format!("{}: {change}", target.display()));
        }
        let before = tree::read(&work);
        let arguments = arguments(case.format, inputs.file_name().expect("a name"));
        let ran = child::run(program, &arguments, &work, place);
        let most = if self.memory == 0 {
            u64::MAX
        } else {
            self.memory + judge::MORE_MEMORY + judge::MEMORY_PER_BYTE * longer
        };
        let mut problems = judge::problems(case.format, &ran, &before, &tree::read(&work), &work, most);
        if cut && ran.ended == Ended::Code(0) {
            problems.push("takes a file that was cut short for whole".into());
        }
        Outcome { ran, changes, instead, problems }
    }

    fn length(&self, file: &Path) -> u64 {
        if let Some(Entry::File(bytes)) = self.files.get(file) { bytes.len() as u64 } else { 0 }
    }

    /// A file with the case's changes.
    fn damage(&self, case: Case, target: &Path, random: &mut Random) -> (Vec<u8>, Vec<String>) {
        let Entry::File(sound) = &self.files[target] else { unreachable!("targets are files") };
        let mut said = Vec::new();
        let count = 1 + (0..MOST_CHANGES - 1).take_while(|_| random.random_bool(0.4)).count();
        let count = count.min(case.changes);
        let Some(mut envelope) = Envelope::open(target, sound).filter(|_| random.random_bool(0.6)) else {
            let other = self.sibling(target, random);
            let mut bytes = sound.clone();
            said.extend((0..count).map(|_| change(&mut bytes, other, random)));
            return (bytes, said);
        };
        // What is text decides what the rest means.
        let texts: Vec<usize> =
            (0..envelope.parts.len()).filter(|part| text::is_text(&envelope.parts[*part])).collect();
        for _ in 0..count {
            let part = match texts.len() {
                many if many > 0 && random.random_bool(0.6) => texts[random.random_range(0..many)],
                _ => random.random_range(0..envelope.parts.len()),
            };
            let other = envelope.parts[random.random_range(0..envelope.parts.len())].clone();
            let change = change(&mut envelope.parts[part], &other, random);
            said.push(format!("inside, part {part}: {change}"));
        }
        (envelope.close(), said)
    }

    /// Another file of the same kind, or else the same.
    fn sibling(&self, target: &Path, random: &mut Random) -> &[u8] {
        let files: Vec<&Vec<u8>> = self
            .files
            .iter()
            .filter(|(path, _)| path.extension() == target.extension())
            .filter_map(|(_, entry)| if let Entry::File(bytes) = entry { Some(bytes) } else { None })
            .collect();
        files[random.random_range(0..files.len())]
    }
}

fn seeded(case: Case) -> Random {
    // Formats have their own numbers, whatever others there are. FNV-1a.
    let mix = |sum: u64, byte: u8| (sum ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    let name = case.format.name.bytes().fold(0xcbf2_9ce4_8422_2325, mix);
    Random::seed_from_u64(name ^ case.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15))
}

fn change(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    let is_text = text::is_text(bytes) && random.random_bool(0.75);
    let damage = if is_text { text::damage(bytes, random) } else { bytes::damage(random) };
    damage(bytes, other, random)
}

/// Puts something else in the file's place.
fn misplace(path: &Path, random: &mut Random) -> &'static str {
    fs::remove_file(path).expect("removed");
    let link = |to: &str| symlink(to, path).expect("a link");
    match random.random_range(0..8) {
        0 => "missing",
        1 => {
            fs::write(path, "").expect("a file");
            "empty"
        }
        2 => {
            fs::create_dir(path).expect("a folder");
            "a folder"
        }
        3 => {
            let made = Command::new("mkfifo").arg(path).status().expect("mkfifo");
            assert!(made.success(), "a pipe");
            "a pipe that nobody writes to"
        }
        4 => {
            link("/dev/zero");
            "a link to /dev/zero"
        }
        5 => {
            link("/dev/null");
            "a link to /dev/null"
        }
        6 => {
            link("no such file");
            "a link to nowhere"
        }
        _ => {
            link(&path.file_name().expect("a name").to_string_lossy());
            "a link to itself"
        }
    }
}

/// The format's command, with another name of the folder of inputs.
fn arguments(format: &Format, inputs: &OsStr) -> Vec<OsString> {
    let argument = |word: &str| match word.strip_prefix(INPUTS) {
        Some(rest) if rest.is_empty() || rest.starts_with('/') => {
            let mut path = inputs.to_owned();
            path.push(rest);
            path
        }
        _ => word.into(),
    };
    format.command.split_whitespace().map(argument).collect()
}

/// The samples of formats.
pub type Samples = BTreeMap<&'static str, Sample>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_always_makes_the_same_changes_even_to_nothing() {
        for sample in [&b""[..], b"\n", b"a = 1\n[b]\n", br#"{"a": [1, {"b": "c"}], "d": null}"#, &[0; 40]] {
            for seed in 0..50 {
                let changed = || {
                    let (mut bytes, mut random) = (sample.to_vec(), Random::seed_from_u64(seed));
                    let said: Vec<String> = (0..3).map(|_| change(&mut bytes, sample, &mut random)).collect();
                    (bytes, said)
                };
                assert!(changed() == changed(), "seed {seed} of {}", sample.escape_ascii());
            }
        }
    }
}
