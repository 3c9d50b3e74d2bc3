//! `snapsnap reconstruct`.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::Instant;

use burn::tensor::Device;
use clap::Args;
use serde_json::{Value, json};
use snapsnap_base::config::Schema;
use snapsnap_base::file;
use snapsnap_mesh::picture;
use snapsnap_net::config::Config;
use snapsnap_net::precision::Precision;
use snapsnap_ops::bf16;
use snapsnap_photo::{Cutting, NoPerson, Person, Photographs, Source, Told};
use snapsnap_splat::scene::Stored;

use super::convert::AxesArguments;
use super::mesh::{self, SurfaceArguments, Target};
use super::pairs;
use crate::batch::{KindArgument, ShardArgument, must_be_unused};
use crate::failure::{Failure, bail};
use crate::model::{CameraArguments, ModelArguments, check_memory};
use crate::output::{check_folder, check_kind, check_outputs, is_same_file};
use crate::pictures::save_cutout;
use crate::progress::Progress;
use crate::turntable::Turntable;
use crate::{device, dump, memory, output, say};

/// The output of one person.
const DEFAULT_OUTPUT: &str = "human.ply";
/// Message for options of --pairs in a reconstruction of one person.
const ONE: &str = "is for many people, with --pairs";

#[derive(Args)]
pub struct Arguments {
    /// Photograph of the front. Without an alpha channel or --masks, a network removes the background.
    #[arg(required_unless_present = "pairs")]
    front: Option<PathBuf>,
    /// Photograph of the back.
    #[arg(required_unless_present = "pairs")]
    back: Option<PathBuf>,
    /// Many people: a table with the columns front, back and perhaps name, front_mask and back_mask, or a folder of
    /// NAME_front.jpg and NAME_back.jpg. Their files NAME.ply go to the folder -o. People who are there already are
    /// left out. Pairs that fail are listed in errors.csv.
    #[arg(long, value_name = "CSV|DIR", conflicts_with_all = ["front", "back", "masks", "save_cutouts", "turntable", "mesh", "dump", "verbose", "json"])]
    pairs: Option<PathBuf>,
    #[command(flatten)]
    pub kind: KindArgument,
    #[command(flatten)]
    pub shard: ShardArgument,
    /// Masks of the two photographs (white: person).
    #[arg(long, num_args = 2, value_names = ["FRONT_MASK", "BACK_MASK"])]
    masks: Option<Vec<PathBuf>>,
    /// Background removal. auto: by the network, for photographs without an alpha channel and --masks; network: always
    /// by the network, alpha channels are ignored; none: by alpha channels and --masks alone.
    #[arg(long, value_name = "auto|network|none", default_value = "auto", value_parser = ["auto", "network", "none"])]
    pub cutout: String,
    /// Also write the photographs without background, before they are placed on the canvas, as front.png and back.png.
    /// The back's colours are matched to the front's. They are at most 2048 pixels long if the network removed the
    /// background.
    #[arg(long, value_name = "DIR")]
    save_cutouts: Option<PathBuf>,
    /// Use the pictures as the canvas, without cropping, scaling and centring.
    #[arg(long)]
    pub as_is: bool,
    /// End with an error instead of a warning if the photographs look wrong.
    #[arg(long)]
    pub strict: bool,
    #[command(flatten)]
    pub camera: CameraArguments,
    #[command(flatten)]
    pub model: ModelArguments,
    /// File of Gaussians to write: .ply, .spz, .glb or .sog [default: human.ply]. The resolved config is written
    /// beside it. With --pairs, a folder.
    #[arg(short, long)]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub axes: AxesArguments,
    /// Also render the result all around: an animation, a sheet of eight views, or a folder of pictures.
    #[arg(long, value_name = "OUT.gif|OUT.png|DIR")]
    turntable: Option<PathBuf>,
    /// Also make a mesh.
    #[arg(long, value_name = "OUT.glb|.obj|.ply|.stl|.3mf")]
    mesh: Option<PathBuf>,
    #[command(flatten)]
    pub surface: SurfaceArguments,
    /// Give the mesh a skeleton. It must be a .glb.
    #[arg(long, requires = "mesh")]
    rig: bool,
    /// Also write every intermediate tensor.
    #[arg(long, value_name = "FILE.safetensors")]
    dump: Option<PathBuf>,
    /// Print the modules that ran, the omitted ones with the reasons, and the time of each.
    #[arg(short, long)]
    verbose: bool,
    /// Print all of that as JSON, and doubts about the photographs.
    #[arg(long, conflicts_with = "verbose")]
    json: bool,
}

