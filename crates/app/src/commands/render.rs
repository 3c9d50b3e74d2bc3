//! `snapsnap render`.

use std::fs::File;
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::slice;
use std::time::Instant;

use burn::tensor::{Device, Tensor};
use clap::Args;
use serde_json::json;
use snapsnap_base::{FileError, file};
use snapsnap_splat::{
    Camera, Counts, MAX_SIDE, Preset, RenderOptions, Rendered, SplatError, camera_file, render,
};

use super::convert::read;
use crate::arguments::one_of;
use crate::batch::{self, ShardArgument, must_be_unused};
use crate::failure::{Failure, bail};
use crate::output::check_outputs;
use crate::pictures::{picture, read_back};
use crate::progress::Progress;
use crate::view_folder::{CAMERAS, ViewFolder};
use crate::{device, say};

/// Side of an orbit's pictures.
const DEFAULT_SIDE: u32 = 1024;
/// Largest picture, in pixels.
const MAX_PIXELS: u64 = 1 << 26;
/// Largest number of pairs of a splat and a tile in a picture without --force: about two seconds on two cores. A scene
/// of five million Gaussians has half as many.
pub const MAX_INTERSECTIONS: u64 = 100_000_000;
/// Default folder of the pictures.
const DEFAULT_FOLDER: &str = "renders";
const PRESETS: [(&str, &str, Preset); 2] = [
    ("inria", "The original rasteriser: largest α 0.99, near plane 0.2 m", Preset::Inria),
    ("gsplat", "gsplat 1.5: largest α 0.999, near plane 0.01 m", Preset::Gsplat),
];

#[derive(Args, Clone)]
#[command(group = clap::ArgGroup::new("views").required(true).args(["cameras", "orbit"]))]
pub struct Arguments {
    /// File of Gaussians: PLY, SPZ or GLB, SH degree 0 to 3; or a folder of such files.
    ply: PathBuf,
    /// Cameras to render into.
    #[arg(long, value_name = "cameras.json")]
    cameras: Option<PathBuf>,
    /// Number of views around a person, the first from the front.
    #[arg(long, value_name = "N")]
    orbit: Option<usize>,
    /// Size of the pictures, or side of square ones [default: the cameras' own; 1024x1024 for an orbit].
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<[u32; 2]>,
    /// Colour behind the Gaussians: black, grey, white, or three numbers from 0 to 1.
    #[arg(long, value_name = "R,G,B", value_parser = color, default_value = "0,0,0")]
    background: [f32; 3],
    /// Folder for 000.png, 001.png, … and cameras.json [default: renders, unless --raw is given]. Each of several
    /// files gets a folder in it.
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Also write colour, alpha and depth as f32 tensors.
    #[arg(long, value_name = "FILE.safetensors")]
    raw: Option<PathBuf>,
    /// Constants of the rasteriser.
    #[arg(long, value_parser = one_of(PRESETS), default_value = "inria")]
    preset: Preset,
    /// Antialiasing: splats that are enlarged to the size of a pixel become fainter in return.
    #[arg(long)]
    antialiased: bool,
    /// Also render pictures that take very long.
    #[arg(long)]
    force: bool,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Print the numbers of omitted Gaussians with the reasons, and the time.
    #[arg(short, long)]
    verbose: bool,
    #[command(flatten)]
    shard: ShardArgument,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    if !arguments.ply.is_dir() {
        must_be_unused(&[("--shard", arguments.shard.shard.is_some())], batch::ONE)?;
        return one(arguments, &device::choose(&arguments.device)?);
    }
    if arguments.raw.is_some() {
        bail!("--raw: takes one file of Gaussians, {} is a folder", arguments.ply.display());
    }
    views(arguments)?;
    let target = arguments.output.as_deref().unwrap_or(Path::new(DEFAULT_FOLDER));
    let done = |name: &str| target.join(name).join(CAMERAS);
    let device = device::choose(&arguments.device)?;
    batch::each(&arguments.ply, target, &arguments.shard, done, |path, name| {
        let one_of = Arguments { ply: path.to_owned(), output: Some(target.join(name)), ..arguments.clone() };
        one(&one_of, &device)
    })
}

