use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};
use image::{Rgb, RgbImage};
use snapsnap_splat::{Camera, RigidTransform};

use super::{Renderer, View, ViewOptions};
use crate::mesh::{Face, Material, Mesh};
use crate::view::{Lamp, Light, Lights, Surroundings};

/// A camera at the origin that looks along +z.
fn camera(width: u32, height: u32) -> Camera {
    Camera {
        width,
        height,
        focal: DVec2::new(100.0, 110.0),
        principal_point: DVec2::new(0.47 * f64::from(width), 0.55 * f64::from(height)),
        world_to_camera: RigidTransform { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
    }
}

fn draw(mesh: &Mesh, camera: &Camera, options: &ViewOptions) -> View {
    Renderer::new(mesh).expect("a sound mesh").draw(camera, options)
}

/// Light of strength 1 from everywhere.
fn flat(samples: usize) -> ViewOptions {
    ViewOptions { samples, light: Light::Plain(Lights::new(&[], 1.0)), second: false }
}

fn mesh(positions: Vec<Vec3>, faces: &[[u32; 3]]) -> Mesh {
    Mesh::colored(positions, Vec::new(), faces.to_vec())
}

/// Two triangles in each of `n`² cells between the rows of (n + 1)² points.
fn cells(n: u32) -> Vec<[u32; 3]> {
    let firsts = (0..n).flat_map(|row| (0..n).map(move |column| row * (n + 1) + column));
    firsts.flat_map(|a| [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]).collect()
}

/// The mesh `one` with the faces of `other`, both of one material.
fn joined(mut one: Mesh, other: &Mesh) -> Mesh {
    let first = one.positions.len() as u32;
    one.positions.extend(&other.positions);
    one.faces.extend(other.faces.iter().map(|f| Face { positions: f.positions.map(|r| r + first), ..*f }));
    one
}

/// A sphere from an octahedron, every edge halved `levels` times.
fn sphere(centre: Vec3, radius: f32, levels: usize) -> Mesh {
    let mut triangles: Vec<[Vec3; 3]> = Vec::new();
    for (x, y, z) in [(1., 1., 1.), (-1., 1., 1.), (-1., -1., 1.), (1., -1., 1.)] {
        for z in [z, -z] {
            let corner = [Vec3::X * x, Vec3::Y * y, Vec3::Z * z];
            triangles.push(if x * y * z > 0.0 { corner } else { [corner[1], corner[0], corner[2]] });
        }
    }
    for _ in 0..levels {
        let split = |[a, b, c]: [Vec3; 3]| {
            let [ab, bc, ca] = [a + b, b + c, c + a].map(Vec3::normalize);
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        triangles = triangles.into_iter().flat_map(split).collect();
    }
    let positions: Vec<Vec3> = triangles.iter().flatten().map(|p| centre + radius * *p).collect();
    let faces: Vec<[u32; 3]> = (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    mesh(positions, &faces)
}

/// Ray through a pixel's centre with z = 1.
fn ray(camera: &Camera, pixel: usize) -> DVec3 {
    let (x, y) = (pixel % camera.width as usize, pixel / camera.width as usize);
    let at = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
    ((at - camera.principal_point) / camera.focal).extend(1.0)
}

#[test]
fn the_depth_and_outline_of_a_sphere_are_those_of_the_formula() {
    let camera = camera(96, 96);
    let (centre, radius) = (DVec3::new(0.05, -0.1, 2.0), 0.5);
    let view = draw(&sphere(centre.as_vec3(), radius as f32, 9), &camera, &flat(3));
    let hit = |d: DVec3, radius: f64| {
        let (b, c) = (d.dot(centre), centre.length_squared() - radius * radius);
        let square = b * b - d.length_squared() * c;
        (square > 0.0).then(|| (b - square.sqrt()) / d.length_squared())
    };
    let mut checked = 0;
    for (pixel, alpha) in view.alpha.iter().enumerate() {
        let (d, depth) = (ray(&camera, pixel), view.depth[pixel]);
        // Not at the outline, where depth changes by metres per pixel.
        if let Some(exact) = hit(d, 0.95 * radius).and_then(|_| hit(d, radius)) {
            assert!((f64::from(depth) - exact).abs() < 1e-5, "pixel {pixel}: {depth} m, not {exact} m");
            checked += 1;
        }
        // A pixel and a half inside and outside of the outline.
        if hit(d, 0.97 * radius).is_some() {
            assert_eq!(*alpha, 1.0, "pixel {pixel}");
        }
        if hit(d, 1.03 * radius).is_none() {
            assert_eq!((*alpha, depth), (0.0, 0.0), "pixel {pixel}");
        }
    }
    assert!(checked > 500, "{checked}");
}

/// The coverage of a rectangle with known edges is the share of the pixel's samples that lie within.
#[test]
fn coverage_counts_the_samples_between_the_edges() {
    let camera = camera(40, 30);
    let point = |u: f64, v: f64| {
        let p = (DVec2::new(u, v) - camera.principal_point) / camera.focal * 2.0;
        p.extend(2.0).as_vec3()
    };
    for samples in 1..=6 {
        let rectangles = [(5.3, 30.8, 4.6, 22.1), (7.0, 29.0, 6.0, 20.0), (9.5, 9.9, 3.2, 27.7)];
        for (left, right, top, bottom) in rectangles {
            let corners =
                vec![point(left, top), point(right, top), point(right, bottom), point(left, bottom)];
            let view = draw(&mesh(corners, &[[0, 1, 2], [0, 2, 3]]), &camera, &flat(samples));
            for (pixel, alpha) in view.alpha.iter().enumerate() {
                let (x, y) = ((pixel % 40) as f64, (pixel / 40) as f64);
                let n = samples as f64;
                let counted = |low: f64, high: f64, at: f64| {
                    (0..samples).filter(|i| (low..high).contains(&(at + (*i as f64 + 0.5) / n))).count()
                        as f64
                        / n
                };
                let expected = counted(left, right, x) * counted(top, bottom, y);
                assert!((f64::from(*alpha) - expected).abs() < 1e-5, "{samples}: pixel {x}, {y}: {alpha}");
                if expected == 1.0 || expected == 0.0 {
                    assert_eq!(f64::from(*alpha), expected, "{samples}: pixel {x}, {y}");
                }
            }
        }
    }
}

/// Triangles between shifted points of a grid: no sample is missed, and none belongs to two triangles.
#[test]
fn neighbouring_triangles_share_no_sample_and_leave_none_out() {
    let camera = camera(50, 40);
    let mut state = 1_u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    let n = 24_u32;
    let mut positions = Vec::new();
    for y in 0..=n {
        for x in 0..=n {
            let inner = |i: u32, shift: f32| if i == 0 || i == n { 0.0 } else { shift };
            let (dx, dy) = (inner(x, random() - 0.5), inner(y, random() - 0.5));
            let z = 2.0 + 0.3 * random();
            let at = Vec2::new(x as f32 + 0.7 * dx, y as f32 + 0.7 * dy) / n as f32 - 0.5;
            positions.push(at.extend(1.0) * z);
        }
    }
    let faces = cells(n);
    let whole = draw(&mesh(positions.clone(), &faces), &camera, &flat(3));
    let mut sum = vec![0.0; whole.alpha.len()];
    for part in 0..5 {
        let some: Vec<[u32; 3]> = faces.iter().skip(part).step_by(5).copied().collect();
        let view = draw(&mesh(positions.clone(), &some), &camera, &flat(3));
        sum.iter_mut().zip(&view.alpha).for_each(|(s, a)| *s += a);
    }
    for (pixel, (sum, whole)) in sum.iter().zip(&whole.alpha).enumerate() {
        assert!((sum - whole).abs() < 1e-6, "pixel {pixel}: {sum} and {whole}");
    }
    // The grid is larger than the image: there is no hole.
    assert!(whole.alpha.iter().all(|alpha| *alpha == 1.0));
}

/// A view of a corner of a cube with a picture on every side: each pixel shows the point that it sees.
#[test]
fn a_textured_cube_shows_its_picture_undistorted() {
    let mut positions = Vec::new();
    let mut texcoords = Vec::new();
    let mut faces = Vec::new();
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let first = positions.len() as u32;
            for (s, t) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                let mut p = [s * sign, t, 0.0];
                p.rotate_right(axis);
                p[(axis + 2) % 3] = sign;
                positions.push(0.4 * Vec3::from_array(p));
                texcoords.push(Vec2::new(0.5 + 0.5 * s, 0.5 + 0.5 * t));
            }
            for rows in [[first, first + 1, first + 2], [first, first + 2, first + 3]] {
                faces.push(Face { positions: rows, texcoords: Some(rows), material: 0 });
            }
        }
    }
    // Smooth: red grows to the right, green upwards.
    let texture = RgbImage::from_fn(256, 256, |x, y| Rgb([x as u8, 255 - y as u8, 128]));
    let material = Material { texture: Some(Arc::new(texture)), ..Material::default() };
    let cube = Mesh { positions, texcoords, faces, materials: vec![material], ..Mesh::default() };
    let mut camera = camera(120, 120);
    let rotation = DMat3::from_rotation_x(0.6) * DMat3::from_rotation_y(0.7);
    camera.world_to_camera = RigidTransform { rotation, translation: DVec3::new(0.0, 0.0, 2.0) };
    let view = draw(&cube, &camera, &flat(3));
    let eye = camera.centre();
    let mut seen = [0; 6];
    for (pixel, depth) in view.depth.iter().enumerate() {
        let ray = rotation.transpose() * ray(&camera, pixel);
        // The ray enters the cube at the last pair of sides and leaves it at the first.
        let (near, far) = ((-0.4 - eye) / ray, (0.4 - eye) / ray);
        let (enter, leave) = (near.min(far), near.max(far));
        let z = enter.max_element();
        if z >= leave.min_element() {
            assert_eq!(*depth, 0.0, "pixel {pixel}");
            continue;
        }
        assert!((f64::from(*depth) - z).abs() < 1e-5, "pixel {pixel}: {depth} m, not {z} m");
        let axis = enter.to_array().iter().position(|t| *t == z).expect("one of them");
        let sign = -ray[axis].signum();
        let p = (eye + z * ray) / 0.4;
        // The same axes as for the corners' texture coordinates.
        let side = (axis + 1) % 3;
        let (s, t) = (p[side] * sign, p[(side + 1) % 3]);
        if s.abs().max(t.abs()) < 0.9 {
            let [red, green, blue] = view.color[pixel].map(f64::from);
            assert!((red - (0.5 + 0.5 * s)).abs() < 0.01, "pixel {pixel}: {red} at {s}");
            assert!((green - (0.5 + 0.5 * t)).abs() < 0.01, "pixel {pixel}: {green} at {t}");
            assert!((blue - 128.0 / 255.0).abs() < 0.004);
            seen[2 * axis + usize::from(sign > 0.0)] += 1;
        }
    }
    assert_eq!(seen.iter().filter(|count| **count > 100).count(), 3, "three sides are visible: {seen:?}");
}

