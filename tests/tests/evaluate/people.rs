//! Evaluations.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

use serde_json::Value;
use snapsnap_tests::{assert_says, ended_with, refused, root, snapsnap, succeed};

use super::{copied, evaluate, json, people, weights};

/// The program's own weights on people in a ring of views.
#[test]
fn aligned_models_have_smaller_errors_and_the_report_says_how_they_moved() {
    let temporary = tempfile::tempdir().expect("a folder");
    let own = root().join("assets/weights/default.safetensors").display().to_string();
    let run = |name: &str, arguments: &[&str]| {
        let report = temporary.path().join(name);
        let common = ["--weights", &own, "--set", "metrics.mesh=false", "--set", "views.compared=[1]"];
        succeed(&mut evaluate(people(), &report, &[&common, arguments].concat()));
        (json(&report), fs::read_to_string(report.join("report.md")).expect("a report"))
    };
    let ((plain, text), (moved, moved_text)) = (run("plain", &[]), run("moved", &["--align", "similarity"]));
    assert_eq!(plain["alignment"]["method"], "none");
    assert!(plain["alignment"]["mean_degrees_cm_scale"].is_null() && !text.contains("## Alignment"));
    assert_eq!(moved["alignment"]["method"], "similarity");
    let figures = moved["alignment"]["mean_degrees_cm_scale"].as_array().expect("three figures");
    assert!(figures.iter().all(|figure| figure.as_f64().is_some_and(|figure| figure > 0.0)), "{figures:?}");
    assert!(moved_text.contains("## Alignment") && moved_text.contains("rigid and scale"), "{moved_text}");
    let apart = |report: &Value| report["geometry_cm"]["to_truth"]["mean"].as_f64().expect("a distance");
    assert!(apart(&moved) < apart(&plain), "{} → {}", apart(&plain), apart(&moved));
    // Baselines are not aligned.
    assert_eq!(moved["baselines"], plain["baselines"]);
}

#[test]
fn a_report_has_its_keys_and_follows_from_its_tables() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("new/report");
    let other = weights(2).display().to_string();
    let ablation = "ablations.sideless.sides=false";
    let arguments = ["--against", &other, "--set", "views.inputs=[3, 7]"];
    succeed(evaluate(people(), &report, &arguments).args(["--set", ablation]));
    let found = json(&report);
    for key in
        ["command", "commit", "device", "date", "protocols", "baselines", "points_mm", "left_out", "lpips"]
    {
        assert!(!found[key].is_null(), "{key}");
    }
    assert_eq!(found["device"], "cpu (flex)");
    assert_eq!(found["left_out"], Value::Array(Vec::new()));
    assert!(
        found["lpips"].as_str().is_some_and(|said| said.contains("n/a (weights missing: ")),
        "{}",
        found["lpips"]
    );
    assert!(found["command"].as_str().is_some_and(|said| said.contains("evaluate --config")));
    // Means over each person's views, then over people, from the table of views.
    let table = fs::read_to_string(report.join("views.csv")).expect("a table");
    let mut sums: BTreeMap<[&str; 3], [f64; 5]> = BTreeMap::new();
    for line in table.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        let sum = sums.entry([cells[0], cells[1], cells[2]]).or_default();
        let number = |i: usize| cells[i].parse::<f64>().expect("a number");
        let of_side = if (45.0..=135.0).contains(&(number(4) % 180.0)) { 1.0 } else { 0.0 };
        let values = [1.0, number(5), number(6), of_side * number(5), of_side];
        values.iter().zip(sum).for_each(|(v, sum)| *sum += v);
    }
    let mean = |contestant: &str, protocol: &str, figure: usize| {
        let people = ["0000", "0001"].map(|name| {
            let sum = sums[&[contestant, protocol, name]];
            assert_eq!(sum[0], 6.0, "views without the photographs");
            sum[figure] / sum[0]
        });
        (people[0] + people[1]) / 2.0
    };
    let sides = |protocol: &str| {
        let people = ["0000", "0001"].map(|name| sums[&["model", protocol, name]]);
        (people[0][3] / people[0][4] + people[1][3] / people[1][4]) / 2.0
    };
    for protocol in ["paper", "masked"] {
        let of = &found["protocols"][protocol];
        assert_eq!((of["people"].as_u64(), of["views"].as_u64()), (Some(2), Some(12)));
        assert_eq!(of["subjects"].as_array().map(Vec::len), Some(2));
        let of_sides = of["sides_psnr"]["mean"].as_f64().expect("a figure");
        assert!((of_sides - sides(protocol)).abs() < 1e-9, "{of_sides} {}", sides(protocol));
        assert!(of["overall"]["lpips"].is_null() && of["subjects"][0]["lpips"].is_null());
        for (figure, name) in [(1, "psnr"), (2, "ssim")] {
            let check = |value: &Value, contestant: &str| {
                let [mean_of, low, high] = ["mean", "low", "high"].map(|key| {
                    value[name][key].as_f64().unwrap_or_else(|| panic!("{contestant}, {protocol}: {value}"))
                });
                assert!(
                    (mean_of - mean(contestant, protocol, figure)).abs() < 1e-9,
                    "{contestant}: {mean_of}"
                );
                assert!(low <= mean_of && mean_of <= high, "{contestant}: {low} {mean_of} {high}");
            };
            check(&of["overall"], "model");
            for baseline in ["billboard", "true_points"] {
                check(&found["baselines"][baseline][protocol], baseline);
            }
            for other in ["against", "sideless"] {
                check(&found["compared"][other]["protocols"][protocol], other);
                let difference = found["compared"][other]["difference"][protocol][name]["mean"].as_f64();
                let expected = mean(other, protocol, figure) - mean("model", protocol, figure);
                assert!((difference.expect("a number") - expected).abs() < 1e-9, "{other}: {difference:?}");
            }
        }
    }
    // Ground-truth points in the photographs' colours are better than cut-outs.
    let psnr = |value: &Value| value["masked"]["psnr"]["mean"].as_f64().expect("a number");
    assert!(psnr(&found["baselines"]["true_points"]) > psnr(&found["baselines"]["billboard"]) + 2.0);
    assert!(found["points_mm"]["front"]["mean"].as_f64().is_some_and(|mm| mm > 0.0));
    for name in ["report.md", "people.png", "by_view.svg", "config.toml"] {
        assert!(fs::metadata(report.join(name)).is_ok_and(|file| file.len() > 100), "{name}");
    }
    // A second run into the same folder has the same figures.
    succeed(evaluate(people(), &report, &arguments).args(["--set", ablation]));
    assert_eq!(fs::read_to_string(report.join("views.csv")).expect("a table"), table);
}