fn one(arguments: &Arguments, device: &Device) -> Result<(), Failure> {
    let views = views(arguments)?;
    if arguments.raw.is_some() {
        check_raw(&views)?;
    }
    let default = arguments.raw.is_none().then_some(Path::new(DEFAULT_FOLDER));
    let folder = arguments.output.as_deref().or(default);
    let folder =
        folder.map(|path| ViewFolder::new(path, views.len(), arguments.cameras.as_deref())).transpose()?;
    check_paths(arguments, folder.as_ref())?;
    if let (Some(path), Some([width, height])) = (&arguments.cameras, arguments.size)
        && folder.as_ref().is_some_and(|folder| folder.keeps_cameras)
        && camera_file::read(path)? != views
    {
        bail!(
            "--size {width}x{height}: {} describes the pictures beside it, which would have another size: give \
             another folder",
            path.display()
        );
    }
    let start = Instant::now();
    let loaded = read(&arguments.ply)?.load(device);
    let reading = start.elapsed();
    let background =
        (arguments.background != [0.0; 3]).then(|| Tensor::<1>::from_floats(arguments.background, device));
    let options = RenderOptions {
        antialiased: arguments.antialiased,
        background,
        depth: arguments.raw.is_some(),
        max_intersections: if arguments.force { u64::MAX } else { MAX_INTERSECTIONS },
        ..arguments.preset.options()
    };

    if let Some(folder) = &folder {
        folder.begin()?;
    }
    let start = Instant::now();
    let mut raw = arguments.raw.as_deref().map(Raw::new).transpose()?;
    let mut counts = Vec::with_capacity(views.len());
    for (i, camera) in Progress::over(views.iter(), "views").enumerate() {
        // SH colours depend on the camera's position.
        let rendered = render(&loaded.seen_by(camera)?, slice::from_ref(camera), &options);
        let rendered = rendered.map_err(|e| match e {
            SplatError::TooManyIntersections { found, limit: MAX_INTERSECTIONS } => {
                let [found, most] = [found, MAX_INTERSECTIONS].map(|pairs| pairs / 1_000_000);
                let message = format!(
                    "view {i} has {found} million pairs of a splat and a 16×16 tile, more than {most} million, which \
                     take seconds: render a smaller picture, or add --force"
                );
                Failure::file(&arguments.ply, message)
            }
            e => e.into(),
        })?;
        counts.push(rendered.counts);
        if let Some(folder) = &folder {
            folder.write(i, &picture(&rendered.color)?)?;
        }
        if let Some(raw) = &mut raw {
            raw.add(rendered)?;
        }
    }
    if let Some(raw) = raw {
        raw.write(&views)?;
    }
    if let Some(folder) = &folder {
        folder.finish(&views)?;
    }
    let rendering = start.elapsed();
    let n = loaded.gaussians.len();
    let say = arguments.raw.as_deref().map_or(say::out as fn(&str), say::beside);
    if arguments.verbose {
        report(say, n, &counts, device);
        let [reading, rendering] = [reading, rendering].map(|time| time.as_secs_f64() * 1e3);
        say(&format!("reading {reading:.1} ms, rendering and writing {rendering:.1} ms"));
    }
    let empty = counts.iter().filter(|c| c.visible == 0).count();
    if empty > 0 {
        say::note(&format!("warning: {empty} of {} views show no Gaussian (see --verbose)", counts.len()));
    }
    if say::is_quiet() {
        return Ok(());
    }
    let folder = folder.as_ref().map(|folder| folder.path.as_path());
    let outputs = folder.into_iter().chain(arguments.raw.as_deref());
    let outputs: Vec<String> = outputs.map(|path| path.display().to_string()).collect();
    say(&format!("{}: {} views of {n} Gaussians", outputs.join(", "), views.len()));
    Ok(())
}

/// The cameras of the command line. None has too many pixels.
fn views(arguments: &Arguments) -> Result<Vec<Camera>, Failure> {
    let views = match (&arguments.cameras, arguments.orbit.unwrap_or(0)) {
        (Some(path), _) => {
            let mut views = camera_file::read_any(path, arguments.size)?;
            if let Some(size) = arguments.size {
                resize(&mut views, size, path)?;
            }
            views
        }
        (None, count @ 1..=100_000) => {
            let [width, height] = arguments.size.unwrap_or([DEFAULT_SIDE; 2]);
            Camera::orbit(count, width, height)
        }
        (None, count) => bail!("--orbit {count}: expected 1 to 100000 views"),
    };
    for (i, Camera { width, height, .. }) in views.iter().enumerate() {
        if u64::from(*width) * u64::from(*height) > MAX_PIXELS {
            let most = MAX_PIXELS / 1_000_000;
            bail!("camera {i}: {width}x{height} is more than {most} megapixels");
        }
    }
    Ok(views)
}

/// Resizes the cameras of the file `path`, which must have the same aspect ratio but for a pixel of rounding.
fn resize(views: &mut [Camera], [width, height]: [u32; 2], path: &Path) -> Result<(), Failure> {
    for (i, camera) in views.iter_mut().enumerate() {
        let Camera { width: w, height: h, .. } = *camera;
        let scaled = f64::from(h) * f64::from(width) / f64::from(w);
        if (scaled - f64::from(height)).abs() > 1.0 {
            let path = path.display();
            bail!("--size {width}x{height}: camera {i} of {path} is {w}x{h}, another shape");
        }
        *camera = camera.resized(width, height);
    }
    Ok(())
}

/// Refuses outputs that cannot be written, that are given twice or that are inputs.
fn check_paths(arguments: &Arguments, folder: Option<&ViewFolder>) -> Result<(), Failure> {
    let mut outputs = folder.map(ViewFolder::replaced).unwrap_or_default();
    if let Some(raw) = &arguments.raw {
        folder.map_or(Ok(()), |folder| folder.check_apart(raw))?;
        outputs.push(raw.clone());
    }
    let mut inputs = vec![arguments.ply.as_path()];
    inputs.extend(arguments.cameras.as_deref());
    let outputs: Vec<&Path> = outputs.iter().map(PathBuf::as_path).collect();
    check_outputs(&outputs, &inputs)
}

