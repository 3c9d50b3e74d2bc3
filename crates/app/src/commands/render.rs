//! `snapsnap render`.

use std::fs::File;
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use burn::tensor::{Device, Tensor};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use snapsnap_base::file;
use snapsnap_splat::scene::{self, Loaded};
use snapsnap_splat::{Camera, Counts, MAX_SIDE, Preset, RenderOptions, Rendered, cameras, render};

use super::check_outputs;
use crate::failure::Failure;
use crate::pictures::{picture, read_back};
use crate::progress::Progress;
use crate::view_folder::ViewFolder;
use crate::{device, say};

/// Side of an orbit's pictures.
const DEFAULT_SIDE: u32 = 1024;
/// Largest picture, in pixels.
const MAX_PIXELS: u64 = 1 << 26;
/// Where pictures go if no output is named.
const DEFAULT_FOLDER: &str = "renders";

#[derive(Args)]
#[command(group = clap::ArgGroup::new("views").required(true).args(["cameras", "orbit"]))]
pub struct Arguments {
    /// Gaussian PLY, SH degree 0 to 3.
    ply: PathBuf,
    /// Cameras to render into.
    #[arg(long, value_name = "cameras.json")]
    cameras: Option<PathBuf>,
    /// So many views around a person, the first from the front.
    #[arg(long, value_name = "N")]
    orbit: Option<usize>,
    /// Size of the pictures [default: the cameras' own; 1024x1024 for an orbit].
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<[u32; 2]>,
    /// Colour behind the Gaussians, each from 0 to 1.
    #[arg(long, value_name = "R,G,B", value_parser = color, default_value = "0,0,0")]
    background: [f32; 3],
    /// Folder for 000.png, 001.png, … and cameras.json [default: renders, unless --raw is given].
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Also write colour, alpha and depth as f32 tensors.
    #[arg(long, value_name = "FILE.safetensors")]
    raw: Option<PathBuf>,
    /// Constants of the rasteriser.
    #[arg(long, value_parser = preset(), default_value = "inria")]
    preset: Preset,
    /// Keep the weight of splats smaller than a pixel.
    #[arg(long)]
    antialiased: bool,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Print what was left out and why, and the time.
    #[arg(short, long)]
    verbose: bool,
}

pub fn run(arguments: &Arguments, quiet: bool) -> Result<(), Failure> {
    let views = views(arguments)?;
    let folder = match (&arguments.output, &arguments.raw) {
        (None, Some(_)) => None,
        (given, _) => Some(given.clone().unwrap_or_else(|| DEFAULT_FOLDER.into())),
    };
    if arguments.raw.is_some() {
        check_raw(&views)?;
    }
    let folder =
        folder.map(|path| ViewFolder::new(&path, views.len(), arguments.cameras.as_deref())).transpose()?;
    check_paths(arguments, folder.as_ref())?;
    let device = device::choose(&arguments.device)?;
    let start = Instant::now();
    let loaded = scene::read(&arguments.ply, &device)?;
    let reading = start.elapsed();
    // Black costs nothing, and depth is computed for --raw only.
    let background =
        (arguments.background != [0.0; 3]).then(|| Tensor::<1>::from_floats(arguments.background, &device));
    let options = RenderOptions {
        antialiased: arguments.antialiased,
        background,
        depth: arguments.raw.is_some(),
        ..arguments.preset.options()
    };

    if let Some(folder) = &folder {
        folder.begin()?;
    }
    let progress = Progress::steps(quiet, views.len(), "views");
    let start = Instant::now();
    let mut raw = arguments.raw.as_deref().map(Raw::new).transpose()?;
    let mut counts = Vec::with_capacity(views.len());
    for (i, camera) in views.iter().enumerate() {
        let rendered = view(&loaded, camera, &options)?;
        counts.push(rendered.counts);
        if let Some(folder) = &folder {
            folder.write(i, &picture(&rendered.color)?)?;
        }
        if let Some(raw) = &mut raw {
            raw.add(rendered)?;
        }
        progress.step(i + 1, views.len(), "views");
    }
    if let Some(raw) = raw {
        raw.write(&views)?;
    }
    if let Some(folder) = &folder {
        folder.finish(&views)?;
    }
    drop(progress);
    let rendering = start.elapsed();
    let n = loaded.gaussians.len();
    // What goes into a pipe must stay a tensor file.
    let special = arguments.raw.as_ref().is_some_and(|path| file::is_special(path));
    let say = if special { say::err } else { say::out };
    if arguments.verbose {
        report(say, n, &counts, &device);
        say(&format!("reading {:.1} ms, rendering and writing {:.1} ms", ms(reading), ms(rendering)));
    }
    let visible = counts.iter().filter(|c| c.visible > 0).count();
    if visible < counts.len() && !quiet {
        let empty = counts.len() - visible;
        say::err(&format!("warning: {empty} of {} views show no Gaussian (see --verbose)", counts.len()));
    }
    if !quiet {
        let folder = folder.as_ref().map(ViewFolder::path);
        let outputs = folder.into_iter().chain(arguments.raw.as_deref());
        let outputs: Vec<String> = outputs.map(|path| path.display().to_string()).collect();
        say(&format!("{}: {} views of {n} Gaussians", outputs.join(", "), views.len()));
    }
    Ok(())
}