/// A fine checkerboard far away is grey, not noise.
#[test]
fn distant_textures_are_averaged() {
    let texture = RgbImage::from_fn(512, 512, |x, y| Rgb([if (x + y) % 2 == 0 { 0 } else { 255 }; 3]));
    let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    let rows = [[0, 1, 2], [0, 2, 3]];
    let plane = Mesh {
        positions: corners.map(|(x, y)| Vec3::new(x, y, 4.0)).to_vec(),
        texcoords: corners.map(|(x, y)| Vec2::new(0.5 + 0.5 * x, 0.5 - 0.5 * y)).to_vec(),
        faces: rows.map(|rows| Face { positions: rows, texcoords: Some(rows), material: 0 }).to_vec(),
        materials: vec![Material { texture: Some(Arc::new(texture)), ..Material::default() }],
        ..Mesh::default()
    };
    let view = draw(&plane, &camera(40, 40), &flat(1));
    for color in view.color.iter().zip(&view.alpha).filter(|(_, a)| **a == 1.0).map(|(c, _)| c) {
        assert!((color[0] - 0.5).abs() < 0.02, "{color:?}");
    }
}

#[test]
fn light_is_never_clipped_and_the_nearer_surface_is_visible_from_both_sides() {
    let ball = draw(&sphere(Vec3::new(0.0, 0.0, 2.0), 0.5, 4), &camera(64, 64), &ViewOptions::default());
    let inside = || ball.color.iter().zip(&ball.alpha).filter(|(_, a)| **a == 1.0).map(|(c, _)| c[0]);
    let (low, high) = (inside().fold(1.0, f32::min), inside().fold(0.0, f32::max));
    assert!(low > 0.2 && high > low + 0.1, "{low} {high}");
    // Clipped light would make whole patches equally bright.
    let brightest = inside().filter(|c| *c > 0.9999).count();
    assert!(brightest * 100 < inside().count(), "{brightest} of {} pixels", inside().count());
    assert!(Lights::default().strength(Vec3::new(0.4, 0.8, 0.9).normalize()) > 0.9);

    let triangle = |z: f32| {
        mesh(vec![Vec3::new(-1.0, -1.0, z), Vec3::new(1.0, -1.0, z), Vec3::new(0.0, 1.0, z)], &[[0, 1, 2]])
    };
    let mut both = triangle(2.0);
    both.positions.extend(triangle(3.0).positions);
    both.faces.push(Face { positions: [3, 5, 4], texcoords: None, material: 1 });
    both.materials.push(Material { color: Vec3::X, ..Material::default() });
    let view = draw(&both, &camera(32, 32), &flat(2));
    let middle = 17 * 32 + 15;
    assert_eq!((view.color[middle], view.depth[middle]), ([1.0; 3], 2.0));
    both.faces.swap(0, 1);
    assert_eq!(draw(&both, &camera(32, 32), &flat(2)).color, view.color, "in either order");
    // A triangle behind the camera is invisible.
    let nothing = draw(&triangle(-2.0), &camera(32, 32), &flat(2));
    assert!(nothing.alpha.iter().all(|a| *a == 0.0) && nothing.depth.iter().all(|d| *d == 0.0));
}

