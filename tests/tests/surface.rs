//! Meshes of Gaussians.

use std::collections::HashSet;
use std::path::Path;
use std::process::Command;

use burn::tensor::{Device, Tensor, TensorData};
use glam::Vec3;
use snapsnap_mesh::import;
use snapsnap_mesh::mesh::{Mesh, pieces};
use snapsnap_splat::{Gaussians, scene};
use snapsnap_tests::ply::balls;
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{ended_with, refused, sample, succeed};

/// An ellipsoid shell of round Gaussians with the half axes `half`, green above its middle and red below.
fn shell(n: usize, half: Vec3, centre: Vec3) -> (Vec<f32>, Vec<f32>) {
    let golden = std::f32::consts::PI * (3.0 - 5.0_f32.sqrt());
    let place = |i: usize| {
        let y = 1.0 - 2.0 * (i as f32 + 0.5) / n as f32;
        let radius = (1.0 - y * y).sqrt();
        let angle = golden * i as f32;
        half * Vec3::new(radius * angle.cos(), y, radius * angle.sin())
    };
    let color = |p: Vec3| if p.y > 0.0 { [0.1, 0.8, 0.2] } else { [0.8, 0.1, 0.2] };
    let places: Vec<Vec3> = (0..n).map(place).collect();
    let means = places.iter().flat_map(|p| (*p + centre).to_array()).collect();
    (means, places.iter().flat_map(|p| color(*p)).collect())
}

const HALF: Vec3 = Vec3::new(0.25, 0.9, 0.18);
const CENTRE: Vec3 = Vec3::new(0.05, 0.9, -0.03);

/// The part of the ellipsoid below this share of its half height, and a speck that flies beside it.
fn written_around(path: &Path, centre: Vec3, height: f32) {
    let (mut means, mut colors) = shell(20_000, HALF, centre);
    // From top to bottom.
    let above = 3 * means.as_chunks::<3>().0.iter().take_while(|p| p[1] - centre.y > height * HALF.y).count();
    means.drain(..above);
    colors.drain(..above);
    let (speck, its) = shell(40, Vec3::splat(0.015), centre + Vec3::new(0.32, 0.3, 0.0));
    means.extend(speck);
    colors.extend(its);
    let n = means.len() / 3;
    let device = Device::flex();
    let rows =
        |values: Vec<f32>, width: usize| Tensor::<2>::from_data(TensorData::new(values, [n, width]), &device);
    let gaussians = Gaussians::new(
        rows(means, 3),
        rows([1.0, 0.0, 0.0, 0.0].repeat(n), 4),
        rows(vec![0.006; 3 * n], 3),
        Tensor::full([n], 0.95, &device),
        rows(colors, 3),
    );
    scene::write(&gaussians.expect("shapes"), path).expect("written");
}

/// Asserts that the mesh is one closed, consistently oriented, finite surface.
fn check_closed(mesh: &Mesh) {
    mesh.check().expect("drawable");
    let mut edges = HashSet::new();
    for face in &mesh.faces {
        let [a, b, c] = face.positions;
        for edge in [(a, b), (b, c), (c, a)] {
            assert!(edges.insert(edge), "an edge has three faces");
        }
    }
    assert!(edges.iter().all(|(a, b)| edges.contains(&(*b, *a))), "an edge has one face");
    let starts: HashSet<u32> = edges.iter().map(|(start, _)| *start).collect();
    assert_eq!(starts.len(), mesh.positions.len(), "a position has no face");
    let faces = mesh.faces.iter().map(|face| &face.positions[..]);
    assert!(pieces(mesh.positions.len(), faces).iter().all(|piece| *piece == 0), "more than one piece");
}

/// `mesh` on the CPU.
fn mesh_of(place: &Workplace, file: &str, to: &str, more: &str) -> Command {
    place.run(&format!("mesh {file} -o {to} --device cpu {more}"))
}

fn volume(mesh: &Mesh) -> f64 {
    let corner = |row: u32| mesh.positions[row as usize].as_dvec3();
    let face = |rows: [u32; 3]| corner(rows[0]).dot(corner(rows[1]).cross(corner(rows[2]))) / 6.0;
    mesh.faces.iter().map(|f| face(f.positions)).sum()
}