/// Renders one view, with the colours that its direction gives.
fn view(loaded: &Loaded, camera: &Camera, options: &RenderOptions) -> Result<Rendered, Failure> {
    Ok(render(&loaded.seen_by(camera)?, std::slice::from_ref(camera), options)?)
}

fn views(arguments: &Arguments) -> Result<Vec<Camera>, Failure> {
    let views = unchecked_views(arguments)?;
    let pixels = |camera: &Camera| u64::from(camera.width) * u64::from(camera.height);
    if let Some(i) = views.iter().position(|camera| pixels(camera) > MAX_PIXELS) {
        let Camera { width, height, .. } = views[i];
        let most = MAX_PIXELS / 1_000_000;
        return Err(Failure::Input(format!("camera {i}: {width}x{height} is more than {most} megapixels")));
    }
    Ok(views)
}

fn unchecked_views(arguments: &Arguments) -> Result<Vec<Camera>, Failure> {
    match (&arguments.cameras, arguments.orbit) {
        (Some(path), _) => {
            let mut views = cameras::read(path)?;
            if let Some([width, height]) = arguments.size {
                for (i, camera) in views.iter_mut().enumerate() {
                    // One pixel of rounding is no other shape.
                    let scaled = f64::from(camera.height) * f64::from(width) / f64::from(camera.width);
                    if (scaled - f64::from(height)).abs() > 1.0 {
                        let (w, h) = (camera.width, camera.height);
                        let message = format!(
                            "--size {width}x{height}: camera {i} of {} is {w}x{h}, another shape",
                            path.display()
                        );
                        return Err(Failure::Input(message));
                    }
                    *camera = camera.resized(width, height);
                }
            }
            Ok(views)
        }
        (None, Some(count @ 1..=100_000)) => {
            let [width, height] = arguments.size.unwrap_or([DEFAULT_SIDE; 2]);
            Ok(Camera::orbit(count, width, height))
        }
        (None, count) => {
            let count = count.unwrap_or(0);
            Err(Failure::Input(format!("--orbit {count}: expected 1 to 100000 views")))
        }
    }
}

/// Refuses outputs that cannot be written, that are one another or that are an input.
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

/// A tensor has one shape: all views must have one size.
fn check_raw(views: &[Camera]) -> Result<(), Failure> {
    let size = |camera: &Camera| [camera.width, camera.height];
    let other = views.iter().position(|camera| size(camera) != size(&views[0]));
    other.map_or(Ok(()), |i| {
        let ([w, h], [first_w, first_h]) = (size(&views[i]), size(&views[0]));
        let message = format!("camera {i} is {w}x{h}, camera 0 is {first_w}x{first_h}");
        Err(Failure::Input(format!("--raw: all views must have one size; {message} (see --size)")))
    })
}

