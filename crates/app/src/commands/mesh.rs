//! `snapsnap mesh`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use burn::tensor::Device;
use clap::Args;
use snapsnap_mesh::export::{self, Kind, glb_bytes};
use snapsnap_mesh::fuse::{Fused, Options, fuse};
use snapsnap_splat::scene::Loaded;

use super::convert::read;
use super::rig;
use crate::batch::{self, ShardArgument, must_be_unused};
use crate::failure::Failure;
use crate::output::{self, check_outputs};
use crate::progress::Progress;
use crate::{device, memory, say};

/// Bytes of the views and the field, and of each Gaussian besides its harmonics, as measured.
const FIELD: u64 = 700_000_000;
const GAUSSIAN: u64 = 220;
/// Seconds per Gaussian on two cores of an AMD EPYC, and seconds from which the estimate is printed.
const SECONDS: f64 = 1e-5;
const LONG: f64 = 20.0;
/// Bytes per texel: position, normal, colour, and sums over views.
const TEXEL: u64 = 60;
/// Side of the texture of a GLB in pixels unless `--texture` is given.
const GLB_TEXTURE: u32 = 2048;
/// Volume of a dropped piece, as a share of the body's, from which on it may be another person.
const COMPARABLE: f64 = 0.1;

#[derive(Args, Clone)]
pub struct Arguments {
    /// File of Gaussians: PLY, SPZ or GLB; or a folder of such files.
    input: PathBuf,
    /// Output file: .glb, .obj or .ply; .stl or .3mf, in millimetres, for printers; or a folder.
    #[arg(short, long, value_name = "FILE|DIR")]
    output: PathBuf,
    /// With a folder: kind of the meshes [default: glb].
    #[arg(long, value_parser = ["glb", "obj", "ply", "stl", "3mf"])]
    kind: Option<String>,
    #[command(flatten)]
    shard: ShardArgument,
    #[command(flatten)]
    surface: SurfaceArguments,
    /// Also make meshes that take far longer than a person's.
    #[arg(long)]
    force: bool,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Print the joined and dropped parts, and the time.
    #[arg(short, long)]
    verbose: bool,
}

/// Options of a surface.
#[derive(Args, Clone)]
pub struct SurfaceArguments {
    /// Approximate number of triangles of the mesh; 0 keeps all [default: 100000].
    #[arg(long, value_name = "N")]
    faces: Option<usize>,
    /// Side in pixels of a texture, 64 to 16384, or 0 for colours of vertices. Only .glb and .obj have textures
    /// [default: 2048 for .glb, else 0].
    #[arg(long, value_name = "SIZE", value_parser = texture_side)]
    texture: Option<u32>,
}

impl SurfaceArguments {
    /// Refuses options that have no effect without a mesh.
    pub fn must_be_unused(&self, why: &str) -> Result<(), Failure> {
        must_be_unused(&[("--faces", self.faces.is_some()), ("--texture", self.texture.is_some())], why)
    }
}

fn texture_side(text: &str) -> Result<u32, String> {
    let side = text.parse().ok().filter(|side| *side == 0 || (64..=16384).contains(side));
    side.ok_or_else(|| "expected 64 to 16384, or 0 for colours of vertices".to_owned())
}

/// Options for a kind of file.
pub fn options(kind: Kind) -> Options {
    Options { texture: if kind == Kind::Glb { GLB_TEXTURE as usize } else { 0 }, ..Options::default() }
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let Arguments { input, output, kind, shard, .. } = arguments;
    if !input.is_dir() {
        must_be_unused(&[("--kind", kind.is_some()), ("--shard", shard.shard.is_some())], batch::ONE)?;
        return one(arguments, &device::choose(&arguments.device)?);
    }
    let file = |name: &str| output.join(format!("{name}.{}", kind.as_deref().unwrap_or("glb")));
    Target::new(&file("x"), &arguments.surface)?;
    let device = device::choose(&arguments.device)?;
    batch::each(input, output, shard, file, |path, name| {
        let one_of = Arguments { input: path.to_owned(), output: file(name), ..arguments.clone() };
        one(&one_of, &device)
    })
}

fn one(arguments: &Arguments, device: &Device) -> Result<(), Failure> {
    let since = Instant::now();
    let mut target = Target::new(&arguments.output, &arguments.surface)?;
    target.options.force = arguments.force;
    check_outputs(&target.files(), &[&arguments.input])?;
    target.check_companions()?;
    let loaded = read(&arguments.input)?.load(device);
    check_size(&loaded, device).map_err(|e| e.about(&arguments.input))?;
    let fused = target.write(&loaded, &arguments.input)?;
    if arguments.verbose {
        say::out(&describe(&fused));
        say::out(&format!("{:.1} s", since.elapsed().as_secs_f64()));
    }
    let (file, faces) = (arguments.output.display(), fused.mesh.faces.len());
    say::info(&format!("{file}: {faces} triangles, {} positions", fused.mesh.positions.len()));
    Ok(())
}

