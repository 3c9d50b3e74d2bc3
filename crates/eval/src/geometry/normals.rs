//! Normals of depth maps, and the mean cosine between the normals of two maps.

use glam::DVec3;
use snapsnap_splat::Camera;

/// Largest difference of neighbouring depths on one surface, relative to the depth: a slope of 84° at the 2 m and 1024
/// pixels of the published cameras.
const JUMP: f32 = 0.01;

/// Unit normals `[H, W]` towards the camera, in the camera's axes, of a depth map `[H, W]` (metres along the optical
/// axis, 0 for no depth), from central differences of the points. `None` at the rims of surfaces and of the picture.
pub fn normals(depth: &[f32], camera: &Camera) -> Vec<Option<DVec3>> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let point = |x: usize, y: usize| {
        let z = f64::from(depth[y * width + x]);
        let ray = (glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - camera.principal_point) / camera.focal;
        z * DVec3::new(ray.x, ray.y, 1.0)
    };
    let normal = |x: usize, y: usize| {
        if x == 0 || y == 0 || x + 1 == width || y + 1 == height {
            return None;
        }
        let here = depth[y * width + x];
        let near = |x: usize, y: usize| {
            let there = depth[y * width + x];
            there > 0.0 && (there - here).abs() <= JUMP * here
        };
        if here <= 0.0 || !near(x - 1, y) || !near(x + 1, y) || !near(x, y - 1) || !near(x, y + 1) {
            return None;
        }
        let across = point(x + 1, y) - point(x - 1, y);
        let down = point(x, y + 1) - point(x, y - 1);
        // x right, y down: down × across points back to the camera.
        down.cross(across).try_normalize()
    };
    (0..width * height).map(|i| normal(i % width, i / width)).collect()
}

/// Mean cosine between the normals of two maps and the number of compared pixels, which have a normal in both maps;
/// `None` if there is no such pixel.
pub fn consistency(a: &[Option<DVec3>], b: &[Option<DVec3>]) -> Option<(f64, usize)> {
    let (mut sum, mut count) = (0.0, 0_usize);
    for (a, b) in a.iter().zip(b).filter_map(|(a, b)| a.zip(*b)) {
        sum += a.dot(b);
        count += 1;
    }
    (count > 0).then(|| (sum / count as f64, count))
}