/// Without a camera at a right angle, the ground truth of a side consists of the points of neighbouring views.
#[test]
fn true_points_of_a_side_do_not_depend_on_the_angles_of_the_cameras() {
    let temporary = tempfile::tempdir().expect("a folder");
    let points = |views: usize| {
        let data = temporary.path().join(format!("{views} views"));
        let mut command = snapsnap();
        command.args(["prepare", "synth", "--seed", "6", "--subjects", "1", "--split", "test", "--config"]);
        command.arg(root().join("configs/data/evaluation.toml"));
        command.args(["--set", "views.resolution=64", "--set", &format!("views.count={views}"), "-o"]);
        succeed(command.arg(&data));
        let report = temporary.path().join(format!("report of {views}"));
        succeed(&mut evaluate(&data, &report, &["--set", "metrics.geometry=false"]));
        json(&report)["points_mm"].clone()
    };
    // Views every 30° include the side itself. Of views every 36°, 72° and 108° are its neighbours.
    let (exact, neighbours) = (points(12), points(10));
    println!("{exact}\n{neighbours}");
    for view in ["front", "back", "right", "left"] {
        let [exact, neighbours] =
            [&exact, &neighbours].map(|points| points[view]["mean"].as_f64().expect("millimetres"));
        assert!((exact - neighbours).abs() < 0.02 * exact, "{view}: {exact} and {neighbours} mm");
    }
}

/// Five pairs of photographs with known cameras have no unseen sides.
#[test]
fn five_photographs_have_no_unseen_sides() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("report");
    succeed(&mut evaluate(people(), &report, &["--set", "views.inputs=[0, 2, 3, 5, 6]"]));
    let found = json(&report);
    assert_eq!(found["protocols"]["masked"]["views"].as_u64(), Some(6));
    assert!(found["points_mm"]["front"].is_null(), "pairs have no one frame");
    let text = fs::read_to_string(report.join("report.md")).expect("a report");
    assert!(text.contains("| model | 2 | 6 |"), "{text}");
}

