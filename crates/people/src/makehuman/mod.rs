//! People of MakeHuman's data: bodies mixed from morph targets, posed by skinning, and dressed. Clothes are layers cut
//! from the base mesh's helper surfaces, in colours of [`synth`](crate::synth), or meshes of the asset collection.
//!
//! The position on the resting body alone determines a colour, so that all layers at a position have the same colour.
//! Skin under cloth is pressed in, so that it does not come through.

mod assets;
mod files;
mod layers;
mod morph;
mod patch;
mod person;
mod proxy;
mod rig;
#[cfg(test)]
mod tests;

use glam::Vec3;
use snapsnap_base::FileError;
use snapsnap_mesh::import::Bone;
use snapsnap_mesh::mesh::{Face, Material, Mesh, bounds};

use crate::Detail;
use crate::figure::Pose;
use crate::poses::Poses;
use crate::synth::paint::Painter;
use crate::synth::surface::Surface;
use crate::synth::{atlas, stand};
pub use files::Library;
use person::{Person, Piece};

/// The person of this name: life-size in metres, standing on y = 0 and facing +z. Often in one of `poses`, or else in
/// one of the library's own poses.
///
/// # Errors
/// [`FileError`] naming a file that is missing or damaged.
pub fn person(
    library: &Library,
    name: &str,
    poses: Option<&Poses>,
    detail: Detail,
) -> Result<Mesh, FileError> {
    Ok(rigged(library, name, poses, None, detail)?.0)
}

/// The person of [`person()`], perhaps in another pose, with the bones of MakeHuman's default rig.
///
/// # Errors
/// As [`person()`].
pub fn rigged(
    library: &Library,
    name: &str,
    poses: Option<&Poses>,
    pose: Option<&Pose>,
    detail: Detail,
) -> Result<(Mesh, Vec<Bone>), FileError> {
    let person = Person::of(library, name, poses, pose, detail)?;
    let mut mesh = person.mesh();
    let floor = mesh.bounds().0.y * Vec3::Y;
    let bones = library.bones.iter().zip(&person.placed).map(|(bone, placed)| Bone {
        name: bone.name.clone(),
        parent: bone.parent,
        place: placed.head - floor,
    });
    stand(&mut mesh);
    Ok((mesh, bones.collect()))
}

impl Person<'_> {
    fn mesh(&self) -> Mesh {
        let skin = self.skin();
        let hair = self.hair(&skin).filter(|_| self.worn.hair.is_none());
        let mut garments = Vec::new();
        if self.worn.suit.is_none() {
            garments.extend(self.layers());
        }
        if self.worn.shoes.is_none() {
            garments.push(self.shoes());
        }
        let skirt = |row: usize| {
            // The tail of a coat hangs over the top, a skirt under it.
            let is_tail = self.body.parts[row].side == 1;
            self.skirt(row, &[&skin, &garments[0], &garments[1]][..if is_tail { 3 } else { 2 }])
        };
        let skirts: Vec<Piece> = self.drapes().map(skirt).collect();
        let mut pieces = vec![self.pressed_skin(skin, &garments)];
        pieces.extend(hair.into_iter().chain(garments).chain(skirts));

        let mut surface = Surface { positions: Vec::new(), faces: Vec::new(), parts: Vec::new() };
        let mut positions = Vec::new();
        for Piece { patch, parts } in &pieces {
            let first = positions.len() as u32;
            positions.extend(patch.vertices.iter().map(|vertex| vertex.posed));
            surface.positions.extend(patch.vertices.iter().map(|vertex| vertex.rest));
            surface.parts.extend(parts);
            surface.faces.extend(patch.triangles().map(|face| face.map(|row| row + first)));
        }
        let bare = [self.worn.suit.is_some(), self.worn.shoes.is_some()];
        let painter = Painter::new(&self.figure, &self.outfit, &self.face, bare);
        let mut mesh = atlas::paint(&self.body, &surface, &painter, self.detail);
        mesh.positions = positions;
        self.add_worn(&mut mesh);
        self.add_eyes(&mut mesh);
        mesh
    }

    fn add_eyes(&self, mesh: &mut Mesh) {
        mesh.colors = vec![Vec3::ONE; mesh.positions.len()];
        mesh.materials.push(Material::default());
        let material = mesh.materials.len() as u32 - 1;
        for name in ["helper-l-eye", "helper-r-eye"] {
            let patch = self.group(name).subdivided(self.detail.steps(2));
            let first = mesh.positions.len() as u32;
            let (low, high) = bounds(patch.vertices.iter().map(|vertex| vertex.rest));
            let centre = (low + high) / 2.0;
            for vertex in &patch.vertices {
                mesh.positions.push(vertex.posed);
                let way = (vertex.rest - centre).normalize_or_zero().z;
                mesh.colors.push(match way {
                    w if w > 0.975 => Vec3::splat(0.03),
                    w if w > 0.88 => self.outfit.eyes,
                    _ => Vec3::splat(0.88),
                });
            }
            for face in patch.triangles() {
                let positions = face.map(|row| row + first);
                mesh.faces.push(Face { positions, texcoords: None, material });
            }
        }
    }
}