#[test]
fn a_ball_shades_the_floor_on_the_side_away_from_the_lamp() {
    // A floor of 2 m under a ball of radius 0.3 m, whose middle is 0.6 m above it.
    let at = |i: u32| i as f32 / 40.0 - 1.0;
    let floor = (0..=80).flat_map(|x| (0..=80).map(move |z| Vec3::new(at(x), 0.0, at(z)))).collect();
    let mesh = joined(mesh(floor, &cells(80)), &sphere(Vec3::new(0.0, 0.6, 0.0), 0.3, 4));
    let renderer = Renderer::new(&mesh).expect("a mesh");
    let lamp = Lamp { direction: Vec3::new(-1.0, 1.0, 0.0), color: Vec3::ONE, radius: 0.2 };
    let surroundings = Surroundings::new(vec![lamp], [Vec3::ONE; 2], 6.0);
    let light = renderer.occlusion().light(&surroundings, &renderer.normals);
    let near = |x: f32, z: f32| {
        let places = mesh.positions.iter().zip(&light);
        let found = places.filter(|(p, _)| p.y == 0.0 && (p.x - x).abs() < 0.02 && (p.z - z).abs() < 0.02);
        let found: Vec<f32> = found.map(|(_, light)| light[0].x.powf(1.0 / 2.2)).collect();
        found.iter().sum::<f32>() / found.len() as f32
    };
    // The ball is 0.6 m above the floor, and the lamp's light falls at 45° towards +x.
    let (shadow, mirrored, open) = (near(0.6, 0.0), near(-0.6, 0.0), near(0.6, 0.85));
    assert!(shadow < 0.75 * mirrored && shadow < 0.75 * open, "{shadow} {mirrored} {open}");
    assert!((mirrored - open).abs() < 0.05, "{mirrored} {open}");
    // Turned by half a turn, the shadow falls to the other side.
    let turned = renderer.occlusion().light(&surroundings.turned(180.0), &renderer.normals);
    let row = mesh.positions.iter().position(|p| (*p - Vec3::new(-0.6, 0.0, 0.0)).length() < 0.02);
    assert!(turned[row.expect("a vertex")][0].x.powf(1.0 / 2.2) < 0.75 * mirrored);
}

