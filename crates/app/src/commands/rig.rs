//! `snapsnap rig`.

use std::path::{Path, PathBuf};

use clap::Args;
use snapsnap_mesh::export::glb_bytes;
use snapsnap_mesh::import;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_people::Pose;
use snapsnap_people::poses::{self, Motion};
use snapsnap_rig::{Rig, pose_mesh};
use snapsnap_splat::scene::{Kind, Loaded, Stored};

use super::convert::read;
use super::mesh::{SurfaceArguments, Target};
use crate::failure::Failure;
use crate::output::{self, check_outputs};
use crate::progress::Progress;
use crate::{device, say};

/// Degrees by which arms are raised aside in the poses of game engines.
const STILL: [(&str, f32); 2] = [("t", 90.0), ("a", 45.0)];

#[derive(Args)]
pub struct Arguments {
    /// File of Gaussians of a person who stands upright and faces +z: PLY, SPZ, GLB or SOG.
    input: PathBuf,
    /// Output file: .glb, a mesh with skeleton and skin; or with --pose Gaussians: .ply, .spz or .sog.
    #[arg(short, long)]
    output: PathBuf,
    /// Another pose: t or a, as game engines expect it; a motion as of --motion, of which --frame is taken; or a character
    /// with the joint names of Mixamo or MakeHuman.
    #[arg(long, value_name = "t|a|MOTION|FILE.glb")]
    pose: Option<PathBuf>,
    /// Frame of the motion of --pose.
    #[arg(long, value_name = "N", default_value_t = 0)]
    frame: usize,
    /// Motion that goes into the GLB as an animation: idle, walk, wave or a file. May be repeated.
    #[arg(long, value_name = "NAME|FILE.bvh")]
    motion: Vec<PathBuf>,
    #[command(flatten)]
    surface: SurfaceArguments,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let Arguments { input, output, pose, motion, surface, .. } = arguments;
    let is_mesh = output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("glb"));
    let target = Target::new(if is_mesh { output } else { Path::new("mesh.ply") }, surface)?;
    if !is_mesh {
        if Kind::named(output).is_none() {
            return Err(Failure::file(
                output,
                "is no .glb, .ply, .spz or .sog; the extension says what to write",
            ));
        }
        if pose.is_none() || !motion.is_empty() {
            let message = "Gaussians have no skeleton: give a --pose and no --motion, or write a .glb";
            return Err(Failure::file(output, message));
        }
        surface.must_be_unused("only a .glb has a surface")?;
    }
    let inputs: Vec<&Path> = [input].into_iter().chain(pose).chain(motion).map(PathBuf::as_path).collect();
    check_outputs(&[output], &inputs)?;
    let pose = pose.as_deref().map(|pose| read_pose(pose, arguments.frame)).transpose()?;
    let motions = motion.iter().map(|path| match read_motion(path)? {
        Motion { ref poses, .. } if poses.is_empty() => Err(Failure::file(path, "has no frames")),
        Motion { step, .. } if step <= 0.0 => Err(Failure::file(path, "has no time between its frames")),
        motion => Ok((path, motion)),
    });
    let motions = motions.collect::<Result<Vec<_>, Failure>>()?;

    let scene = read(input)?.load(&device::choose(&arguments.device)?);
    let progress = Progress::stages();
    let mut mesh = target.fuse(&scene, &progress).map_err(|e| e.about(input))?.mesh;
    progress.stage("skeleton");
    let rig = skeleton(&scene, &mesh, input)?;
    let transforms = pose.as_ref().map(|pose| rig.transforms(pose)).transpose()?;
    progress.stage("writing");
    if let (false, Some(transforms)) = (is_mesh, &transforms) {
        let posed = rig.pose_gaussians(&scene.gaussians, transforms);
        Stored::of(&posed)?.write(Kind::of(output), output)?;
        drop(progress);
        say::info(&format!("{}: {} Gaussians", output.display(), posed.len()));
        return Ok(());
    }
    let mut skin = rig.skin(&mesh);
    for (path, motion) in &motions {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        skin.clips.push(rig.clip(&name, motion)?);
    }
    if let Some(transforms) = &transforms {
        pose_mesh(&mut mesh, &skin.weights, transforms);
        skin.joints.iter_mut().zip(transforms).for_each(|(joint, moved)| joint.rest = *moved * joint.rest);
    }
    let bytes = glb_bytes(&mesh, Some(&skin)).map_err(|e| Failure::Internal(e.to_string()))?;
    output::write(output, &bytes)?;
    drop(progress);
    let (joints, faces) = (skin.joints.len(), mesh.faces.len());
    say::info(&format!("{}: {joints} bones, {faces} triangles", output.display()));
    Ok(())
}

/// The skeleton of a person whose surface is `mesh`. Messages contain `name`, the Gaussians' file.
pub fn skeleton(scene: &Loaded, mesh: &Mesh, name: &Path) -> Result<Rig, Failure> {
    let rig = Rig::new(scene, mesh).map_err(|e| Failure::from(e).about(name))?;
    let unsure: Vec<&str> = rig.bones.iter().filter(|bone| !bone.is_sure).map(|bone| bone.short()).collect();
    if !unsure.is_empty() {
        let (name, unsure) = (name.display(), unsure.join(", "));
        say::err(&format!(
            "warning: {name}: joints that are not seen well move with the bone above: {unsure}"
        ));
    }
    Ok(rig)
}

/// The motion that `--motion` or `--pose` names.
fn read_motion(path: &Path) -> Result<Motion, Failure> {
    if let Some(own) = path.to_str().and_then(Motion::named) {
        return Ok(own);
    }
    if path.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("bvh")) {
        return Err(Failure::file(path, "is no .bvh, and no pose or motion of this name exists"));
    }
    Ok(poses::read(path)?)
}

/// The pose that `--pose` names.
fn read_pose(path: &Path, frame: usize) -> Result<Pose, Failure> {
    if let Some((_, arms)) = STILL.iter().find(|(name, _)| path.as_os_str() == *name) {
        return Ok(Pose::standing(*arms));
    }
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    if extension == "glb" {
        let rigged = import::read_rigged(path)?;
        return poses::of_bones(&rigged.bones).map_err(|e| Failure::file(path, e));
    }
    let mut motion = read_motion(path)?;
    let frames = motion.poses.len();
    if frame >= frames {
        return Err(Failure::file(
            path,
            format_args!("has {frames} frames, numbered from 0: no frame {frame}"),
        ));
    }
    Ok(motion.poses.swap_remove(frame))
}