#[test]
fn a_shell_becomes_one_closed_surface_of_its_size_and_colours_in_every_kind_of_file() {
    let place = Workplace::empty();
    let expected = 4.0 / 3.0 * std::f64::consts::PI * f64::from(HALF.x * HALF.y * HALF.z);
    let far = Vec3::new(60.0, 12.0, -80.0);
    for (name, centre) in [("a.glb", CENTRE), ("a.obj", CENTRE), ("mesh.ply", far)] {
        written_around(&place.path("human.ply"), centre, 1.0);
        // By default a GLB of 12,000 triangles has a texture. An OBJ with vertex colours needs no material file.
        let options = if name == "mesh.ply" { "-v" } else { "-v --texture 0" };
        let said = succeed(&mut mesh_of(&place, "human.ply", name, &format!("--faces 12000 {options}")));
        assert!(!place.path("a.mtl").exists());
        assert!(said.contains("flying pieces dropped: 1;"), "{said}");
        let mesh = import::read(&place.path(name)).expect("a mesh");
        check_closed(&mesh);
        assert!(mesh.faces.len() <= 12_000 && mesh.faces.len() > 11_000, "{name}: {}", mesh.faces.len());
        let found = volume(&mesh);
        // Gaussians have some thickness, 6 mm here.
        assert!((found / expected - 1.0).abs() < 0.08, "{name}: {found}, expected {expected}");
        let off = |p: &Vec3| (((*p - centre) / HALF).length() - 1.0).abs() * HALF.min_element();
        let worst = mesh.positions.iter().map(off).fold(0.0, f32::max);
        assert!(worst < 0.012, "{name}: {worst} m off");
        for (p, color) in mesh.positions.iter().zip(&mesh.colors) {
            let above = p.y - centre.y;
            let expected = if above > 0.0 { Vec3::new(0.1, 0.8, 0.2) } else { Vec3::new(0.8, 0.1, 0.2) };
            assert!(above.abs() < 0.03 || (*color - expected).length() < 0.08, "{name}: {p} is {color}");
        }
    }
}

/// Printers' programs read millimetres with z up. trimesh, numpy-stl and lib3mf (strictly) have read such files.
#[test]
fn printers_get_the_surface_in_millimetres() {
    let place = Workplace::empty();
    written_around(&place.path("human.ply"), CENTRE, 1.0);
    for name in ["a.ply", "a.stl", "a.3mf"] {
        succeed(&mut mesh_of(&place, "human.ply", name, "--faces 3000"));
    }
    let mesh = import::read(&place.path("a.ply")).expect("a mesh");
    let printed = |row: u32| {
        let position = 1000.0 * mesh.positions[row as usize];
        Vec3::new(position.x, -position.z, position.y)
    };
    let stl = place.read("a.stl");
    assert_eq!(stl.len(), 84 + 50 * mesh.faces.len());
    assert_eq!(u32::from_le_bytes(stl[80..84].try_into().expect("four")) as usize, mesh.faces.len());
    for (bytes, face) in stl[84..].chunks_exact(50).zip(&mesh.faces) {
        let vector = |at: usize| {
            Vec3::from_array([0, 4, 8].map(|axis| {
                f32::from_le_bytes(bytes[12 * at + axis..12 * at + axis + 4].try_into().expect("four"))
            }))
        };
        assert_eq!([1, 2, 3].map(vector), face.positions.map(printed));
        let outward = vector(0).dot((vector(2) - vector(1)).cross(vector(3) - vector(1)));
        assert!(outward >= 0.0 && vector(0).length() < 1.001);
    }
    let file = std::fs::File::open(place.path("a.3mf")).expect("a file");
    let mut archive = zip::ZipArchive::new(file).expect("a ZIP");
    let model = archive.by_name("3D/3dmodel.model").expect("a model");
    let model = std::io::read_to_string(model).expect("text");
    assert!(model.contains("unit=\"millimeter\""));
    assert_eq!(model.matches("<vertex ").count(), mesh.positions.len());
    assert_eq!(model.matches("<triangle ").count(), mesh.faces.len());
    let Vec3 { x, y, z } = printed(7);
    let vertex = model.lines().filter(|line| line.starts_with("<vertex")).nth(7).expect("the eighth");
    assert_eq!(vertex, format!("<vertex x=\"{x:.4}\" y=\"{y:.4}\" z=\"{z:.4}\"/>"));
}

/// Level cameras do not see the crown of a head.
#[test]
fn a_hole_at_the_top_is_closed_and_the_inside_stays_solid() {
    let place = Workplace::empty();
    let height = 0.7;
    written_around(&place.path("human.ply"), CENTRE, height);
    succeed(&mut mesh_of(&place, "human.ply", "mesh.ply", "--faces 0"));
    let mesh = import::read(&place.path("mesh.ply")).expect("a mesh");
    check_closed(&mesh);
    let highest = mesh.positions.iter().map(|p| p.y - CENTRE.y).fold(f32::MIN, f32::max);
    assert!((highest - height * HALF.y).abs() < 0.03, "{highest}");
    let whole = 4.0 / 3.0 * std::f64::consts::PI * f64::from(HALF.x * HALF.y * HALF.z);
    // The ellipsoid without its cap.
    let expected = whole * (1.0 - (1.0 - f64::from(height)).powi(2) * (2.0 + f64::from(height)) / 4.0);
    let found = volume(&mesh);
    assert!((found / expected - 1.0).abs() < 0.06, "{found} m³ instead of {expected}");
}

