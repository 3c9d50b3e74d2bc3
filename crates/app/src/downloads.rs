//! Files that the page offers: Gaussians, a mesh and an animation.

use std::sync::{Arc, Mutex, TryLockError};

use burn::tensor::Device;
use snapsnap_mesh::export::{self, Kind as MeshKind};
use snapsnap_mesh::fuse::fuse;
use snapsnap_people::poses::{MOTIONS, Motion};
use snapsnap_rig::{Rig, RigError};
use snapsnap_splat::scene::{Kind, Stored};

use crate::commands::mesh;
use crate::failure::Failure;
use crate::page::{self, Job, busy};
use crate::pictures::gif;
use crate::server::{Answer, Content, Request};
use crate::turntable;

/// A file of a scene.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Download {
    Gaussians(Kind),
    Mesh,
    /// A mesh with skeleton and motions.
    Rigged,
    Turntable,
}

/// Paths of the files behind `scene.`, which are also their extensions.
const FILES: [(&str, Download); 8] = [
    ("ply", Download::Gaussians(Kind::Ply)),
    ("y-down.ply", Download::Gaussians(Kind::YDown)),
    ("spz", Download::Gaussians(Kind::Spz)),
    ("sog", Download::Gaussians(Kind::Sog)),
    ("gaussians.glb", Download::Gaussians(Kind::Glb)),
    ("glb", Download::Mesh),
    ("rigged.glb", Download::Rigged),
    ("gif", Download::Turntable),
];

impl Download {
    /// The file that the page calls `name`, for example `scene.spz`, and its extension.
    pub fn named(name: &str) -> Option<(&'static str, Self)> {
        let extension = name.strip_prefix("scene.")?;
        FILES.iter().copied().find(|(path, _)| *path == extension)
    }

    /// Whether it takes all cores for many seconds.
    pub fn is_long(self) -> bool {
        matches!(self, Self::Mesh | Self::Rigged | Self::Turntable)
    }

    /// The file's bytes. `step` is called with the name of each step of a long one.
    pub fn make(self, stored: &Stored, step: &dyn Fn(&str)) -> Result<Vec<u8>, Failure> {
        match self {
            Self::Gaussians(kind) => Ok(stored.to_bytes(kind)?),
            Self::Mesh | Self::Rigged => {
                let scene = stored.load(&Device::flex());
                let mesh = fuse(&scene, mesh::options(MeshKind::Glb), step)?.mesh;
                let skin = (self == Self::Rigged).then(|| {
                    step("skeleton");
                    let rig = Rig::new(&scene, &mesh)?;
                    let mut skin = rig.skin(&mesh);
                    for name in MOTIONS {
                        skin.clips
                            .extend(Motion::named(name).map(|motion| rig.clip(name, &motion)).transpose()?);
                    }
                    Ok::<_, RigError>(skin)
                });
                let skin = skin.transpose()?;
                export::glb_bytes(&mesh, skin.as_ref()).map_err(|e| Failure::Internal(e.to_string()))
            }
            Self::Turntable => {
                let counted = |done, all| step(&format!("{done} of {all} pictures"));
                let pictures = turntable::all_around(&stored.load(&Device::flex()), &counted)?;
                step("animation");
                gif(&pictures, turntable::FRAMES_PER_SECOND)
            }
        }
    }
}

/// Locked while a mesh or an animation is made, which takes all cores.
static LONG: Mutex<()> = Mutex::new(());

/// The answer with a file of a scene, whose name gets the file's extension. `content` makes the file's bytes. It is
/// called with a function that tells the steps to the page.
pub fn answer(
    request: &Request,
    name: &str,
    (extension, download): (&str, Download),
    content: impl FnOnce(&dyn Fn(&str)) -> Result<Content, Answer>,
) -> Result<Answer, Answer> {
    let is_long = download.is_long();
    let content: Content = if is_long && request.method == "HEAD" {
        Arc::new("")
    } else {
        let only = is_long.then(|| LONG.try_lock());
        if matches!(only, Some(Err(TryLockError::WouldBlock))) {
            return Err(busy());
        }
        let job = Job::of(request);
        content(&|step| job.step(step))?
    };
    Ok(page::download(&format!("{name}.{extension}"), content))
}