/// Refuses a mesh that memory cannot hold, and says how long one of very many Gaussians takes.
fn check_size(scene: &Loaded, device: &Device) -> Result<(), Failure> {
    let count = scene.gaussians.len() as u64;
    let harmonics = scene.harmonics.as_ref().map_or(0, |h| 4 * h.dims()[1] as u64 * 3);
    if memory::is_cpu(device) {
        let bytes = FIELD + count * (GAUSSIAN + 2 * harmonics);
        memory::check(&format!("a mesh of {count} Gaussians"), bytes, "leave out some of them")?;
    }
    let seconds = count as f64 * SECONDS;
    if seconds > LONG {
        say::note(&format!("a mesh of {count} Gaussians takes about {seconds:.0} s on two cores"));
    }
    Ok(())
}

/// An output file of a mesh, with its companions.
pub struct Target {
    path: PathBuf,
    companions: Vec<PathBuf>,
    options: Options,
    /// Whether the mesh gets a skeleton; only a GLB can.
    is_skinned: bool,
}

impl Target {
    /// Refuses unknown kinds of meshes and unsuitable options.
    pub fn new(path: &Path, surface: &SurfaceArguments) -> Result<Self, Failure> {
        let wrong = |message: &str| Err(Failure::file(path, message));
        let Some(kind) = Kind::named(path) else {
            return wrong("is no .glb, .obj, .ply, .stl or .3mf; the extension says what to write");
        };
        let name = path.file_name().unwrap_or_default().to_str();
        if kind == Kind::Obj && name.is_none_or(|name| name.contains(char::is_control)) {
            return wrong("an OBJ names its materials' file, so its own name must be plain text (UTF-8)");
        }
        let defaults = options(kind);
        let texture = surface.texture.map_or(defaults.texture, |side| side as usize);
        if texture > 0 && !kind.has_texture() {
            return wrong("this kind has no texture: leave out --texture, or write a .glb or .obj");
        }
        let bytes = TEXEL * (texture as u64).pow(2);
        memory::check(&format!("--texture {texture}"), bytes, "choose a smaller one")?;
        let options = Options { faces: surface.faces.unwrap_or(defaults.faces), texture, ..defaults };
        Ok(Self {
            path: path.to_owned(),
            companions: export::companions(path, texture > 0),
            options,
            is_skinned: false,
        })
    }

    /// Gives the mesh a skeleton.
    pub fn skin(&mut self) -> Result<(), Failure> {
        self.is_skinned = Kind::named(&self.path) == Some(Kind::Glb);
        if self.is_skinned { Ok(()) } else { Err(Failure::file(&self.path, "only a .glb has a skeleton")) }
    }

    pub fn files(&self) -> Vec<&Path> {
        let companions = self.companions.iter().map(PathBuf::as_path);
        companions.chain([self.path.as_path()]).collect()
    }

    /// Refuses companions of a new mesh that are there already.
    pub fn check_companions(&self) -> Result<(), Failure> {
        let message = "would be replaced, but belongs to no mesh of this name: move it away";
        let other = self.companions.iter().find(|other| !self.path.exists() && other.exists());
        other.map_or(Ok(()), |other| Err(Failure::file(other, message)))
    }

    /// Makes the mesh of Gaussians.
    pub fn fuse(&self, scene: &Loaded, progress: &Progress) -> Result<Fused, Failure> {
        Ok(fuse(scene, self.options, &|name| progress.stage(name))?)
    }

    /// Makes the mesh of Gaussians and writes it. Errors contain `name`, the Gaussians' file.
    pub fn write(&self, scene: &Loaded, name: &Path) -> Result<Fused, Failure> {
        let progress = Progress::stages();
        let fused = self.fuse(scene, &progress).map_err(|e| e.about(name))?;
        if self.is_skinned {
            progress.stage("skeleton");
            let skin = rig::skeleton(scene, &fused.mesh, name)?.skin(&fused.mesh);
            let bytes = glb_bytes(&fused.mesh, Some(&skin)).map_err(|e| Failure::Internal(e.to_string()))?;
            output::write(&self.path, &bytes)?;
        } else {
            progress.stage("writing");
            export::write(&fused.mesh, &self.path)?;
        }
        drop(progress);
        self.warn(&fused, name);
        Ok(fused)
    }

    /// Warns of dropped pieces and of more triangles than wanted.
    fn warn(&self, fused: &Fused, name: &Path) {
        let name = name.display();
        if fused.largest_dropped >= COMPARABLE {
            let share = 100.0 * fused.largest_dropped;
            say::err(&format!(
                "warning: {name}: a separate piece with {share:.0} % of the body's volume was dropped; a mesh shows one body"
            ));
        }
        let (faces, wanted) = (fused.mesh.faces.len(), self.options.faces);
        if wanted > 0 && faces > wanted + wanted / 10 {
            say::err(&format!(
                "warning: {name}: {faces} triangles instead of {wanted}: fewer would tear thin parts off"
            ));
        }
    }
}

/// A description of the fusion.
pub fn describe(Fused { mesh, joined, dropped, faces, .. }: &Fused) -> String {
    format!(
        "parts joined with the body: {joined}, flying pieces dropped: {dropped}; {faces} triangles reduced to {}",
        mesh.faces.len()
    )
}