/// Colour `[V,H,W,3]`, alpha and depth `[V,H,W]`, view by view into temporary files: together they may be larger than
/// memory.
struct Raw {
    path: PathBuf,
    parts: [(&'static str, BufWriter<File>); 3],
}

impl Raw {
    fn new(path: &Path) -> Result<Self, Failure> {
        // Beside the file that they become, where there is room for it; a pipe has no such place.
        let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let folder = if file::is_special(path) {
            std::env::temp_dir()
        } else {
            folder.unwrap_or(Path::new(".")).into()
        };
        let part = |name| io::Result::Ok((name, BufWriter::new(tempfile::tempfile_in(&folder)?)));
        let parts = || -> io::Result<_> { Ok([part("color")?, part("alpha")?, part("depth")?]) };
        Ok(Self { path: path.to_owned(), parts: parts().map_err(|e| Failure::cannot_write(path, &e))? })
    }

    fn add(&mut self, rendered: Rendered) -> Result<(), Failure> {
        let depth = rendered.depth.expect("asked for together with --raw");
        let tensors = [rendered.color.reshape([-1]), rendered.alpha.reshape([-1]), depth.reshape([-1])];
        for ((_, file), tensor) in self.parts.iter_mut().zip(tensors) {
            let bytes: Vec<u8> = read_back(tensor)?.iter().flat_map(|v| v.to_le_bytes()).collect();
            file.write_all(&bytes).map_err(|e| Failure::cannot_write(&self.path, &e))?;
        }
        Ok(())
    }

    /// A safetensors file: the length of the header, the header, the tensors one after another.
    fn write(self, views: &[Camera]) -> Result<(), Failure> {
        let [v, h, w] = [views.len(), views[0].height as usize, views[0].width as usize];
        let mut header = serde_json::Map::new();
        let mut start = 0;
        for (name, shape) in [("color", vec![v, h, w, 3]), ("alpha", vec![v, h, w]), ("depth", vec![v, h, w])]
        {
            let end = start + 4 * shape.iter().product::<usize>();
            let entry = serde_json::json!({ "dtype": "F32", "shape": shape, "data_offsets": [start, end] });
            header.insert(name.into(), entry);
            start = end;
        }
        let mut header = serde_json::Value::Object(header).to_string();
        while !header.len().is_multiple_of(8) {
            header.push(' ');
        }
        let path = self.path;
        file::write_whole(&path, |out| -> io::Result<()> {
            out.write_all(&(header.len() as u64).to_le_bytes())?;
            out.write_all(header.as_bytes())?;
            for (_, part) in self.parts {
                let mut part = part.into_inner().map_err(io::IntoInnerError::into_error)?;
                part.rewind()?;
                io::copy(&mut part, out)?;
            }
            Ok(())
        })
        .map_err(|e| Failure::cannot_write(&path, &e))
    }
}

/// One of the counts.
type Field = fn(&Counts) -> u64;

fn report(say: fn(&str), n: usize, counts: &[Counts], device: &Device) {
    say(&format!("device: {}", device::describe(device)));
    let mean = |count: fn(&Counts) -> u64| counts.iter().map(count).sum::<u64>() as f64 / counts.len() as f64;
    say(&format!("{n} Gaussians; per view, on average:"));
    let lines: [(&str, Field); 7] = [
        ("visible", |c| c.visible),
        ("left out: before the near plane", |c| c.near),
        ("left out: outside the picture", |c| c.outside),
        ("left out: transparent", |c| c.transparent),
        ("left out: degenerate", |c| c.degenerate),
        ("left out: not finite or huge", |c| c.invalid),
        ("pairs of a splat and a tile", |c| c.intersections),
    ];
    for (name, count) in lines {
        say(&format!("  {name:<34} {:>12.1}", mean(count)));
    }
}

fn ms(time: std::time::Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

fn preset() -> impl TypedValueParser<Value = Preset> {
    let values = [
        PossibleValue::new("inria").help("The original rasteriser: largest α 0.99, near plane 0.2 m"),
        PossibleValue::new("gsplat").help("gsplat 1.5: largest α 0.999, near plane 0.01 m"),
    ];
    PossibleValuesParser::new(values).map(|name| match name.as_str() {
        "gsplat" => Preset::Gsplat,
        _ => Preset::Inria,
    })
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let side = |text: &str| text.trim().parse::<u32>().ok().filter(|side| (1..=MAX_SIDE).contains(side));
    let sides = text.split_once(['x', 'X']).and_then(|(w, h)| Some([side(w)?, side(h)?]));
    sides.ok_or_else(|| format!("expected WIDTHxHEIGHT, each from 1 to {MAX_SIDE} pixels"))
}

fn color(text: &str) -> Result<[f32; 3], String> {
    let channel = |text: &str| text.trim().parse::<f32>().ok().filter(|c| (0.0..=1.0).contains(c));
    let channels: Option<Vec<f32>> = text.split(',').map(channel).collect();
    channels
        .and_then(|channels| channels.try_into().ok())
        .ok_or_else(|| "expected three numbers from 0 to 1, for example 1,1,1".into())
}
