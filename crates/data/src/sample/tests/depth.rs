//! Points of the stored depth maps.

use super::*;
use crate::dataset::DepthMap;

/// The world points of a view.
fn world(folder: &Folder, view: usize, compat: bool) -> Vec<Vec3> {
    let stored = folder.person(TRAIN, "0000").depth(view).expect("reads");
    let camera = if compat { stored.camera } else { folder.exact_camera(&stored.camera) };
    let map = DepthMap { camera, ..stored };
    map.points(&RigidTransform::IDENTITY).flatten().map(|p| p.as_vec3()).collect()
}

/// Every point of every view of a plane lies on the plane.
#[test]
fn points_lie_on_the_surface_that_was_rendered() {
    let (mesh, normal) = rectangle();
    for (layout, bound) in [(Layout::Exact, 2e-6), (Layout::Authors, 1.5e-4)] {
        let (_temporary, folder) = data_set(&mesh, layout, 128, 8, false, 1);
        let mut worst = 0.0_f32;
        for view in [0, 1, 4, 7] {
            for p in world(&folder, view, false) {
                worst = worst.max((normal.dot(p) - 0.9).abs() / normal.length());
            }
        }
        println!("{layout:?}: {worst:e} m");
        assert!(worst < bound, "{layout:?}: {worst} m");
    }
}

/// In the published code, the points of the authors' layout are half a pixel off, to the right and down.
#[test]
fn published_points_are_half_a_pixel_off() {
    let (_temporary, folder) = data_set(&rectangle().0, Layout::Authors, 128, 8, false, 1);
    for view in [0, 2] {
        let camera = folder.person(TRAIN, "0000").camera(view).expect("reads");
        for (exact, published) in world(&folder, view, false).into_iter().zip(world(&folder, view, true)) {
            let shift = camera.world_to_camera.rotation * (published - exact).as_dvec3();
            let depth = camera.world_to_camera.apply(exact.as_dvec3()).z;
            let expected = (0.5 * depth / camera.focal).extend(0.0);
            assert!((shift - expected).length() < 1e-5, "view {view}: {shift} {expected}");
        }
    }
}