#[test]
fn a_texture_has_the_colours_of_the_places_it_lies_on() {
    let place = Workplace::empty();
    written_around(&place.path("human.ply"), CENTRE, 1.0);
    succeed(&mut mesh_of(&place, "human.ply", "a.obj", "--faces 4000 --texture 512"));
    assert!(place.path("a.mtl").is_file() && place.path("a_0.png").is_file());
    let mesh = import::read(&place.path("a.obj")).expect("a mesh");
    check_closed(&mesh);
    let texture = mesh.materials.iter().find_map(|material| material.texture.clone()).expect("a texture");
    assert_eq!(texture.dimensions(), (512, 512));
    let mut looked_at = 0;
    for face in &mesh.faces {
        let rows = face.texcoords.expect("texture coordinates");
        let middle = rows.map(|row| mesh.texcoords[row as usize]).iter().sum::<glam::Vec2>() / 3.0;
        let place = face.positions.map(|row| mesh.positions[row as usize]).iter().sum::<Vec3>() / 3.0;
        let above = place.y - CENTRE.y;
        // The texel at the middle of a sliver may be a neighbour's.
        let [a, b, c] = rows.map(|row| 512.0 * mesh.texcoords[row as usize]);
        if above.abs() < 0.05 || (b - a).perp_dot(c - a).abs() < 16.0 {
            continue;
        }
        let (x, y) = ((512.0 * middle.x) as u32, (512.0 * (1.0 - middle.y)) as u32);
        let color = Vec3::from_array(texture.get_pixel(x, y).0.map(|c| f32::from(c) / 255.0));
        let expected = if above > 0.0 { Vec3::new(0.1, 0.8, 0.2) } else { Vec3::new(0.8, 0.1, 0.2) };
        assert!((color - expected).length() < 0.15, "{place}: {color}");
        looked_at += 1;
    }
    assert!(looked_at > 3000);
}

/// Fringes and fingers of a person fall onto one another when there are few triangles.
#[test]
fn a_person_of_few_triangles_is_one_closed_surface() {
    let place = Workplace::empty();
    let mut command = sample::reconstruct(place.folder(), &sample::paths());
    succeed(command.arg("--mesh").arg(place.path("few.ply")).args(["--faces", "20000"]));
    succeed(&mut place.run("mesh human.ply -o all.ply --faces 0 --device cpu"));
    let [few, all] = ["few.ply", "all.ply"].map(|name| {
        let mesh = import::read(&place.path(name)).expect("a mesh");
        check_closed(&mesh);
        // Euler's formula: before narrow tunnels were closed there were 33.
        let handles = 1 - (mesh.positions.len() as i64 - mesh.faces.len() as i64 / 2) / 2;
        assert_eq!(handles, 0, "{name}");
        mesh
    });
    assert!((15_000..25_000).contains(&few.faces.len()), "{}", few.faces.len());
    assert!(all.faces.len() > 100_000, "{}", all.faces.len());
    let (few, all) = (volume(&few), volume(&all));
    assert!((few / all - 1.0).abs() < 0.05, "{few} m³ instead of {all}");
}

#[test]
fn a_glb_has_a_texture_and_an_obj_has_normals_and_no_material_over_its_colours() {
    let place = Workplace::empty();
    written_around(&place.path("human.ply"), CENTRE, 1.0);
    for name in ["a.glb", "a.obj"] {
        succeed(&mut mesh_of(&place, "human.ply", name, "--faces 3000"));
    }
    let glb = import::read(&place.path("a.glb")).expect("a mesh");
    let texture = glb.materials.iter().find_map(|material| material.texture.clone()).expect("a texture");
    assert_eq!(texture.dimensions(), (2048, 2048));
    let text = String::from_utf8(place.read("a.obj")).expect("text");
    assert!(!text.contains("mtllib") && !text.contains("usemtl"));
    let numbers = |line: &str| -> Vec<f32> {
        line.split_whitespace().skip(1).map(|word| word.parse().expect("a number")).collect()
    };
    let rows =
        |kind: &str| text.lines().filter(|line| line.starts_with(kind)).map(numbers).collect::<Vec<_>>();
    let (positions, normals) = (rows("v "), rows("vn "));
    assert_eq!(positions.len(), normals.len());
    for (p, n) in positions.iter().zip(&normals) {
        // Position and colour. An ellipsoid's normals lead outwards.
        assert_eq!(p.len(), 6);
        let (p, n) = (Vec3::from_slice(p) - CENTRE, Vec3::from_slice(n));
        let expected = (p / (HALF * HALF)).normalize();
        assert!((n.length() - 1.0).abs() < 1e-3 && n.dot(expected) > 0.8, "{p}: {n}");
    }
    let face = text.lines().find(|line| line.starts_with("f ")).expect("a face");
    let corner = face.split_whitespace().nth(1).expect("a corner");
    assert_eq!(corner.split("//").collect::<Vec<_>>(), [corner.split('/').next().expect("a row"); 2]);
}