/// Networks of neighbours need known cameras at the angle of their training.
#[test]
fn networks_of_neighbours_are_refused_for_other_photographs() {
    let temporary = tempfile::tempdir().expect("a folder");
    let path = |name: &str| temporary.path().join(name).display().to_string();
    let opposite = [
        "side_heads=false",
        "sides=\"predicted\"",
        "second_layer=false",
        "mirror=false",
        "both_ways=false",
        "details.resolution=4096",
    ];
    let sets: Vec<String> = opposite
        .iter()
        .chain(&["pair_degrees=90"])
        .flat_map(|key| ["--set".into(), format!("network.{key}")])
        .collect();
    let mut command = snapsnap();
    command.arg("import-weights").arg(root().join("assets/weights/default.safetensors")).args(&sets);
    let said = succeed(command.args(["-o", &path("neighbours.safetensors")]));
    assert!(said.contains("tensors of the unseen sides are left out"), "{said}");
    let weights = path("neighbours.safetensors");
    let run = |name: &str, inputs: &str| {
        let set = format!("views.inputs={inputs}");
        let set = ["--weights", &weights, "--set", &set, "--set", "views.compared=[1]"];
        evaluate(people(), &temporary.path().join(name), &set)
    };
    // Eight views.
    succeed(&mut run("quarters", "[0, 2, 4, 6]"));
    assert_says(
        &ended_with(1, &mut run("others", "[0, 3, 6]")),
        &["135.0° apart", "`network.pair_degrees` of the weights is 90"],
    );
    let mut command = snapsnap();
    let photographs = ["front.png", "back.png"].map(|name| root().join("assets/sample").join(name));
    command.arg("reconstruct").args(photographs).args(["--weights", &weights, "-o", &path("human.ply")]);
    assert!(refused(&mut command).contains("`network.pair_degrees` is 90"));
    assert!(!temporary.path().join("human.ply").exists());
}

/// Changed photographs and renders change the figures of their ablation. Placed photographs have no errors of points.
#[test]
fn photographs_and_renders_are_changed_by_ablations() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("report");
    let changes = [
        ("brighter", "{exposure=2.0}"),
        ("cut", "{cut=0.5}"),
        ("narrow", "{mask=-48.0}"),
        ("placed", "{road=\"placed\"}"),
        ("same", "{exposure=0.0}"),
    ];
    let changes = changes.map(|(name, change)| format!("ablations.{name}.photographs={change}"));
    let renders = ["ablations.near.supersampling=4", "ablations.filtered.antialiased=true"];
    let changes = changes.iter().map(String::as_str).chain(renders);
    let arguments: Vec<&str> = changes.flat_map(|change| ["--set", change]).collect();
    succeed(&mut evaluate(people(), &report, &arguments));
    let found = json(&report);
    let psnr = |of: &Value| of["protocols"]["masked"]["psnr"]["mean"].as_f64().expect("a figure");
    let model = found["protocols"]["masked"]["overall"]["psnr"]["mean"].as_f64().expect("a figure");
    let other = |name: &str| &found["compared"][name];
    assert_eq!(psnr(other("same")), model);
    for name in ["brighter", "cut", "narrow", "placed"] {
        assert!((psnr(other(name)) - model).abs() > 0.05, "{name}: {} and {model} dB", psnr(other(name)));
    }
    for name in ["near", "filtered"] {
        assert_ne!(psnr(other(name)), model, "{name}");
        assert_eq!(other(name)["points_mm"], other("same")["points_mm"], "{name}");
    }
    // One stop too bright in front and one too dark behind.
    assert!(psnr(other("brighter")) < model - 1.0, "{} and {model} dB", psnr(other("brighter")));
    assert!(other("cut")["points_mm"]["front"]["mean"].is_number(), "{}", other("cut")["points_mm"]);
    assert!(other("placed")["points_mm"]["front"].is_null(), "{}", other("placed")["points_mm"]);
}

