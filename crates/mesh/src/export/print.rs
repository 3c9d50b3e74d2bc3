//! Files for printers: binary STL, and 3MF (3mf.io, "Core Specification", version 1). Both have millimetres and z up.

use std::fmt::Write as _;
use std::io::{self, Cursor, Write};

use glam::Vec3;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

use crate::mesh::Mesh;

/// Millimetres in a metre.
const MILLIMETRES: f32 = 1000.0;

const CONTENT_TYPES: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types"><Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>
"#;
const RELATIONS: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships"><Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>
"#;

/// A position from metres with y up to millimetres with z up.
fn printed(position: Vec3) -> Vec3 {
    MILLIMETRES * Vec3::new(position.x, -position.z, position.y)
}

/// The corners of each triangle.
fn triangles(mesh: &Mesh) -> impl Iterator<Item = [Vec3; 3]> + '_ {
    mesh.faces.iter().map(|face| face.positions.map(|row| printed(mesh.positions[row as usize])))
}

/// Writes a binary STL.
pub(super) fn write_stl(mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
    // A header that begins with "solid" would announce text.
    out.write_all(&[0; 80])?;
    out.write_all(&u32::try_from(mesh.faces.len()).map_err(io::Error::other)?.to_le_bytes())?;
    for corners in triangles(mesh) {
        let [a, b, c] = corners;
        let normal = (b - a).cross(c - a).normalize_or_zero();
        for vector in [normal, a, b, c] {
            vector.to_array().iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
        }
        out.write_all(&[0; 2])?;
    }
    Ok(())
}

/// Writes a 3MF.
pub(super) fn write_3mf(mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
    let mut model = String::from(
        r#"<?xml version="1.0" encoding="UTF-8"?>
<model unit="millimeter" xml:lang="en-US" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources><object id="1" type="model"><mesh><vertices>
"#,
    );
    let fault = io::Error::other::<std::fmt::Error>;
    for position in &mesh.positions {
        let Vec3 { x, y, z } = printed(*position);
        writeln!(model, r#"<vertex x="{x:.4}" y="{y:.4}" z="{z:.4}"/>"#).map_err(fault)?;
    }
    model += "</vertices><triangles>\n";
    for face in &mesh.faces {
        let [a, b, c] = face.positions;
        writeln!(model, r#"<triangle v1="{a}" v2="{b}" v3="{c}"/>"#).map_err(fault)?;
    }
    model += "</triangles></mesh></object></resources><build><item objectid=\"1\"/></build></model>\n";
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    // A fixed time gives the same bytes on every run.
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .last_modified_time(DateTime::default());
    let files =
        [("[Content_Types].xml", CONTENT_TYPES), ("_rels/.rels", RELATIONS), ("3D/3dmodel.model", &model)];
    for (name, text) in files {
        archive.start_file(name, options)?;
        archive.write_all(text.as_bytes())?;
    }
    out.write_all(&archive.finish()?.into_inner())
}