/// Refuses views of different sizes, which do not fit into one tensor.
fn check_raw(views: &[Camera]) -> Result<(), Failure> {
    let size = |camera: &Camera| format!("{}x{}", camera.width, camera.height);
    let first = size(&views[0]);
    for (i, size) in views.iter().map(size).enumerate() {
        if size != first {
            let sizes = format!("camera {i} is {size}, camera 0 is {first}");
            bail!("--raw: all views must have one size; {sizes} (see --size)");
        }
    }
    Ok(())
}

/// Colour `[V,H,W,3]`, alpha and depth `[V,H,W]`. Each view is written to temporary files, since all views together
/// may be larger than memory.
struct Raw {
    path: PathBuf,
    parts: [BufWriter<File>; 3],
}

impl Raw {
    fn new(path: &Path) -> Result<Self, Failure> {
        // The output's file system has room for the values. A pipe has no file system.
        let is_special = file::is_special(path);
        let folder = if is_special { std::env::temp_dir() } else { file::folder_of(path).to_owned() };
        let part = || tempfile::tempfile_in(&folder).map_err(FileError::write(path));
        let parts = [part()?, part()?, part()?].map(BufWriter::new);
        Ok(Self { path: path.to_owned(), parts })
    }

    fn add(&mut self, rendered: Rendered) -> Result<(), Failure> {
        let depth = rendered.depth.expect("asked for together with --raw");
        let tensors = [rendered.color.reshape([-1]), rendered.alpha.reshape([-1]), depth.reshape([-1])];
        for (file, tensor) in self.parts.iter_mut().zip(tensors) {
            let bytes: Vec<u8> = read_back(tensor)?.iter().flat_map(|v| v.to_le_bytes()).collect();
            file.write_all(&bytes).map_err(FileError::write(&self.path))?;
        }
        Ok(())
    }

    /// A safetensors file: the length of the header, the header, the tensors one after another.
    fn write(self, views: &[Camera]) -> Result<(), Failure> {
        let [v, h, w] = [views.len(), views[0].height as usize, views[0].width as usize];
        let plane = 4 * v * h * w;
        let mut header = json!({
            "color": { "dtype": "F32", "shape": [v, h, w, 3], "data_offsets": [0, 3 * plane] },
            "alpha": { "dtype": "F32", "shape": [v, h, w], "data_offsets": [3 * plane, 4 * plane] },
            "depth": { "dtype": "F32", "shape": [v, h, w], "data_offsets": [4 * plane, 5 * plane] },
        })
        .to_string()
        .into_bytes();
        header.resize(header.len().next_multiple_of(8), b' ');
        let path = self.path;
        let written = file::write_whole(&path, |out| -> io::Result<()> {
            out.write_all(&(header.len() as u64).to_le_bytes())?;
            out.write_all(&header)?;
            for part in self.parts {
                let mut part = part.into_inner().map_err(io::IntoInnerError::into_error)?;
                part.rewind()?;
                io::copy(&mut part, out)?;
            }
            Ok(())
        });
        Ok(written.map_err(FileError::write(&path))?)
    }
}

fn report(say: fn(&str), n: usize, counts: &[Counts], device: &Device) {
    say(&format!("device: {}", device::describe(device)));
    say(&format!("{n} Gaussians; per view, on average:"));
    let line = |name: &str, count: fn(&Counts) -> u64| {
        let mean = counts.iter().map(count).sum::<u64>() as f64 / counts.len() as f64;
        say(&format!("  {name:<34} {mean:>12.1}"));
    };
    line("visible", |c| c.visible);
    line("left out: before the near plane", |c| c.near);
    line("left out: outside the picture", |c| c.outside);
    line("left out: transparent", |c| c.transparent);
    line("left out: degenerate", |c| c.degenerate);
    line("left out: not finite or huge", |c| c.invalid);
    line("pairs of a splat and a tile", |c| c.intersections);
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let side = |text: &str| text.trim().parse::<u32>().ok().filter(|side| (1..=MAX_SIDE).contains(side));
    let (width, height) = text.split_once(['x', 'X']).unwrap_or((text, text));
    let sides = side(width).zip(side(height)).map(<[u32; 2]>::from);
    sides.ok_or_else(|| format!("expected a side, or WIDTHxHEIGHT, each from 1 to {MAX_SIDE} pixels"))
}

fn color(text: &str) -> Result<[f32; 3], String> {
    let text = match text {
        "black" => "0,0,0",
        "grey" => "0.5,0.5,0.5",
        "white" => "1,1,1",
        numbers => numbers,
    };
    let channel = |text: &str| text.trim().parse::<f32>().ok().filter(|c| (0.0..=1.0).contains(c));
    let channels: Option<Vec<f32>> = text.split(',').map(channel).collect();
    channels
        .and_then(|channels| channels.try_into().ok())
        .ok_or_else(|| "expected black, grey, white or three numbers from 0 to 1, for example 1,1,1".into())
}