#[test]
fn missing_and_damaged_parts_are_named_and_the_rest_evaluated() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("report");
    let left_out = |found: &Value| -> Vec<String> {
        let entries = found["left_out"].as_array().expect("a list").iter();
        entries
            .map(|e| format!("{}: {}", e["name"].as_str().unwrap_or(""), e["why"].as_str().unwrap_or("")))
            .collect()
    };
    // A missing person and missing weights.
    let said = ended_with(
        1,
        &mut evaluate(
            people(),
            &report,
            &["--set", "data.only=[\"0001\", \"0815\"]", "--against", "nowhere.safetensors"],
        ),
    );
    let found = json(&report);
    assert_eq!(found["protocols"]["paper"]["people"].as_u64(), Some(1));
    let all = left_out(&found);
    assert_eq!(all.len(), 2, "{all:?}");
    assert!(all[0].starts_with("against: nowhere.safetensors") && all[1].starts_with("0815: "), "{all:?}");
    assert!(said.contains("0815") && said.contains("nowhere.safetensors"), "{said}");

    // No compared view.
    let said = ended_with(1, &mut evaluate(people(), &report, &["--set", "views.compared=[0, 4]"]));
    assert!(said.contains("no view is left"), "{said}");

    // A truncated picture, a view without its camera, a picture of another size.
    let data = copied(temporary.path());
    let png = data.join("test/img/0000/3.png");
    let bytes = fs::read(&png).expect("a picture");
    fs::write(&png, &bytes[..bytes.len() / 2]).expect("writes");
    let other = image::RgbaImage::new(32, 32);
    other.save(data.join("test/img/0000/5.png")).expect("writes");
    let cameras = data.join("test/cameras/0001.json");
    let list: Vec<Value> =
        serde_json::from_str(&fs::read_to_string(&cameras).expect("cameras")).expect("JSON");
    fs::write(&cameras, serde_json::to_string(&list[..7]).expect("JSON")).expect("writes");
    ended_with(1, &mut evaluate(&data, &report, &["--set", "metrics.geometry=false"]));
    let found = json(&report);
    assert_eq!(
        (found["protocols"]["paper"]["people"].as_u64(), found["protocols"]["paper"]["views"].as_u64()),
        (Some(1), Some(4))
    );
    let all = left_out(&found);
    assert_eq!(all.len(), 4, "{all:?}");
    for (entry, parts) in all.iter().zip([
        ["0000, view 3", "3.png"],
        ["0000, view 5", "32×32"],
        ["0001", "7 cameras"],
        ["0000, pictures", "3.png"],
    ]) {
        assert!(parts.iter().all(|part| entry.contains(part)), "{entry}");
    }

    // A camera that mirrors, and a view without depth, whose pictures are compared.
    let data = temporary.path().join("mirrored");
    fs::create_dir(&data).expect("a folder");
    let data = copied(&data);
    let cameras = data.join("test/cameras/0001.json");
    let mut list: Vec<Value> =
        serde_json::from_str(&fs::read_to_string(&cameras).expect("cameras")).expect("JSON");
    let rows = list[2]["world_to_camera"].as_array_mut().expect("a matrix");
    for value in rows[0].as_array_mut().expect("a row") {
        *value = (-value.as_f64().expect("a number")).into();
    }
    fs::write(&cameras, serde_json::to_string(&list).expect("JSON")).expect("writes");
    fs::remove_file(data.join("test/depth/0000/0.npz")).expect("removes");
    let said = ended_with(1, &mut evaluate(&data, &report, &["--set", "metrics.geometry=false"]));
    assert!(said.contains("the camera of view 2 is a reflection"), "{said}");
    let found = json(&report);
    assert_eq!(found["protocols"]["masked"]["views"].as_u64(), Some(6), "{said}");
    assert!(left_out(&found).iter().any(|entry| entry.starts_with("0000, model, points: ")), "{said}");

    // Baselines are evaluated without weights.
    let said = ended_with(1, &mut evaluate(people(), &report, &["--weights", "nowhere.safetensors"]));
    assert!(said.contains("nowhere.safetensors"), "{said}");
    let found = json(&report);
    assert_eq!(found["protocols"], serde_json::json!({}));
    assert!(found["baselines"]["billboard"]["paper"]["psnr"]["mean"].is_number());
    assert!(!report.join("people.png").exists(), "pictures of an older report are gone");
}

/// Points that are not finite are counted, and the others are evaluated.
#[test]
fn a_prediction_that_is_not_finite_is_counted() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("report");
    let huge = ["--set", "network.anchor=none", "--set", "network.conf_threshold=0.0"];
    let config = temporary.path().join("networks.toml");
    let networks = snapsnap_tests::TRAINING.split("[samples]").next().expect("sections");
    fs::write(&config, networks).expect("writes");
    let file = temporary.path().join("huge.safetensors");
    succeed(
        snapsnap()
            .args(["init-weights", "--seed", "1", "--config"])
            .arg(&config)
            .args(huge)
            .arg("-o")
            .arg(&file),
    );
    // Products overflow f32.
    snapsnap_tests::fill_weights(&file, 1e30);
    let file = file.display().to_string();
    let arguments = ["--set", "metrics.geometry=false", "--weights", file.as_str()];
    let said = ended_with(1, &mut evaluate(people(), &report, &arguments));
    assert!(said.contains("not finite") || said.contains("no Gaussian came out"), "{said}");
    assert!(json(&report)["baselines"]["billboard"]["paper"]["psnr"]["mean"].is_number());
}

