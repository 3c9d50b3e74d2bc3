//! Materials, textures and extensions of binary glTF.

use std::sync::Arc;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use glam::{Vec2, Vec3};
use gltf::image::Source;
use gltf::json::Root;
use gltf::material::AlphaMode;
use gltf::texture::Info;
use gltf::{Document, Primitive};
use image::{DynamicImage, GrayImage, Luma};
use snapsnap_base::{FileError, quoted};

use super::glb::File;
use crate::mesh::Material;
use crate::picture::decode_bytes;

/// Extensions that may be required: they are read, or change only what a scan does not need.
const READ: [&str; 14] = [
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "EXT_texture_webp",
    "KHR_materials_unlit",
    "KHR_materials_specular",
    "KHR_materials_ior",
    "KHR_materials_clearcoat",
    "KHR_materials_sheen",
    "KHR_materials_transmission",
    "KHR_materials_volume",
    "KHR_materials_emissive_strength",
    "KHR_materials_variants",
    "KHR_lights_punctual",
];
/// Extensions that replace data, and what a user can do.
const PACKED: [(&str, &str); 4] = [
    ("KHR_draco_mesh_compression", "export the file without compression"),
    ("EXT_meshopt_compression", "export the file without compression"),
    ("KHR_meshopt_compression", "export the file without compression"),
    ("KHR_texture_basisu", "export its textures as PNG, JPEG or WebP"),
];
/// Least opacity of the surface of a material that blends.
const OPAQUE: f32 = 0.5;

/// Refuses extensions without which a file cannot be read, and marks the others as not required.
pub fn check_extensions(root: &mut Root) -> Result<(), String> {
    // A merely used compression may come with other data.
    let lacks = root.accessors.iter().any(|a| a.buffer_view.is_none() && a.sparse.is_none())
        || root.buffer_views.iter().any(|view| view.buffer.value() != 0)
        || root.images.iter().any(|image| image.buffer_view.is_none() && image.uri.is_none());
    for (name, remedy) in PACKED {
        let is_in = |names: &[String]| names.iter().any(|other| other == name);
        if is_in(&root.extensions_required) || lacks && is_in(&root.extensions_used) {
            return Err(format!("its data has the form {name}, which is not read: {remedy}"));
        }
    }
    root.extensions_required.retain(|name| !READ.contains(&name.as_str()));
    let unknown = root.extensions_required.first();
    unknown.map_or(Ok(()), |name| Err(format!("requires the extension {}, which is not read", quoted(name))))
}

/// The bytes of a data URI.
pub fn of_uri(uri: &str) -> Result<Vec<u8>, String> {
    match uri.strip_prefix("data:").and_then(|data| data.split_once(";base64,")) {
        Some((_, text)) => BASE64_STANDARD.decode(text).map_err(|e| format!("is no Base64: {e}")),
        None => Err(format!("is another file, {}: put it into the GLB", quoted(uri))),
    }
}

/// Linear colour with opacity, and texture, of a material's diffuse light.
pub fn base<'a>(material: &gltf::Material<'a>) -> ([f32; 4], Option<Info<'a>>) {
    if let Some(diffuse) = material.pbr_specular_glossiness() {
        return (diffuse.diffuse_factor(), diffuse.diffuse_texture());
    }
    let base = material.pbr_metallic_roughness();
    match (base.base_color_factor(), material.emissive_texture()) {
        // Scans with baked light are black surfaces that shine.
        ([0.0, 0.0, 0.0, opacity], Some(texture)) => ([1.0, 1.0, 1.0, opacity], Some(texture)),
        (factor, _) => (factor, base.base_color_texture()),
    }
}

/// Least opacity of a material's surface.
fn least_opacity(material: &gltf::Material) -> f32 {
    match material.alpha_mode() {
        AlphaMode::Opaque => 0.0,
        AlphaMode::Mask => material.alpha_cutoff().unwrap_or(OPAQUE),
        AlphaMode::Blend => OPAQUE,
    }
}

pub fn is_invisible(material: &gltf::Material) -> bool {
    let ([.., opacity], texture) = base(material);
    texture.is_none() && opacity < least_opacity(material)
}

/// Index of the set of texture coordinates that the primitive's texture uses.
pub fn texture_set(primitive: &Primitive) -> u32 {
    let set = |texture: Info| {
        texture.texture_transform().and_then(|t| t.tex_coord()).unwrap_or(texture.tex_coord())
    };
    base(&primitive.material()).1.map_or(0, set)
}

/// Texture coordinates after `KHR_texture_transform`: scaled, turned about the texture's upper left corner, moved.
pub fn transformed(texture: &Info, at: Vec2) -> Vec2 {
    let Some(transform) = texture.texture_transform() else { return at };
    let at = Vec2::from(transform.scale()) * at;
    let (sin, cos) = transform.rotation().sin_cos();
    Vec2::new(cos * at.x + sin * at.y, cos * at.y - sin * at.x) + Vec2::from(transform.offset())
}

/// sRGB value of linear light.
pub fn shown(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

impl File<'_> {
    pub(super) fn material(
        &mut self,
        material: &gltf::Material,
        document: &Document,
    ) -> Result<Material, FileError> {
        let ([r, g, b, opacity], info) = base(material);
        // Factors are linear in glTF, colours of a mesh are sRGB.
        let color = Vec3::new(r, g, b).clamp(Vec3::ZERO, Vec3::ONE).map(shown);
        let least = least_opacity(material);
        let mut made = Material { color, ..Material::default() };
        if let Some(info) = info {
            let texture = info.texture();
            let webp = texture.extension_value("EXT_texture_webp").and_then(|webp| webp["source"].as_u64());
            let image = match webp {
                Some(row) => document.images().nth(row as usize),
                None => texture.source(),
            };
            let missing =
                || self.wrong(format!("texture {} has no picture that can be read", texture.index()));
            let image = image.ok_or_else(missing)?;
            let bytes = self.picture(&image)?;
            let decode = |most| decode_bytes(self.path, &bytes, most);
            if least > 0.0 {
                made.opacity = cut_out(&decode(super::MAX_TEXTURE)?, opacity, least);
            }
            made.texture = Some(self.textures.load(image.index(), decode)?);
        }
        Ok(made)
    }

    fn picture(&self, image: &gltf::Image) -> Result<Vec<u8>, FileError> {
        let number = image.index();
        match image.source() {
            Source::Uri { uri, .. } => of_uri(uri).map_err(|e| self.wrong(format!("picture {number} {e}"))),
            Source::View { view, .. } => {
                let end = view.offset().checked_add(view.length()).filter(|_| view.buffer().index() == 0);
                let bytes = end.and_then(|end| self.blob.get(view.offset()..end));
                Ok(bytes.ok_or_else(|| self.wrong(format!("picture {number} is cut off")))?.to_vec())
            }
        }
    }
}

/// 0 where the alpha of a texture times `factor` is below `least`; `None` if it is nowhere.
pub fn cut_out(texture: &DynamicImage, factor: f32, least: f32) -> Option<Arc<GrayImage>> {
    let texture = texture.to_rgba8();
    let is_solid = |alpha: u8| f32::from(alpha) / 255.0 * factor >= least;
    let solid = |x, y| Luma([if is_solid(texture.get_pixel(x, y)[3]) { u8::MAX } else { 0 }]);
    let holes = texture.pixels().any(|pixel| !is_solid(pixel[3]));
    holes.then(|| Arc::new(GrayImage::from_fn(texture.width(), texture.height(), solid)))
}
