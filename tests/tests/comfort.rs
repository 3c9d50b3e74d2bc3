//! `doctor`, help, manual pages, completions, and messages about weights and drivers.

use serde_json::Value;
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{
    assert_says, ended_with, fill_weights, limited, names, refused, root, snapsnap, succeed,
};

#[test]
fn the_doctor_names_devices_weights_and_what_mends() {
    let place = Workplace::empty();
    let said = succeed(&mut place.run("doctor --json"));
    let report: Value = serde_json::from_str(&said).expect("JSON");
    let devices = report["devices"].as_array().expect("devices");
    assert!(
        devices.iter().any(|device| device["name"] == "cpu" && device["memory_bytes"].as_u64() > Some(0))
    );
    assert_eq!(devices.iter().filter(|device| device["chosen"] == true).count(), 1);
    assert!(
        report["threads"].as_u64() > Some(0)
            && report["compiled_in"].as_array().is_some_and(|all| all.len() > 2)
    );
    assert!(report["bf16"].is_boolean(), "{report}");
    assert_eq!(report["weights"][0]["sound"], true);
    let missing = report["missing"].as_array().expect("a list");
    assert!(missing.iter().any(|m| m["mend"].as_str().is_some_and(|mend| mend.contains("fetch-weights"))));

    let said = succeed(&mut place.run("doctor"));
    for part in [
        "compiled in",
        "\nbf16 ",
        "--device auto takes",
        "the default weights: sound",
        "what could be better",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    place.write("bad.safetensors", "no weights");
    for file in ["bad.safetensors", "none.safetensors"] {
        assert!(refused(&mut place.run(&format!("doctor --weights {file}"))).contains(file));
    }
}

#[test]
#[cfg(target_os = "linux")]
fn a_report_that_the_disk_does_not_take_is_a_failure() {
    const COMMANDS: [&[&str]; 6] = [
        &["doctor"],
        &["doctor", "--json"],
        &["completions", "bash"],
        &["--help"],
        &["--version"],
        &["fetch-weights", "--list"],
    ];
    for arguments in COMMANDS {
        let full = std::fs::File::options().write(true).open("/dev/full").expect("a device");
        let said = refused(snapsnap().args(arguments).stdout(full));
        assert!(said.contains("stdout: cannot write"), "{arguments:?}: {said}");
    }
}

#[test]
fn values_that_are_not_finite_are_no_sound_weights() {
    let place = Workplace::with_weights();
    fill_weights(&place.path("w"), f32::NAN);
    assert_says(&refused(&mut place.run("doctor --weights w")), &["not finite"]);
}

#[test]
fn weights_of_another_size_are_refused_in_a_few_lines() {
    let place = Workplace::with_weights();
    let full = root().join("configs/full.toml");
    let said = refused(place.run("reconstruct a.png b.png --weights w --config").arg(&full));
    assert_says(&said, &["not the weights of the configured networks", "`network."]);
    assert!(said.lines().count() < 4, "{said}");
    // An import has no stored config to compare.
    let said = refused(place.run("import-weights w -o x.safetensors --config").arg(&full));
    assert!(said.contains("more") && said.lines().count() < 20, "{said}");
}

#[test]
fn a_senseless_number_of_threads_is_refused() {
    let said = refused(snapsnap().arg("doctor").env("RAYON_NUM_THREADS", "100000"));
    assert!(said.contains("RAYON_NUM_THREADS=100000") && said.contains("at most 1024"), "{said}");
}

#[test]
#[cfg(target_os = "linux")]
fn loaders_of_drivers_print_nothing() {
    let said = ended_with(0, snapsnap().arg("doctor").env_remove("XDG_RUNTIME_DIR"));
    assert!(said.is_empty(), "{said}");
}

/// A software adapter that is opened with so little memory ends the process that opens it.
#[test]
#[cfg(target_os = "linux")]
fn drivers_crash_no_command() {
    for limit in ["-v 1000000", "-v 1500000"] {
        succeed(&mut limited(snapsnap().arg("doctor"), limit));
    }
}

#[test]
fn every_command_has_a_manual_page_and_an_example() {
    let place = Workplace::empty();
    succeed(&mut place.run("man -o pages"));
    let pages = names(&place.path("pages"));
    for file in &pages {
        let page = String::from_utf8(place.read(&format!("pages/{file}"))).expect("a page");
        let name = file.trim_end_matches(".1");
        assert!(page.contains(".TH") && page.contains("SYNOPSIS"), "{name}");
        let words: Vec<&str> = if name.starts_with("snapsnap-prepare-") {
            name.splitn(3, '-').skip(1).collect()
        } else {
            name.splitn(2, '-').skip(1).collect()
        };
        let help = succeed(snapsnap().args(&words).arg("--help"));
        assert!(help.contains("Example") || help.contains("First steps"), "{name} has no example:\n{help}");
    }
    assert!(pages.len() > 20, "{pages:?}");
}

#[test]
fn shells_get_their_completions() {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let said = succeed(snapsnap().args(["completions", shell]));
        assert!(said.contains("snapsnap") && said.contains("reconstruct"), "{shell}");
    }
}

#[test]
fn without_arguments_a_newcomer_reads_the_first_steps() {
    let message = refused(&mut snapsnap());
    assert_says(&message, &["First steps", "snapsnap demo", "snapsnap reconstruct", "snapsnap view"]);
    assert!(!message.contains('\u{1b}'));
}

/// The program `script` imitates a terminal.
#[test]
#[cfg(target_os = "linux")]
fn colours_are_for_terminals_that_want_them() {
    let colored = |variables: &[(&str, &str)]| {
        let mut command = std::process::Command::new("script");
        for name in ["NO_COLOR", "CLICOLOR", "CLICOLOR_FORCE", "CI"] {
            command.env_remove(name);
        }
        command.env("TERM", "xterm").envs(variables.iter().copied());
        let program = snapsnap().get_program().to_string_lossy().into_owned();
        let output = command.args(["-qec", &format!("'{program}' --help"), "/dev/null"]).output().ok()?;
        assert!(output.status.success());
        Some(output.stdout.contains(&0x1b))
    };
    match colored(&[]) {
        None => println!("SKIPPED: no `script` on this machine"),
        Some(plain) => {
            assert!(plain);
            assert_eq!(colored(&[("NO_COLOR", "1")]), Some(false));
            assert_eq!(colored(&[("TERM", "dumb")]), Some(false));
        }
    }
}