#[test]
fn wrong_evaluations_are_refused_with_the_reason() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("report");
    let wrong = |arguments: &[&str], expected: &[&str]| {
        let said = refused(&mut evaluate(people(), &report, arguments));
        assert!(expected.iter().all(|part| said.contains(part)), "{arguments:?}: {said}");
        assert!(!report.exists());
    };
    wrong(&["--set", "views.input=[0]"], &["unknown field", "input"]);
    wrong(&["--set", "views.inputs=[0]"], &["views.inputs", "2 to 64"]);
    wrong(&["--set", "views.inputs=[0, 99]"], &["no view 99, of 8"]);
    wrong(&["--set", "views.inputs=[1, 1]"], &["twice"]);
    wrong(&["--set", "views.resolution=48"], &["64", "48"]);
    wrong(&["--set", "ablations.model.sides=false"], &["`model`", "another meaning"]);
    wrong(&["--set", "ablations.a.knob=\"all\""], &["ablations.a.knob", "only settings of"]);
    wrong(&["--set", "ablations.a.supersampling=3"], &["ablations.a.supersampling", "1, 2 or 4"]);
    wrong(&["--set", "ablations.a.stride=0"], &["ablations.a.stride", "1 to 64"]);
    wrong(&["--set", "model.knob=\"all\""], &["model.knob", "only settings of"]);
    wrong(&["--set", "report.people=9"], &["report.people"]);
    wrong(&["--set", "views.supersampling=3"], &["views.supersampling"]);
    wrong(&["--set", "metrics.protocols=[]"], &["metrics.protocols"]);
    wrong(&["--set", "metrics.protocols=[\"best\"]"], &["unknown variant", "paper"]);
    wrong(&["--set", "data.split=\"val\""], &["has no split `val`"]);
    wrong(&["--set", "data.split=\"all\""], &["unknown variant `all`", "`train`", "`none`"]);
    wrong(&["--set", "data.split=\"none\""], &["img", "cannot read"]);
    wrong(&["--set", "photographs.cut=2"], &["photographs", "`cut` is 2, must be 0 to 0.9"]);
    wrong(&["--set", "ablations.a.photographs={mask=\"wide\"}"], &["mask", "f32"]);
    wrong(&["--device", "abacus"], &["abacus", "Available devices"]);
    wrong(&["--lpips", "nowhere.pth"], &["nowhere.pth"]);
    wrong(&["--align", "nowhere"], &["--align", "similarity"]);
    wrong(&["--set", "metrics.align=\"nowhere\""], &["unknown variant `nowhere`", "`similarity`"]);
    assert_says(&refused(&mut evaluate(people(), &people().join("report"), &[])), &["lies in a data set"]);
    assert_says(&refused(&mut evaluate(temporary.path(), &report, &[])), &["is no data set"]);
    wrong(&["--set", "metrics.protocols=[\"paper\", \"paper\"]"], &["metrics.protocols", "twice"]);
    wrong(&["--set", "views.compared=[1, 99]"], &["no view 99, of 8", "views.compared"]);
    let again = format!(
        "data.folders=[{:?}, {:?}]",
        people().display(),
        people().join("../").join(people()).display()
    );
    let mut command = snapsnap();
    command
        .args(["evaluate", "--config"])
        .arg(root().join("configs/eval.toml"))
        .args(["--set", &again, "-o"]);
    assert_says(&refused(command.arg(&report)), &["data.folders", "twice"]);
    // `..` after a folder that does not exist.
    let said = refused(&mut evaluate(people(), &people().join("no/../report"), &[]));
    assert!(said.contains("lies in a data set") && !people().join("no").exists(), "{said}");
    // The report's config contains the path.
    let said = refused(&mut evaluate(Path::new(OsStr::from_bytes(b"in\xff")), &report, &[]));
    assert!(said.contains("not UTF-8") && !report.exists(), "{said}");
    // A folder with other files is refused.
    let training = temporary.path().join("training");
    fs::create_dir(&training).expect("a folder");
    fs::write(training.join("config.toml"), "[training]").expect("writes");
    assert_says(&refused(&mut evaluate(people(), &training, &[])), &["config.toml", "belongs to no report"]);
    assert_eq!(fs::read_dir(&training).expect("there").count(), 1);
    // A report does not replace its inputs.
    fs::create_dir(&report).expect("a folder");
    fs::write(report.join("report.json"), "{\"command\": \"snapsnap evaluate\", \"commit\": \"0\"}")
        .expect("writes");
    let config = report.join("config.toml");
    fs::write(&config, "[views]\n").expect("writes");
    let mut command = snapsnap();
    command.args(["evaluate", "--config"]).arg(&config).arg("--data").arg(people()).arg("-o").arg(&report);
    assert_says(&refused(&mut command), &["would be overwritten"]);
    assert_eq!(fs::read_to_string(&config).expect("kept"), "[views]\n");
}