/// Nothing occludes the directions in front of a convex surface.
#[test]
fn a_ball_alone_has_the_light_of_its_normals_with_the_given_contrast() {
    let mesh = sphere(Vec3::new(0.0, 1.0, 0.0), 0.9, 5);
    let renderer = Renderer::new(&mesh).expect("a mesh");
    for contrast in [1.2_f32, 3.0, 6.0] {
        let lamp = Lamp { direction: Vec3::new(0.3, 0.6, 1.0), color: Vec3::ONE, radius: 0.4 };
        let surroundings = Surroundings::new(vec![lamp], [Vec3::ONE; 2], contrast);
        let light = renderer.occlusion().light(&surroundings, &renderer.normals);
        let linear = |light: &[Vec3; 2]| light[0].x;
        let (low, high) = light.iter().map(linear).fold((9.0_f32, 0.0_f32), |(l, h), v| (l.min(v), h.max(v)));
        assert!((high - 1.0).abs() < 0.03, "{contrast}: {high}");
        assert!((high / low / contrast - 1.0).abs() < 0.08, "{contrast}: {low} {high}");
        // No channel of coloured light is clipped either.
        let red = Lamp { color: Vec3::new(1.2, 1.0, 0.8), ..lamp };
        let surroundings = Surroundings::new(vec![red], [Vec3::ONE; 2], contrast);
        let colored = renderer.occlusion().light(&surroundings, &renderer.normals);
        let most = colored.iter().fold(Vec3::ZERO, |most, light| most.max(light[0]));
        assert!((most.x - 1.0).abs() < 0.03 && most.y < most.x && most.z < most.y, "{contrast}: {most}");
        // Inside of a closed surface it is dark.
        assert!(light.iter().all(|light| light[1].x < 0.1), "{contrast}");
    }
}

/// Two balls one behind the other: the second surface is the front of the farther one, where the nearer hides it.
#[test]
fn the_second_surface_is_the_next_that_faces_the_camera_behind_the_first_body() {
    let (near, far) = (sphere(Vec3::new(0.0, 0.0, 2.0), 0.2, 4), sphere(Vec3::new(0.05, 0.0, 3.0), 0.5, 4));
    let mesh = joined(near.clone(), &far);
    let camera = camera(64, 64);
    let options = ViewOptions { second: true, ..flat(1) };
    let [both, near, far] = [&mesh, &near, &far].map(|mesh| draw(mesh, &camera, &options));
    let mut hidden = 0;
    for i in 0..64 * 64 {
        let expected = if near.depth[i] > 0.0 { far.depth[i] } else { 0.0 };
        assert_eq!(both.second[i], expected, "pixel {i}");
        hidden += usize::from(expected > 0.0);
    }
    assert!(hidden > 50, "{hidden}");
    // One ball has no second surface: its far side faces away.
    assert!(near.second.iter().all(|z| *z == 0.0) && near.depth.iter().any(|z| *z > 0.0));
    assert!(draw(&mesh, &camera, &flat(1)).second.is_empty());
}