impl Arguments {
    /// Reads the photographs of a person for the networks of a config. Prints doubts about them with `name` before
    /// each, or refuses them with --strict.
    pub fn read(
        &self,
        sources: &[Source],
        config: &Config,
        told: &Told,
        name: &str,
    ) -> Result<Photographs, Failure> {
        let side = config.network.resolution;
        let cutting = Cutting::named(&self.cutout).expect("one of the allowed values");
        let read = snapsnap_photo::read(sources, cutting, side, told.placement(config), told.focal)?;
        let doubts: Vec<String> = read.doubts.iter().map(ToString::to_string).collect();
        if self.strict && !doubts.is_empty() {
            bail!("{} (--strict)", doubts.join("; "));
        }
        doubts.iter().for_each(|doubt| say::note(&format!("{name}warning: {doubt}")));
        Ok(read)
    }
}

/// The name of the precision, and of the instructions that compute it on the CPU.
fn in_words(precision: Precision, device: &Device) -> String {
    let name = precision.name();
    if precision != Precision::Bf16 || !memory::is_cpu(device) {
        return name.into();
    }
    let by = match bf16::is_there() {
        true => "AVX-512",
        false => "f32 products of rounded weights: this processor has no bf16 instructions",
    };
    format!("{name}, by {by}")
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    match (&arguments.pairs, &arguments.front, &arguments.back) {
        (Some(pairs), ..) => pairs::run(arguments, pairs),
        (None, Some(front), Some(back)) => one(arguments, [front, back]),
        _ => unreachable!("clap requires both"),
    }
}

fn one(arguments: &Arguments, paths: [&PathBuf; 2]) -> Result<(), Failure> {
    let start = Instant::now();
    let Arguments { kind, shard, surface, .. } = arguments;
    must_be_unused(&[("--kind", kind.kind.is_some()), ("--shard", shard.shard.is_some())], ONE)?;
    let output = arguments.output.as_deref().unwrap_or(Path::new(DEFAULT_OUTPUT));
    let weights = arguments.model.open()?;
    let config = weights.config.clone();
    let mut times = vec![("opening weights", start.elapsed())];
    let mut timed = |name: &'static str, since: Instant| times.push((name, since.elapsed()));
    let turntable = arguments.turntable.as_deref().map(Turntable::new).transpose()?;
    let mut target = arguments.mesh.as_deref().map(|path| Target::new(path, surface)).transpose()?;
    if let Some(target) = target.as_mut().filter(|_| arguments.rig) {
        target.skin()?;
    }
    if target.is_none() {
        surface.must_be_unused("without --mesh there is no mesh to shape")?;
    }
    if arguments.masks.is_some() && arguments.cutout == "network" {
        bail!("--cutout network: --masks already tells the person from the background");
    }
    let told = arguments.camera.told(&config, arguments.as_is)?;
    let cutout_folder = arguments.save_cutouts.as_ref();
    cutout_folder.map_or(Ok(()), |folder| check_folder(folder))?;
    let saved = cutout_folder.map(|folder| ["front.png", "back.png"].map(|name| folder.join(name)));
    let config_path =
        check_paths(arguments, paths, output, weights.path(), turntable.as_ref(), target.as_ref(), &saved)?;
    target.iter().try_for_each(Target::check_companions)?;
    paths.iter().try_for_each(|path| check_memory(path, picture::size(path, None)?))?;
    let masks = arguments.masks.as_deref().unwrap_or_default();
    let since = Instant::now();
    let sources =
        [0, 1].map(|i| Source { mask: masks.get(i).map(PathBuf::as_path), ..Source::file(paths[i]) });
    let mut photographs = arguments.read(&sources, &config, &told, "")?;
    timed("photographs", since);
    for (path, (rgb, mask)) in saved.iter().flatten().zip(std::mem::take(&mut photographs.cutouts)) {
        save_cutout(path, &rgb, &mask)?;
    }
    let since = Instant::now();
    let device = arguments.model.device_for_one(&weights)?;
    timed("finding the device", since);

    let progress = Progress::stages();
    progress.stage("loading weights");
    let since = Instant::now();
    let (networks, precision) = arguments.model.load(&weights, &device)?;
    timed("loading weights", since);
    let person = snapsnap_photo::person(&photographs, &networks, &told, &|name| progress.stage(name));
    let Person { gaussians, seats, mut made } = person.map_err(|none| match &none {
        NoPerson::Empty { steps } => {
            let steps: String = steps.iter().map(|step| format!("\n  {step}")).collect();
            Failure::file(weights.path(), format!("{none}, so nothing was written; the steps:{steps}"))
        }
        NoPerson::Camera { .. } => none.into(),
    })?;
    times.append(&mut made.times);

    progress.stage("writing");
    let since = Instant::now();
    arguments.axes.write(&Stored::of(&gaussians)?, output)?;
    if let Some(path) = &config_path {
        output::write(path, config.resolved().to_toml().as_bytes())?;
    }
    if let Some(path) = &arguments.dump {
        dump::write(&made, path)?;
    }
    // Frees the point maps before turntable and mesh need memory.
    let steps = std::mem::take(&mut made.steps);
    drop(made);
    times.push(("writing", since.elapsed()));
    drop(progress);
    if let Some(turntable) = &turntable {
        let since = Instant::now();
        turntable.write(&gaussians)?;
        times.push(("turntable", since.elapsed()));
    }
    let mut surface = None;
    if let Some(target) = &target {
        let since = Instant::now();
        surface = Some(mesh::describe(&target.write(&gaussians.clone().into(), output)?));
        times.push(("mesh", since.elapsed()));
    }
    times.push(("total", start.elapsed()));
    let print = say::beside(output);
    let settings = [
        ("device", device::describe(&device)),
        ("weights", weights.path().display().to_string()),
        ("precision", in_words(precision, &device)),
    ];
    if arguments.json {
        let settings = settings.map(|(name, value)| (name.to_owned(), json!(value)));
        let times = times.iter().map(|(name, time)| json!({ "module": name, "seconds": time.as_secs_f64() }));
        let mut report = Value::Object(settings.into_iter().collect());
        report["output"] = json!(output.display().to_string());
        report["gaussians"] = json!(gaussians.len());
        report["photographs"] = json!(photographs.reports);
        report["doubts"] = json!(photographs.doubts);
        report["cameras"] = json!(seats);
        report["steps"] = json!(steps);
        report["times"] = times.collect();
        report["mesh"] = json!(surface);
        // A pipe or a device may be stdout.
        if file::is_special(output) {
            say::err(&report.to_string());
            return Ok(());
        }
        return say::json(&report.to_string());
    }
    if arguments.verbose {
        print("steps");
        let line = |text: &dyn Display| print(&format!("  {text}"));
        let of_both = |what: &dyn Display, i: usize| line(&format!("{}: {what}", ["front", "back"][i]));
        settings.iter().for_each(|(name, value)| line(&format!("{name}: {value}")));
        photographs.reports.iter().enumerate().for_each(|(i, report)| of_both(report, i));
        steps.iter().for_each(|step| line(step));
        seats.iter().flatten().enumerate().for_each(|(i, seat)| of_both(seat, i));
        surface.iter().for_each(|surface| line(surface));
        print("time, device synchronised");
        for (name, time) in times {
            print(&format!("  {name:<26} {:>9.1} ms", time.as_secs_f64() * 1e3));
        }
    }
    if !say::is_quiet() {
        print(&format!("{}: {} Gaussians", output.display(), gaussians.len()));
    }
    Ok(())
}

