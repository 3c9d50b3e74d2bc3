//! `snapsnap reconstruct --pairs`: many people. Weights are loaded once. While the networks process one person, the
//! next one is read and the previous one is written.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::mpsc::sync_channel;
use std::thread;

use serde::{Deserialize, Serialize};
use snapsnap_base::{FileError, file};
use snapsnap_mesh::picture;
use snapsnap_net::Reconstructor;
use snapsnap_net::config::Config;
use snapsnap_photo::{Photographs, Source, Told};
use snapsnap_splat::scene::Stored;

use super::convert::AxesArguments;
use super::reconstruct::Arguments;
use crate::batch::{Batch, pictures, same_name, stem, unpanicked};
use crate::failure::{Failure, bail};
use crate::model::check_memory;
use crate::progress::Progress;
use crate::{output, say, weights};

/// The config of all people in an output folder.
const CONFIG: &str = "pairs.config.toml";
/// Largest table and config in bytes.
const LARGEST_TABLE: u64 = 256 << 20;
const LARGEST_CONFIG: u64 = 1 << 20;
/// Characters that Windows allows in no name, and names that are devices there.
const FORBIDDEN: &str = "/\\:<>\"|?*";
const DEVICES: [&str; 6] = ["con", "nul", "aux", "prn", "com1", "lpt1"];
/// Longest name of a person in bytes.
const LONGEST: usize = 200;

/// Photographs of one person.
#[derive(Debug, Clone, PartialEq)]
struct Job {
    name: String,
    /// Front and back; or what is missing.
    photographs: Result<[PathBuf; 2], String>,
    masks: [Option<PathBuf>; 2],
}

/// All settings on which the people of a folder depend.
#[derive(Serialize)]
struct Settings<'a> {
    /// SHA-256 of the weights.
    weights: String,
    precision: &'a str,
    cutout: &'a str,
    told: Told,
    /// Axes of the files.
    axes: &'a AxesArguments,
    config: Config,
}

pub fn run(arguments: &Arguments, pairs: &Path) -> Result<(), Failure> {
    let Some(folder) = &arguments.output else { bail!("--pairs: give a folder for the people with -o") };
    let extension = arguments.kind.extension();
    let of_person = |name: &str| folder.join(format!("{name}.{extension}"));
    arguments.axes.check(&of_person("x"))?;
    let jobs = if pairs.is_dir() { in_folder(pairs)? } else { in_list(pairs)? };
    let opened = arguments.model.open()?;
    let config = opened.config.clone();
    let told = arguments.camera.told(&config, arguments.as_is)?;
    arguments.surface.must_be_unused("--pairs makes no meshes: snapsnap mesh takes their folder")?;
    let device = arguments.model.device(&opened)?;
    let (networks, precision) = arguments.model.load(&opened, &device)?;
    let path = folder.join(CONFIG);
    let settings = Settings {
        weights: weights::sum_of(&opened)?,
        precision: precision.name(),
        cutout: &arguments.cutout,
        told,
        axes: &arguments.axes,
        config: config.resolved(),
    };
    check_settings(&path, &settings)?;
    let mut batch = Batch::new(folder, &arguments.shard)?;
    let jobs = batch.missing(jobs, |job| of_person(&job.name));
    if jobs.is_empty() {
        return batch.end(0);
    }
    output::write(&path, toml::to_string_pretty(&settings).expect("TOML types").as_bytes())?;
    let progress = Progress::counted("people");
    let (to_networks, photographs) = sync_channel(1);
    let (to_writer, people) = sync_channel::<(String, Result<Stored, Failure>)>(1);
    // It has room for all results, and closes early only after an output that could not be written.
    let (to_list, ended) = sync_channel(jobs.len());
    let (jobs, of_person) = (&jobs, &of_person);
    thread::scope(|scope| {
        let config = &config;
        scope.spawn(move || {
            let read = |job: &Job| unpanicked(|| read_one(arguments, job, config, &told));
            jobs.iter().try_for_each(|job| to_networks.send(read(job)))
        });
        scope.spawn(move || {
            people.into_iter().try_for_each(|(name, person)| {
                let write = |stored: Stored| unpanicked(|| arguments.axes.write(&stored, &of_person(&name)));
                to_list.send((name.clone(), person.and_then(write)))
            })
        });
        let mut results = 0;
        let mut count = |(name, result): (String, Result<(), Failure>)| {
            results += 1;
            progress(results, jobs.len());
            result.or_else(|failure| batch.failed(&name, failure))
        };
        for (job, read) in jobs.iter().zip(photographs) {
            let person = read.and_then(|photographs| unpanicked(|| make(&photographs, &networks, &told)));
            to_writer.send((job.name.clone(), person)).expect("the writer waits for the last person");
            ended.try_iter().try_for_each(&mut count)?;
        }
        drop(to_writer);
        ended.into_iter().try_for_each(count)
    })?;
    drop(progress);
    batch.end(jobs.len())
}

