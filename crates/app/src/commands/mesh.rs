//! `snapsnap mesh`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use snapsnap_mesh::export::{self, Kind};
use snapsnap_mesh::fuse::{Fused, Options, fuse};
use snapsnap_splat::scene::{self, Loaded};

use super::check_outputs;
use crate::failure::Failure;
use crate::progress::Progress;
use crate::{device, memory, say};

/// Bytes per texel: position, normal, colour, and sums over views.
const TEXEL: u64 = 60;

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians, PLY or SPZ.
    input: PathBuf,
    /// Output file: .glb, .obj or .ply.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    surface: SurfaceArguments,
    /// Also make meshes that take far longer than a person's.
    #[arg(long)]
    force: bool,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Print the closed and dropped parts, and the time.
    #[arg(short, long)]
    verbose: bool,
}

/// Options of a surface.
#[derive(Args)]
pub struct SurfaceArguments {
    /// Approximate number of triangles of the mesh; 0 keeps all [default: 100000].
    #[arg(long, value_name = "N")]
    faces: Option<usize>,
    /// Side in pixels of a texture, which replaces the colours of vertices (not in a .ply).
    #[arg(long, value_name = "SIZE", value_parser = clap::value_parser!(u32).range(64..=16384))]
    texture: Option<u32>,
}

impl SurfaceArguments {
    /// `None`, unless an option is given that would have no effect.
    pub fn must_be_unused<T>(&self, why: &str) -> Result<Option<T>, Failure> {
        let given = [("--faces", self.faces.is_some()), ("--texture", self.texture.is_some())];
        match given.iter().find(|(_, given)| *given) {
            Some((name, _)) => Err(Failure::Input(format!("{name}: {why}"))),
            None => Ok(None),
        }
    }
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let since = Instant::now();
    let mut target = Target::new(&arguments.output, &arguments.surface)?;
    target.options.force = arguments.force;
    check_outputs(&target.files(), &[&arguments.input])?;
    let device = device::choose(&arguments.device)?;
    let loaded = scene::read(&arguments.input, &device)?;
    let fused = target.write(&loaded, &arguments.input)?;
    if arguments.verbose {
        say::out(&describe(&fused));
        say::out(&format!("{:.1} s", since.elapsed().as_secs_f64()));
    }
    let (file, faces) = (arguments.output.display(), fused.mesh.faces.len());
    say::info(&format!("{file}: {faces} triangles, {} positions", fused.mesh.positions.len()));
    Ok(())
}

/// An output file of a mesh, with its companions.
pub struct Target {
    path: PathBuf,
    companions: Vec<PathBuf>,
    options: Options,
}

impl Target {
    /// Refuses unknown kinds of meshes and unsuitable options.
    pub fn new(path: &Path, surface: &SurfaceArguments) -> Result<Self, Failure> {
        let Some(kind) = Kind::named(path) else {
            let message = "is neither .glb nor .obj nor .ply; the extension says what to write";
            return Err(Failure::file(path, message));
        };
        let name = path.file_name().unwrap_or_default().to_str();
        if kind == Kind::Obj && name.is_none_or(|name| name.contains(char::is_control)) {
            let message = "an OBJ names its materials' file, so its own name must be plain text (UTF-8)";
            return Err(Failure::file(path, message));
        }
        let texture = surface.texture.unwrap_or(0) as usize;
        if texture > 0 && kind == Kind::Ply {
            let message = "a PLY has no texture: leave out --texture, or write a .glb or .obj";
            return Err(Failure::file(path, message));
        }
        let bytes = TEXEL * (texture as u64).pow(2);
        memory::check(&format!("--texture {texture}"), bytes, "choose a smaller one")?;
        let options = Options {
            faces: surface.faces.unwrap_or(Options::default().faces),
            texture,
            ..Options::default()
        };
        Ok(Self { path: path.to_owned(), companions: export::companions(path, texture > 0), options })
    }

    /// All output files.
    pub fn files(&self) -> Vec<&Path> {
        let companions = self.companions.iter().map(PathBuf::as_path);
        companions.chain([self.path.as_path()]).collect()
    }

    /// Makes the mesh of Gaussians and writes it. Errors contain `name`, the Gaussians' file.
    pub fn write(&self, scene: &Loaded, name: &Path) -> Result<Fused, Failure> {
        let progress = Progress::stages();
        let fused = fuse(scene, self.options, &|name| progress.stage(name));
        let fused = fused.map_err(|e| Failure::from(e).about(name))?;
        progress.stage("writing");
        export::write(&fused.mesh, &self.path)?;
        Ok(fused)
    }
}

/// A description of the fusion.
pub fn describe(fused: &Fused) -> String {
    format!(
        "surface from a field of {:.1} mm: gaps between the shells closed: {}, hollows filled: {}, \
         parts joined with the body: {}, flying pieces dropped: {}; {} triangles reduced to {}",
        1e3 * fused.cell,
        fused.closed,
        fused.filled,
        fused.joined,
        fused.dropped,
        fused.faces,
        fused.mesh.faces.len()
    )
}
