//! Cameras of other programs: `cameras.json` of 3D Gaussian splatting (Kerbl et al., 2023) and `transforms.json` of
//! NeRF, Instant-NGP and Nerfstudio.

use glam::{DMat3, DVec2, DVec3};
use serde::Deserialize;
use serde_json::Value;

use crate::{Camera, RigidTransform};

/// Coefficients of lens distortion.
const DISTORTIONS: [&str; 6] = ["k1", "k2", "k3", "k4", "p1", "p2"];

/// The cameras in a text; `None` if it is of neither program.
pub(super) fn cameras(text: &str, size: Option<[u32; 2]>) -> Option<Result<Vec<Camera>, String>> {
    let root: Value = serde_json::from_str(text.trim_start_matches('\u{feff}')).ok()?;
    let (entries, is_splatting) = match &root {
        Value::Array(entries) if entries.first()?.get("position").is_some() => (entries, true),
        Value::Object(keys) => (keys.get("frames")?.as_array()?, false),
        _ => return None,
    };
    let one = |(index, entry)| {
        let camera = if is_splatting { of_splatting(entry) } else { of_radiance_field(&root, entry, size) };
        let camera = camera.and_then(|camera| camera.check().map(|()| camera));
        camera.map_err(|problem| format!("camera {index}: {problem}"))
    };
    Some(entries.iter().enumerate().map(one).collect())
}

/// `rotation` and `position` of a camera in the world, with OpenCV axes; pixels.
fn of_splatting(entry: &Value) -> Result<Camera, String> {
    let rows = <[[f64; 3]; 3]>::deserialize(&entry["rotation"]);
    let rows = rows.map_err(|_| "`rotation` is no list of 3 rows of 3 numbers")?;
    let position = <[f64; 3]>::deserialize(&entry["position"]);
    let position = position.map_err(|_| "`position` is no list of 3 numbers")?;
    let [width, height] = ["width", "height"].map(|name| side(&entry[name]));
    let [width, height] = [width.ok_or("`width` is missing")?, height.ok_or("`height` is missing")?];
    let [fx, fy] = ["fx", "fy"].map(|name| entry[name].as_f64());
    let focal = DVec2::new(fx.ok_or("`fx` is missing")?, fy.ok_or("`fy` is missing")?);
    let principal_point = DVec2::new(f64::from(width), f64::from(height)) / 2.0;
    let rotation = DMat3::from_cols_array_2d(&rows).transpose();
    let world_to_camera = RigidTransform { rotation, translation: position.into() }.inverse();
    Ok(Camera { width, height, focal, principal_point, world_to_camera })
}

/// `transform_matrix` of a camera in the world, with OpenGL axes. The lens is told once or by frame, in pixels or as an
/// angle of view.
fn of_radiance_field(root: &Value, frame: &Value, size: Option<[u32; 2]>) -> Result<Camera, String> {
    let number = |name: &str| frame[name].as_f64().or(root[name].as_f64());
    let model = frame["camera_model"].as_str().or(root["camera_model"].as_str()).unwrap_or("PINHOLE");
    let is_distorted = DISTORTIONS.iter().any(|name| number(name).is_some_and(|value| value != 0.0));
    if is_distorted || !["OPENCV", "PINHOLE", "SIMPLE_PINHOLE"].contains(&model) {
        return Err("its lens is distorted: undistort the pictures first".into());
    }
    let own = ["w", "h"].map(|name| side(&frame[name]).or(side(&root[name])));
    let [width, height] = match (own, size) {
        ([Some(width), Some(height)], _) => [width, height],
        (_, Some(size)) => size,
        _ => return Err("the pictures' size, `w` and `h`, is missing: give --size".into()),
    };
    let focal = |pixels: &str, angle: &str, side: u32| {
        number(pixels).or_else(|| Some(0.5 * f64::from(side) / (0.5 * number(angle)?).tan()))
    };
    let fx = focal("fl_x", "camera_angle_x", width).ok_or("`fl_x` and `camera_angle_x` are missing")?;
    let fy = focal("fl_y", "camera_angle_y", height).unwrap_or(fx);
    let middle = |name: &str, side: u32| number(name).unwrap_or(0.5 * f64::from(side));
    let matrix = <Vec<[f64; 4]>>::deserialize(&frame["transform_matrix"]).ok();
    let matrix = matrix.filter(|rows| rows.len() >= 3).ok_or("`transform_matrix` is no 4 × 4 matrix")?;
    let column = |i: usize| DVec3::new(matrix[0][i], matrix[1][i], matrix[2][i]);
    let rotation = DMat3::from_cols(column(0), -column(1), -column(2));
    Ok(Camera {
        width,
        height,
        focal: DVec2::new(fx, fy),
        principal_point: DVec2::new(middle("cx", width), middle("cy", height)),
        world_to_camera: RigidTransform { rotation, translation: column(3) }.inverse(),
    })
}

/// A whole number of pixels. Some programs write it as a fraction.
fn side(value: &Value) -> Option<u32> {
    value.as_f64().filter(|side| side.fract() == 0.0 && (0.0..1e9).contains(side)).map(|side| side as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All forms of one camera are the same camera.
    #[test]
    fn cameras_of_other_programs_are_read() {
        let camera = Camera::orbit_at_yaw_degrees(33.0, 640);
        let rotation = camera.world_to_camera.rotation.transpose();
        let (x, y, z, eye) = (rotation.col(0), rotation.col(1), rotation.col(2), camera.centre());
        let focal = camera.focal.x;
        let rows = [0, 1, 2].map(|i| [x[i], y[i], z[i]]);
        let turned = [0, 1, 2].map(|i| [x[i], -y[i], -z[i], eye[i]]);
        let angle = 2.0 * (320.0 / focal).atan();
        let [cx, cy] = camera.principal_point.to_array();
        let splatting = serde_json::json!([{ "id": 0, "img_name": "a", "width": 640, "height": 640,
            "position": eye.to_array(), "rotation": rows, "fx": focal, "fy": focal }]);
        let field = serde_json::json!({ "w": 640.0, "h": 640, "fl_x": focal, "cx": cx, "cy": cy, "k1": 0.0,
            "frames": [{ "transform_matrix": [turned[0], turned[1], turned[2], [0.0, 0.0, 0.0, 1.0]] }] });
        let bare = serde_json::json!({ "camera_angle_x": angle, "frames": field["frames"] });
        let point = DVec3::new(0.3, 1.1, -0.2);
        let (seen, depth) = camera.project(point).expect("in front");
        for (value, has_middle) in [(&splatting, false), (&field, true), (&bare, false)] {
            let read = cameras(&value.to_string(), Some([640; 2])).expect("known").expect("sound");
            let (found, far) = read[0].project(point).expect("in front");
            let offset = if has_middle { DVec2::ZERO } else { camera.principal_point - 320.0 };
            assert!((found + offset - seen).length() < 1e-9 && (far - depth).abs() < 1e-9, "{value}");
        }
        let wrong = |value: &Value| cameras(&value.to_string(), None).expect("known").expect_err("wrong");
        assert!(wrong(&bare).contains("camera 0: the pictures' size"), "{}", wrong(&bare));
        let mut distorted = field.clone();
        distorted["k2"] = 0.1.into();
        assert!(wrong(&distorted).contains("undistort"));
        assert!(cameras("[]", None).is_none() && cameras("[{}]", None).is_none());
    }
}