/// Refuses a folder whose people were made with other settings.
fn check_settings(path: &Path, settings: &Settings) -> Result<(), Failure> {
    if !path.exists() {
        return Ok(());
    }
    let text = file::read_text(path, LARGEST_CONFIG).map_err(FileError::read(path))?;
    let there: toml::Table = toml::from_str(&text).map_err(|e| Failure::file(path, e))?;
    // Parsed from text like the file's table: a table made directly would have other digits.
    let wanted: toml::Table =
        toml::from_str(&toml::to_string_pretty(settings).expect("TOML types")).expect("TOML");
    output::check_settings(path, &there, &wanted)
}

/// Reads the photographs of one person.
fn read_one(arguments: &Arguments, job: &Job, config: &Config, told: &Told) -> Result<Photographs, Failure> {
    let paths = job.photographs.as_ref().map_err(|missing| Failure::Input(missing.clone()))?;
    paths.iter().try_for_each(|path| check_memory(path, picture::size(path, None)?))?;
    let sources = [0, 1].map(|i| Source { mask: job.masks[i].as_deref(), ..Source::file(&paths[i]) });
    let mut read = arguments.read(&sources, config, told, &format!("{}: ", job.name))?;
    read.cutouts = Vec::new();
    Ok(read)
}

/// The person of two photographs.
fn make(photographs: &Photographs, networks: &Reconstructor, told: &Told) -> Result<Stored, Failure> {
    Ok(Stored::of(&snapsnap_photo::person(photographs, networks, told, &|_| ())?.gaussians)?)
}

/// A row of a table. Each column may be missing, and each value empty.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    name: Option<String>,
    front: Option<PathBuf>,
    back: Option<PathBuf>,
    front_mask: Option<PathBuf>,
    back_mask: Option<PathBuf>,
}

