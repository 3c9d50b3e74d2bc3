//! Many cases at once: a short run of fixed ones for the suite, a long one for as long as one likes.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tempfile::TempDir;

use super::case::{Case, Outcome, Sample, Samples};
use super::report::Tally;
use super::{Format, formats};

/// Time between two lines on a long run's progress.
const PROGRESS: Duration = Duration::from_secs(20);

/// The formats' samples, ready to be changed.
pub struct Campaign {
    program: PathBuf,
    root: TempDir,
    samples: Samples,
    formats: Vec<&'static Format>,
}

impl Campaign {
    /// Makes the samples of all formats, or of those whose names begin with `only`.
    ///
    /// # Panics
    /// If there is no such format, or the program refuses a sound sample.
    pub fn new(only: Option<&str>) -> Self {
        let formats: Vec<&Format> =
            formats::all().filter(|format| only.is_none_or(|only| format.name.starts_with(only))).collect();
        let names: Vec<&str> = formats::all().map(|format| format.name).collect();
        assert!(!formats.is_empty(), "no such format; there are {}", names.join(", "));
        let program = PathBuf::from(crate::snapsnap().get_program());
        let root = tempfile::Builder::new().prefix("snapsnap-fuzz-").tempdir().expect("a temporary folder");
        let samples = Mutex::new(BTreeMap::new());
        let next = AtomicU64::new(0);
        on_all_cores(|| {
            while let Some(format) = formats.get(next.fetch_add(1, Ordering::Relaxed) as usize) {
                let sample = Sample::make(format, &program, &root.path().join(format.name));
                samples.lock().expect("no panic elsewhere").insert(format.name, sample);
            }
        });
        let samples = samples.into_inner().expect("no panic elsewhere");
        Self { program, root, samples, formats }
    }

    /// The case that `FORMAT:SEED` or `FORMAT:SEED:CHANGES` names.
    ///
    /// # Panics
    /// If it names none.
    pub fn case(&self, name: &str) -> Case {
        let mut words = name.split(':');
        let format =
            self.formats.iter().find(|format| Some(format.name) == words.next()).expect("a format's name");
        let seed = words.next().and_then(|seed| seed.parse().ok()).expect("FORMAT:SEED");
        let case = Case::new(format, seed);
        let changes = words.next().map(|changes| changes.parse().expect("a number of changes"));
        Case { changes: changes.unwrap_or(case.changes), ..case }
    }

    /// Runs one case in `place`, an empty folder that is kept.
    pub fn keep(&self, case: Case, place: &Path) -> Outcome {
        self.samples[case.format.name].run(case, &self.program, place)
    }

    fn run(&self, case: Case) -> Outcome {
        let place = self.root.path().join(case.to_string());
        fs::create_dir(&place).expect("a folder");
        let outcome = self.keep(case, &place);
        fs::remove_dir_all(&place).expect("removed");
        outcome
    }

    /// The cases of the suite: the same ones every time.
    pub fn short(&self) -> Tally {
        let round = self.round();
        self.all(|index| round.get(index as usize).map(|(format, seed)| Case::new(format, *seed)))
    }

    /// Round after round of such cases, from the seed `first` on, for as long as that.
    pub fn long(&self, time: Duration, first: u64) -> Tally {
        let start = Instant::now();
        let round = self.round();
        self.all(|index| {
            let (format, seed) = round[index as usize % round.len()];
            let rounds = index / round.len() as u64;
            let case = Case::new(format, first + rounds * format.share + seed);
            (start.elapsed() < time).then_some(case)
        })
    }

    /// As many seeds of each format as its share is, the formats in turn.
    fn round(&self) -> Vec<(&'static Format, u64)> {
        let most = self.formats.iter().map(|format| format.share).max().unwrap_or(0);
        let turns = (0..most).flat_map(|seed| self.formats.iter().map(move |format| (*format, seed)));
        turns.filter(|(format, seed)| *seed < format.share).collect()
    }

    fn all(&self, case: impl Fn(u64) -> Option<Case> + Sync) -> Tally {
        let tally = Mutex::new(Tally::new(self.formats.iter().map(|format| format.name)));
        let next = AtomicU64::new(0);
        let said = Mutex::new(Instant::now());
        on_all_cores(|| {
            while let Some(case) = case(next.fetch_add(1, Ordering::Relaxed)) {
                let outcome = self.run(case);
                // Fewer changes are looked for once for each kind of failure: a hang takes its time each time.
                let is_new = tally.lock().expect("no panic elsewhere").is_new(case, &outcome);
                let least = if is_new { self.least(case) } else { case };
                let mut tally = tally.lock().expect("no panic elsewhere");
                for failure in tally.add(case, least, &outcome) {
                    println!("{failure}");
                }
                let mut said = said.lock().expect("no panic elsewhere");
                if said.elapsed() > PROGRESS {
                    *said = Instant::now();
                    println!("{}", tally.progress());
                }
            }
        });
        let mut tally = tally.into_inner().expect("no panic elsewhere");
        tally.stop();
        tally
    }

    /// The failing case with as few of its changes as still fail.
    fn least(&self, case: Case) -> Case {
        let fewer = (1..case.changes).map(|changes| Case { changes, ..case });
        fewer.into_iter().find(|case| !self.run(*case).problems.is_empty()).unwrap_or(case)
    }
}

fn on_all_cores(work: impl Fn() + Sync) {
    let cores = std::thread::available_parallelism().map_or(2, usize::from);
    std::thread::scope(|scope| (0..cores).for_each(|_| drop(scope.spawn(&work))));
}
