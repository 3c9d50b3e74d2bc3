//! Meshes of other methods.

use std::fs;
use std::path::Path;

use snapsnap_tests::{ended, ended_with, snapsnap, succeed};

use super::{evaluate, evaluation, json, people};

#[test]
fn a_mesh_is_as_far_from_the_truth_as_it_was_moved_until_it_is_aligned() {
    let temporary = tempfile::tempdir().expect("a folder");
    let (meshes, report) = (temporary.path().join("meshes"), temporary.path().join("report"));
    fs::create_dir(&meshes).expect("a folder");
    // One of them has a mesh, moved by 3 cm and turned by 4°. The other wears a skirt, which looks alike when turned.
    let scan = fs::read_to_string(people().join("scans/test/0001/0001.obj")).expect("the saved scan");
    let (sin, cos) = 4.0_f64.to_radians().sin_cos();
    let lines =
        scan.lines().filter(|line| !line.starts_with("mtllib") && !line.starts_with("usemtl")).map(|line| {
            let Some(rest) = line.strip_prefix("v ") else { return line.to_owned() };
            let v: Vec<f64> = rest.split_whitespace().map(|v| v.parse().expect("a number")).collect();
            format!("v {} {} {}", cos * v[0] + sin * v[2] + 0.03, v[1], cos * v[2] - sin * v[0])
        });
    fs::write(meshes.join("0001.obj"), lines.collect::<Vec<_>>().join("\n") + "\n").expect("writes");
    let run = |icp: &[&str]| {
        let mut command = evaluation(&[people()], &report);
        let said = ended_with(1, command.arg("--mesh-dir").arg(&meshes).args(icp));
        assert!(said.contains("0000") && said.contains("has no mesh"), "{said}");
        let found = json(&report);
        assert_eq!(
            (found["people"].as_u64(), found["left_out"].as_array().map(Vec::len)),
            (Some(1), Some(1))
        );
        let figure = |key: &str| found["geometry_cm"][key]["mean"].as_f64().expect("a number");
        (figure("truth_to_surface"), figure("normal_consistency"), found["subjects"][0]["aligned"].clone())
    };
    let (apart, facing, aligned) = run(&[]);
    assert!(apart > 1.0 && aligned.is_null(), "{apart} {aligned}");
    let (after, facing_after, aligned) = run(&["--align"]);
    assert!(after < 0.6 * apart && facing_after > facing, "{apart} → {after}, {facing} → {facing_after}");
    assert!(aligned[0].as_f64().is_some_and(|degrees| (degrees - 4.0).abs() < 1.5), "{aligned}");
    let text = fs::read_to_string(report.join("report.md")).expect("a report");
    assert!(text.contains("rigid, by iterated closest points"), "{text}");
    let (_, _, scaled) = run(&["--align", "similarity"]);
    assert!(scaled[2].as_f64().is_some_and(|scale| (scale - 1.0).abs() < 0.03 && scale != 1.0), "{scaled}");
}

#[test]
fn scans_are_the_truth_where_they_are_given() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("report");
    // Saved scans are in the world of the views. Measured against themselves they are not off.
    let saved = people().join("scans/test");
    let scans = format!("data.scans={:?}", saved.display().to_string());
    succeed(evaluation(&[people()], &report).args(["--set", &scans, "--mesh-dir"]).arg(&saved));
    let found = json(&report);
    let figure = |key: &str| found["geometry_cm"][key]["mean"].as_f64().expect("a number");
    for key in ["truth_to_surface", "surface_to_scan"] {
        assert!(figure(key) < 1e-4, "{key}: {found}");
    }
    // Both surfaces have 50,000 different points on some three square metres.
    assert!((0.3..0.5).contains(&figure("chamfer")), "{found}");
}