/// The people of a table with the columns `front` and `back`, and perhaps `name`, `front_mask` and `back_mask`. Paths
/// are relative to the table's folder.
fn in_list(path: &Path) -> Result<Vec<Job>, Failure> {
    let cannot = |e: csv::Error| Failure::file(path, e);
    let folder = path.parent().unwrap_or(Path::new(""));
    let text = file::read_text(path, LARGEST_TABLE).map_err(FileError::read(path))?;
    // Spreadsheets of many countries separate by semicolons.
    let names = text.lines().next().unwrap_or_default();
    let delimiter = *b";\t".iter().find(|byte| names.as_bytes().contains(byte)).unwrap_or(&b',');
    let mut table = csv::ReaderBuilder::new();
    let mut table = table.trim(csv::Trim::All).delimiter(delimiter).from_reader(text.as_bytes());
    let columns: csv::StringRecord = table.headers().map_err(cannot)?.iter().map(str::to_lowercase).collect();
    if let Some(missing) =
        ["front", "back"].iter().find(|name| !columns.iter().any(|column| column == **name))
    {
        return Err(Failure::file(path, format_args!("has no column `{missing}`")));
    }
    let mut jobs = Vec::new();
    for record in table.records() {
        let record = record.map_err(cannot)?;
        if record.iter().all(str::is_empty) {
            continue;
        }
        let wrong = |message: &str| {
            // The reader's own numbers count CRLF twice, and a record may begin with the end of the line before.
            let start = record.position().map_or(0, |position| position.byte() as usize);
            let before =
                text.bytes().enumerate().take_while(|(i, byte)| *i < start || b"\r\n".contains(byte));
            let line = 1 + before.filter(|(_, byte)| *byte == b'\n').count();
            Failure::file(path, format_args!("line {line}: {message}"))
        };
        if record.iter().any(|value| value.contains(char::is_control)) {
            return Err(wrong("a value has a line break: is a quotation mark missing?"));
        }
        let row: Row = record.deserialize(Some(&columns)).map_err(cannot)?;
        let (Some(front), Some(back)) = (row.front, row.back) else {
            return Err(wrong("needs a front and a back"));
        };
        let name = match row.name {
            Some(name) => name,
            None => named_by(&front).ok_or_else(|| wrong("needs a name"))?,
        };
        let is_forbidden = |c: char| FORBIDDEN.contains(c);
        if name.len() > LONGEST
            || name.starts_with('.')
            || name.contains(is_forbidden)
            || DEVICES.contains(&name.to_lowercase().as_str())
        {
            return Err(wrong(&format!("`{name}` cannot be the name of a file")));
        }
        let masks = [row.front_mask, row.back_mask].map(|mask| mask.map(|mask| folder.join(mask)));
        jobs.push(Job { name, photographs: Ok([folder.join(front), folder.join(back)]), masks });
    }
    checked(path, jobs)
}

/// A person's name by the photograph of the front: `anna_front.jpg` shows anna.
fn named_by(front: &Path) -> Option<String> {
    let stem = front.file_stem()?.to_str()?;
    let name = stem.strip_suffix("_front").unwrap_or(stem);
    (!name.is_empty() && name != "front").then(|| name.to_owned())
}

/// Ends of the names of a person's pictures.
const ENDS: [&str; 4] = ["_front", "_back", "_front_mask", "_back_mask"];

/// The people of a folder with `NAME_front.jpg`, `NAME_back.jpg`, and perhaps `NAME_front_mask.png` and
/// `NAME_back_mask.png`, of any kind of picture.
fn in_folder(folder: &Path) -> Result<Vec<Job>, Failure> {
    let mut found = BTreeMap::new();
    let mut others = 0;
    for path in pictures(folder)? {
        let stem = stem(&path)?;
        if !ENDS.iter().any(|end| stem.ends_with(end)) {
            others += 1;
            continue;
        }
        if let Some(other) = found.insert(stem, path.clone()) {
            return Err(same_name(&path, &other));
        }
    }
    if others > 0 {
        say::note(&format!("{}: {others} pictures are neither NAME_front nor NAME_back", folder.display()));
    }
    let names: BTreeSet<&str> = found
        .keys()
        .filter_map(|stem| stem.strip_suffix("_front").or(stem.strip_suffix("_back")))
        .filter(|name| !name.is_empty())
        .collect();
    let job = |name: &str| {
        let picture = |end: &str| found.get(&format!("{name}_{end}")).cloned();
        let photographs = match (picture("front"), picture("back")) {
            (Some(front), Some(back)) => Ok([front, back]),
            (None, _) => Err(format!("{}: has no {name}_front", folder.display())),
            (_, None) => Err(format!("{}: has no {name}_back", folder.display())),
        };
        Job { name: name.to_owned(), photographs, masks: ["front_mask", "back_mask"].map(picture) }
    };
    checked(folder, names.into_iter().map(job).collect())
}

/// Refuses an empty list, and two people whose names are equal or differ only in case.
fn checked(path: &Path, jobs: Vec<Job>) -> Result<Vec<Job>, Failure> {
    if jobs.is_empty() {
        return Err(Failure::file(path, "has no pair of photographs"));
    }
    let mut names = BTreeSet::new();
    match jobs.iter().find(|job| !names.insert(job.name.to_lowercase())) {
        Some(job) => Err(Failure::file(path, format_args!("two pairs are called `{}`", job.name))),
        None => Ok(jobs),
    }
}
