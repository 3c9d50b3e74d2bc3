//! Meshes of Gaussians.

use std::collections::HashMap;
use std::fs;
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use glam::Vec3;
use snapsnap_mesh::import;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_splat::{Gaussians, scene};
use snapsnap_tests::{refused, root, snapsnap, succeed};

/// A shell of round Gaussians: an upright ellipsoid of half axes `half` around `centre`, green above its middle and red below.
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

/// The ellipsoid, and a speck that flies beside it.
fn written(path: &Path) {
    written_around(path, CENTRE);
}

fn written_around(path: &Path, centre: Vec3) {
    let (mut means, mut colors) = shell(20_000, HALF, centre);
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

/// Every edge has two faces that run along it in opposite directions, all faces hang together, and nothing is not finite.
fn check_closed(mesh: &Mesh) {
    mesh.check().expect("drawable");
    let mut edges = HashMap::new();
    let mut piece: Vec<usize> = (0..mesh.positions.len()).collect();
    fn root(piece: &mut [usize], mut row: usize) -> usize {
        while piece[row] != row {
            piece[row] = piece[piece[row]];
            row = piece[row];
        }
        row
    }
    for face in &mesh.faces {
        let [a, b, c] = face.positions;
        for (a, b) in [(a, b), (b, c), (c, a)] {
            assert!(edges.insert((a, b), ()).is_none(), "an edge has three faces");
            let (a, b) = (root(&mut piece, a as usize), root(&mut piece, b as usize));
            piece[a] = b;
        }
    }
    assert!(edges.keys().all(|(a, b)| edges.contains_key(&(*b, *a))), "an edge has one face");
    let first = root(&mut piece, 0);
    assert!((0..piece.len()).all(|row| root(&mut piece, row) == first), "more than one piece");
}

fn volume(mesh: &Mesh) -> f64 {
    let corner = |row: u32| mesh.positions[row as usize].as_dvec3();
    let face = |rows: [u32; 3]| corner(rows[0]).dot(corner(rows[1]).cross(corner(rows[2]))) / 6.0;
    mesh.faces.iter().map(|f| face(f.positions)).sum()
}

#[test]
fn a_shell_becomes_one_closed_surface_of_its_size_and_colours_in_every_kind_of_file() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let path = |name: &str| temporary.path().join(name);
    let expected = 4.0 / 3.0 * std::f64::consts::PI * f64::from(HALF.x * HALF.y * HALF.z);
    // The last in the coordinates of a survey, where f32 has steps of a millimetre.
    let far = Vec3::new(9_000.0, 120.0, -11_000.0);
    for (name, centre) in [("a.glb", CENTRE), ("a.obj", CENTRE), ("mesh.ply", far)] {
        written_around(&path("human.ply"), centre);
        let mut command = snapsnap();
        command.arg("mesh").arg(path("human.ply")).arg("-o").arg(path(name));
        let said = succeed(command.args(["--faces", "12000", "-v", "--device", "cpu"]));
        assert!(said.contains("flying pieces dropped: 1;"), "{said}");
        let mesh = import::read(&path(name)).expect("a mesh");
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

#[test]
fn a_texture_has_the_colours_of_the_places_it_lies_on() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let path = |name: &str| temporary.path().join(name);
    written(&path("human.ply"));
    let mut command = snapsnap();
    command.arg("mesh").arg(path("human.ply")).arg("-o").arg(path("a.obj"));
    succeed(command.args(["--faces", "4000", "--texture", "512", "--device", "cpu"]));
    assert!(path("a.mtl").is_file() && path("a_0.png").is_file());
    let mesh = import::read(&path("a.obj")).expect("a mesh");
    check_closed(&mesh);
    let texture = mesh.materials.iter().find_map(|material| material.texture.clone()).expect("a texture");
    assert_eq!(texture.dimensions(), (512, 512));
    let mut looked_at = 0;
    for face in &mesh.faces {
        let rows = face.texcoords.expect("texture coordinates");
        let middle = rows.map(|row| mesh.texcoords[row as usize]).iter().sum::<glam::Vec2>() / 3.0;
        let place = face.positions.map(|row| mesh.positions[row as usize]).iter().sum::<Vec3>() / 3.0;
        let above = place.y - CENTRE.y;
        if above.abs() < 0.05 {
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
    let temporary = tempfile::tempdir().expect("temporary folder");
    let here = || {
        let mut command = snapsnap();
        command.current_dir(temporary.path());
        command
    };
    let pictures = ["front.png", "back.png"].map(|name| root().join("assets/sample").join(name));
    let mut command = here();
    command.arg("reconstruct").args(pictures).args(["--set", "network.resolution=512", "--device", "cpu"]);
    succeed(command.args(["--mesh", "few.ply", "--faces", "20000"]));
    succeed(here().args(["mesh", "human.ply", "-o", "all.ply", "--faces", "0", "--device", "cpu"]));
    let [few, all] = ["few.ply", "all.ply"].map(|name| {
        let mesh = import::read(&temporary.path().join(name)).expect("a mesh");
        check_closed(&mesh);
        mesh
    });
    assert!((15_000..25_000).contains(&few.faces.len()), "{}", few.faces.len());
    assert!(all.faces.len() > 100_000, "{}", all.faces.len());
    let (few, all) = (volume(&few), volume(&all));
    assert!((few / all - 1.0).abs() < 0.05, "{few} m³ instead of {all}");
}

#[test]
fn meshes_that_cannot_be_are_refused() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let path = |name: &str| temporary.path().join(name);
    written(&path("human.ply"));
    let mesh = |from: &str, to: &str, more: &[&str]| {
        let mut command = snapsnap();
        refused(
            command.arg("mesh").arg(path(from)).arg("-o").arg(path(to)).args(more).args(["--device", "cpu"]),
        )
    };
    assert!(mesh("human.ply", "a.stl", &[]).contains("neither .glb nor .obj nor .ply"));
    assert!(mesh("human.ply", "human.ply", &[]).contains("would be overwritten"));
    assert!(mesh("human.ply", "a.ply", &["--texture", "512"]).contains("a PLY has no texture"));
    assert!(mesh("human.ply", "no/such/folder/a.glb", &[]).contains("cannot write"));
    assert!(mesh("human.ply", "a.glb", &["--texture", "3"]).contains("64"));
    assert!(mesh("human.ply", "a\nb.obj", &[]).contains("must be plain text"));
    // An OBJ's materials lie beside it, where an input may lie.
    fs::copy(path("human.ply"), path("b.mtl")).expect("copied");
    assert!(mesh("b.mtl", "b.obj", &[]).contains("would be overwritten"));
    let nothing = "ply\nformat ascii 1.0\nelement vertex 0\n".to_owned()
        + &scene::Stored::COLUMNS.map(|name| format!("property float {name}\n")).concat()
        + "end_header\n";
    fs::write(path("empty.ply"), nothing).expect("written");
    assert!(mesh("empty.ply", "a.glb", &[]).contains("no surface"));
    assert!(!path("a.glb").exists());
}