/// People of two data sets have the same names. Their meshes are in folders of the data sets' names.
#[test]
fn meshes_of_two_data_sets_are_told_apart() {
    let temporary = tempfile::tempdir().expect("a folder");
    let (meshes, report) = (temporary.path().join("meshes"), temporary.path().join("report"));
    let other = super::copied(temporary.path());
    let set = people().file_name().expect("a name");
    fs::create_dir_all(meshes.join(set)).expect("a folder");
    let scan = fs::read_to_string(people().join("scans/test/0001/0001.obj")).expect("the saved scan");
    let scan: String =
        scan.lines().filter(|line| !line.contains("mtl")).flat_map(|line| [line, "\n"]).collect();
    // A mesh that belongs to neither set.
    fs::write(meshes.join("0001.obj"), &scan).expect("writes");
    let run = || ended(evaluation(&[people(), &other], &report).arg("--mesh-dir").arg(&meshes));
    let (code, said) = run();
    assert!(code.is_some_and(|code| code != 0) && said.contains("has no mesh people/0001.obj"), "{said}");
    fs::write(meshes.join(set).join("0001.obj"), &scan).expect("writes");
    let (code, said) = run();
    assert_eq!(code, Some(1), "{said}");
    let found = json(&report);
    let name = format!("{}/0001", set.display());
    assert_eq!(found["subjects"].as_array().map(Vec::len), Some(1), "{found}");
    assert_eq!((&found["subjects"][0]["name"], found["people"].as_u64()), (&name.into(), Some(1)), "{found}");
    assert_eq!(found["left_out"].as_array().map(Vec::len), Some(3), "{found}");
    // Sets of the same name are told apart by their parent folder's name, also for relative paths.
    let around = temporary.path().join("around");
    fs::create_dir_all(meshes.join("around/people")).expect("a folder");
    fs::create_dir(&around).expect("a folder");
    super::copied(&around);
    fs::write(meshes.join("around/people/0001.obj"), &scan).expect("writes");
    let mut command = evaluation(&[Path::new("people"), &other], &report);
    ended_with(1, command.current_dir(&around).arg("--mesh-dir").arg(&meshes));
    assert_eq!(json(&report)["subjects"][0]["name"], "around/people/0001");
}

/// The mesh of a reconstruction is about as near to the ground truth as its Gaussians, except for closed parts such as
/// the bottom of a skirt.
#[test]
fn the_mesh_of_the_gaussians_is_measured_beside_them() {
    let temporary = tempfile::tempdir().expect("a folder");
    let (people, report) = (temporary.path().join("people"), temporary.path().join("report"));
    let mut command = snapsnap();
    command.args(["prepare", "synth", "--seed", "4", "--subjects", "1", "--split", "test", "--config"]);
    command.arg(snapsnap_tests::root().join("configs/data/evaluation.toml"));
    command.args(["--set", "views.samples_per_axis=1", "--set", "views.count=4", "-o"]);
    succeed(command.arg(&people));
    let weights = snapsnap_tests::root().join("assets/weights/default.safetensors").display().to_string();
    let arguments = ["--set", "metrics.mesh=true", "--set", "views.compared=[1]", "--weights", &weights];
    succeed(&mut evaluate(&people, &report, &arguments));
    let found = json(&report);
    let figure = |of: &str, key: &str| found[of][key]["mean"].as_f64().expect("a number");
    let [centres, mesh] = ["geometry_cm", "mesh_cm"].map(|of| figure(of, "chamfer"));
    assert!(mesh > 0.3 && mesh < 1.2 * centres && mesh < 2.0, "{mesh} and {centres} cm");
    // A surface has smoother normals than depth maps of Gaussians.
    let [centres, mesh] = ["geometry_cm", "mesh_cm"].map(|of| figure(of, "normal_consistency"));
    assert!(mesh > centres && mesh > 0.8, "{mesh} and {centres}");
    let text = fs::read_to_string(report.join("report.md")).expect("a report");
    assert!(text.contains("| model, mesh |"), "{text}");
}
