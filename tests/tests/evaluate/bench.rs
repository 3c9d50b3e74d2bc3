//! Benchmarks.

use std::fs;

use snapsnap_tests::{assert_says, ended_with, refused, snapsnap, succeed};

use super::{json, people, weights};

const CONFIG: &str = r#"
[bench]
resolution = 64
[model]
supersampling = 1
[settings."no sides"]
knob = "sides"
sides = false
[settings."stride 2"]
knob = "Gaussians"
stride = 2
"#;

#[test]
fn every_setting_is_measured_with_its_omissions() {
    let temporary = tempfile::tempdir().expect("a folder");
    let (config, report) = (temporary.path().join("bench.toml"), temporary.path().join("report"));
    fs::write(&config, CONFIG).expect("writes");
    let bench = |arguments: &[&str]| {
        let mut command = snapsnap();
        command.args(["--quiet", "bench", "--quick", "--device", "cpu", "--config"]).arg(&config);
        command.arg("--data").arg(people()).args(arguments);
        if !arguments.contains(&"--weights") {
            command.arg("--weights").arg(weights(1));
        }
        command.arg("-o").arg(&report);
        command
    };
    succeed(&mut bench(&[]));
    let found = json(&report);
    let settings = found["settings"].as_array().expect("settings");
    let names: Vec<&str> = settings.iter().filter_map(|s| s["name"].as_str()).collect();
    assert_eq!(names, ["as it is", "stride 2", "no sides"]);
    let of = |place: usize, key: &str| settings[place][key].as_f64().expect("a number");
    for (place, setting) in settings.iter().enumerate() {
        assert!(of(place, "p50") > 0.0 && of(place, "p95") >= of(place, "p50"));
        assert!(of(place, "memory") > 1e6 && of(place, "psnr").is_finite());
        // Rounding, except for splats whose α is at the cut-off.
        assert!(of(place, "splat_error") < 1e-2 && of(place, "cutoff_error") < 0.2, "{setting}");
        for module in ["loading weights", "encoder", "decoders", "activations"] {
            assert!(setting["modules"][module].is_number(), "{module}: {setting}");
        }
    }
    assert!(
        settings[0]["modules"]["heads (4)"].is_number() && settings[0]["modules"]["side colours"].is_number()
    );
    assert!(
        settings[2]["modules"]["heads (2)"].is_number() && settings[2]["modules"]["side colours"].is_null()
    );
    let ratio = of(1, "gaussians") / of(0, "gaussians");
    assert!((0.2..0.3).contains(&ratio), "every fourth pixel: {ratio}");
    for name in ["report.md", "settings.csv", "pareto.svg", "config.toml"] {
        assert!(fs::metadata(report.join(name)).is_ok_and(|file| file.len() > 100), "{name}");
    }
    assert!(!report.join("training_points.svg").exists());

    // A setting and a run that fail are named, and the others are measured.
    let said = ended_with(
        1,
        &mut bench(&["--set", "settings.odd.set=[\"network.resolution=100\"]", "--runs", "nowhere"]),
    );
    assert!(said.contains("odd") && said.contains("nowhere"), "{said}");
    assert_eq!(json(&report)["settings"].as_array().map(Vec::len), Some(3));
    // A setting can have its own data set.
    let said = ended_with(1, &mut bench(&["--set", "settings.elsewhere.data=\"no/people\""]));
    assert!(said.contains("elsewhere") && said.contains("no/people"), "{said}");
    assert!(refused(&mut bench(&["--set", "bench.runs=0"])).contains("bench.runs"));
    assert!(refused(&mut bench(&["--set", "settings.a.stride=0"])).contains("stride"));
    assert!(refused(&mut bench(&["--set", "settings.a.inputs=[0]"])).contains("settings.a.inputs"));
    assert_says(&refused(&mut bench(&["--weights", "nowhere.safetensors"])), &["nowhere.safetensors"]);
}