/// Refuses outputs that cannot be written or would destroy an input. Returns the path of the output config, which is
/// not written beside a pipe or a device, or over the given config.
fn check_paths(
    arguments: &Arguments,
    [front, back]: [&PathBuf; 2],
    output: &Path,
    weights: &Path,
    turntable: Option<&Turntable>,
    mesh: Option<&Target>,
    saved: &Option<[PathBuf; 2]>,
) -> Result<Option<PathBuf>, Failure> {
    let mut inputs: Vec<&Path> = vec![front, back, weights];
    inputs.extend(arguments.masks.iter().flatten().map(PathBuf::as_path));
    let mut config_path = output.as_os_str().to_owned();
    config_path.push(".config.toml");
    let config_path = PathBuf::from(config_path);
    let given = arguments.model.config.config.as_deref();
    let is_given = given.is_some_and(|given| is_same_file(given, &config_path));
    let config_path = (!is_given && !file::is_special(output)).then_some(config_path);
    inputs.extend(given);
    let outputs = [Some(output), arguments.dump.as_deref(), config_path.as_deref()];
    let mut outputs: Vec<&Path> = outputs.into_iter().flatten().collect();
    outputs.extend(mesh.map(Target::files).unwrap_or_default());
    // A missing folder has no files that could be in the way.
    outputs.extend(
        saved.iter().flatten().map(PathBuf::as_path).filter(|path| path.parent().is_some_and(Path::is_dir)),
    );
    let mut pictures = Vec::new();
    if let Some(turntable) = turntable {
        outputs.iter().try_for_each(|output| turntable.check_apart(output))?;
        pictures = turntable.outputs();
    }
    outputs.extend(pictures.iter().map(PathBuf::as_path));
    check_outputs(&outputs, &inputs)?;
    check_kind(output)?;
    arguments.axes.check(output)?;
    Ok(config_path)
}