#[test]
fn bodies_keep_their_shape_unless_they_are_very_small_large_or_far_away() {
    let place = Workplace::empty();
    let expected = 4.0 / 3.0 * std::f64::consts::PI * f64::from(HALF.x * HALF.y * HALF.z);
    let far = Vec3::new(60.0, 0.0, -80.0);
    let bodies = [
        (0.06, far, true),
        (5.0, far, true),
        (1e-6, Vec3::ZERO, false),
        (1e10, Vec3::ZERO, false),
        (1.0, 90.0 * far, false),
    ];
    for (size, centre, is_made) in bodies {
        let (means, _) = shell(20_000, HALF * size, centre);
        let places: Vec<[f32; 3]> = means.as_chunks::<3>().0.to_vec();
        place.write("any.ply", balls(places.into_iter(), (0.006 * size).ln()));
        let mut command = mesh_of(&place, "any.ply", "any_mesh.ply", "--faces 12000");
        if !is_made {
            let said = refused(&mut command);
            assert!(said.contains("any.ply: no surface: a body of"), "{size}: {said}");
            continue;
        }
        succeed(&mut command);
        let mesh = import::read(&place.path("any_mesh.ply")).expect("a mesh");
        check_closed(&mesh);
        let found = volume(&mesh) / f64::from(size).powi(3);
        assert!((found / expected - 1.0).abs() < 0.08, "{size}: {found}, expected {expected}");
    }
}

#[test]
fn scenes_that_are_no_single_body_are_named() {
    let place = Workplace::empty();
    let body = |centre: Vec3| shell(15_000, HALF, centre).0;
    let both = [body(Vec3::new(-0.6, 0.9, 0.0)), body(Vec3::new(0.6, 0.9, 0.0))].concat();
    let places: Vec<[f32; 3]> = both.as_chunks::<3>().0.to_vec();
    place.write("two.ply", balls(places.into_iter(), 0.006_f32.ln()));
    let said = ended_with(0, &mut mesh_of(&place, "two.ply", "mesh.ply", ""));
    assert!(said.contains("warning") && said.contains("of the body's volume was dropped"), "{said}");

    // Gaussians in one place have no surface, and neither have Gaussians far larger than the body.
    let random = (0..1000_u32).map(|i| [0, 1, 2].map(|c| ((i * 7 + c * 331) % 997) as f32 / 997.0));
    let scenes = [balls((0..5000).map(|_| [0.0; 3]), 0.1_f32.ln()), balls(random, 70.0)];
    for scene in scenes {
        place.write("coarse.ply", scene);
        let said = place.refusal(&mut mesh_of(&place, "coarse.ply", "none.ply", ""));
        assert!(said.contains("coarse.ply: no surface: the Gaussians are too large"), "{said}");
    }
}

#[test]
fn meshes_that_cannot_be_are_refused() {
    let place = Workplace::empty();
    written_around(&place.path("human.ply"), CENTRE, 1.0);
    // Files beside a new OBJ belong to something else.
    place.write("a.mtl", "newmtl mine\n");
    let nothing = "ply\nformat ascii 1.0\nelement vertex 0\n".to_owned()
        + &scene::Stored::COLUMNS.map(|name| format!("property float {name}\n")).concat()
        + "end_header\n";
    place.write("empty.ply", nothing);
    for (file, to, more, expected) in [
        ("human.ply", "a.fbx", "", "is no .glb, .obj, .ply, .stl or .3mf"),
        ("human.ply", "a.ply", "--texture 512", "this kind has no texture"),
        ("human.ply", "no/such/folder/a.glb", "", "cannot write"),
        ("human.ply", "a.glb", "--texture 3", "64"),
        ("human.ply", "a.obj", "--texture 64", "belongs to no mesh of this name"),
        ("empty.ply", "a.glb", "", "no surface"),
    ] {
        let said = place.refusal(&mut mesh_of(&place, file, to, more));
        assert!(said.contains(expected), "{to}: {said}");
    }
    let said = place.refusal(place.run("mesh human.ply --device cpu -o").arg("a\nb.obj"));
    assert!(said.contains("must be plain text"), "{said}");
}
