//! `cameras.json`: a list of pinhole cameras; and the cameras of other programs.

mod foreign;

use std::io::Write;
use std::path::Path;

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use snapsnap_base::file::{self, write_whole};
use snapsnap_base::{FileError, quoted};

use crate::{Camera, RigidTransform};

/// Largest file that is read; a camera takes about 400 bytes.
const MAX_BYTES: u64 = 256 << 20;

/// One entry of the file. OpenCV axes (x right, y down, z forward), metres, pixels, pixel centres at +½.
#[derive(Debug, Serialize)]
struct Entry {
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    /// Row by row.
    world_to_camera: [[f64; 4]; 4],
}

const FIELDS: [&str; 7] = ["width", "height", "fx", "fy", "cx", "cy", "world_to_camera"];

/// The camera of an entry of the file.
fn camera(entry: &Value) -> Result<Camera, String> {
    let fields = entry.as_object().ok_or("is no object with `width`, `height`, `fx`, …")?;
    if let Some(unknown) = fields.keys().find(|key| !FIELDS.contains(&key.as_str())) {
        return Err(format!("unknown field `{}`, expected {}", quoted(unknown), FIELDS.join(", ")));
    }
    let field = |name: &str| fields.get(name).ok_or_else(|| format!("`{name}` is missing"));
    let number = |name: &str| field(name)?.as_f64().ok_or_else(|| format!("`{name}` is no number"));
    let side = |name: &str| {
        let side = field(name)?.as_u64().and_then(|side| side.try_into().ok());
        side.ok_or_else(|| format!("`{name}` is no whole number of pixels"))
    };
    let [a, b, c, d] = <[[f64; 4]; 4]>::deserialize(field("world_to_camera")?)
        .map_err(|_| "`world_to_camera` is no list of 4 rows of 4 numbers")?;
    let row = |r: [f64; 4]| DVec3::new(r[0], r[1], r[2]);
    let camera = Camera {
        width: side("width")?,
        height: side("height")?,
        focal: DVec2::new(number("fx")?, number("fy")?),
        principal_point: DVec2::new(number("cx")?, number("cy")?),
        world_to_camera: RigidTransform {
            rotation: DMat3::from_cols(row(a), row(b), row(c)).transpose(),
            translation: DVec3::new(a[3], b[3], c[3]),
        },
    };
    if d != [0.0, 0.0, 0.0, 1.0] {
        return Err(format!("the last row of `world_to_camera` is {d:?}, expected [0, 0, 0, 1]"));
    }
    camera.check()?;
    Ok(camera)
}

/// Reads the cameras of `path`.
///
/// # Errors
/// [`FileError`] if the file cannot be read, is no list of cameras, or has a camera that cannot be rendered into. The
/// error names the entry and the field.
pub fn read(path: &Path) -> Result<Vec<Camera>, FileError> {
    parse(path, &file::read_text(path, MAX_BYTES).map_err(FileError::read(path))?)
}

/// Reads the cameras of `path`, or the cameras that 3D Gaussian splatting (`cameras.json`) or programs for radiance
/// fields (`transforms.json`) have written there. Pictures without a size get `size`. The world is the file's.
///
/// # Errors
/// As [`read`], and for pictures without a size or with a distorted lens.
pub fn read_any(path: &Path, size: Option<[u32; 2]>) -> Result<Vec<Camera>, FileError> {
    let text = file::read_text(path, MAX_BYTES).map_err(FileError::read(path))?;
    match foreign::cameras(&text, size) {
        Some(Ok(cameras)) => Ok(cameras),
        Some(Err(problem)) => Err(FileError::unsuitable(path, problem)),
        None => parse(path, &text),
    }
}

/// The cameras in `text`, which is the content of `path`.
///
/// # Errors
/// As [`read`].
pub fn parse(path: &Path, text: &str) -> Result<Vec<Camera>, FileError> {
    let wrong = |problem: String| FileError::unsuitable(path, problem);
    // In two steps, so that an error can name the camera.
    let text = text.trim_start_matches('\u{feff}');
    let entries: Vec<Value> = serde_json::from_str(text).map_err(|e| wrong(quoted(&e.to_string())))?;
    if entries.is_empty() {
        return Err(wrong("the list is empty".into()));
    }
    let cameras = entries.iter().enumerate();
    cameras
        .map(|(index, entry)| camera(entry).map_err(|problem| wrong(format!("camera {index}: {problem}"))))
        .collect()
}

/// Writes `cameras` to `path`, whole or not at all.
///
/// # Errors
/// [`FileError::Write`].
pub fn write(cameras: &[Camera], path: &Path) -> Result<(), FileError> {
    let entry = |camera: &Camera| {
        let RigidTransform { rotation, translation } = camera.world_to_camera;
        let row = |i: usize| {
            let r = rotation.row(i);
            [r.x, r.y, r.z, translation[i]]
        };
        Entry {
            width: camera.width,
            height: camera.height,
            fx: camera.focal.x,
            fy: camera.focal.y,
            cx: camera.principal_point.x,
            cy: camera.principal_point.y,
            world_to_camera: [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        }
    };
    let entries: Vec<Entry> = cameras.iter().map(entry).collect();
    write_whole(path, |out| {
        serde_json::to_writer_pretty(&mut *out, &entries)?;
        writeln!(out)
    })
    .map_err(FileError::write(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_name_the_camera_and_the_field() {
        let good = r#"{"width":4,"height":4,"fx":1,"fy":1,"cx":2,"cy":2,
            "world_to_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#;
        let parse = |text: &str| parse(Path::new("cameras.json"), text);
        assert_eq!(parse(&format!("[{good}]")).expect("good").len(), 1);
        for (from, to, expected) in [
            (r#""width":4"#, r#""width":0"#, "camera 1: `width` is 0"),
            (r#""width":4"#, r#""width":-4"#, "camera 1: `width` is no whole number"),
            (r#""width":4,"#, "", "camera 1: `width` is missing"),
            (r#""fx":1"#, r#""fx":-1"#, "camera 1: `fx` is -1"),
            (r#""fx":1"#, r#""focal":1"#, "unknown field `focal`"),
            (r#""cx":2"#, r#""cx":1e300"#, "camera 1: `cx`"),
            ("[1,0,0,0]", "[2,0,0,0]", "not a rotation"),
            ("[0,0,0,1]", "[0,0,1,1]", "last row"),
            ("[1,0,0,0]", "[1,0,0]", "camera 1: `world_to_camera` is no list"),
            (r#""fx":1"#, r#""fx":"1""#, "camera 1: `fx` is no number"),
            ("[1,0,0,0]", "[1,0,0,1e99]", "translation"),
        ] {
            let bad = good.replace(from, to);
            let error = parse(&format!("[{good},{bad}]")).expect_err(to).to_string();
            assert!(error.contains("cameras.json") && error.contains(expected), "{to}: {error}");
        }
        assert!(parse("[]").expect_err("empty").to_string().contains("empty"));
        assert!(parse("{").expect_err("no JSON").to_string().contains("line 1"));
    }
}
