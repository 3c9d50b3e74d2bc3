//! The table of stability.

use std::fs;

use snapsnap_tests::{refused, snapsnap, succeed};

use super::{json, weights};

/// The cases on the CPU. `cargo xtask stability` runs them on every device.
#[test]
fn every_case_holds_on_the_processor() {
    let temporary = tempfile::tempdir().expect("a folder");
    let report = temporary.path().join("report");
    let mut command = snapsnap();
    command.args(["--quiet", "stability", "--quick", "--device", "cpu", "--weights"]).arg(weights(1));
    succeed(command.arg("-o").arg(&report));
    let found = json(&report);
    assert_eq!((found["fails"].as_u64(), found["skipped"].as_u64()), (Some(0), Some(0)));
    let cases = found["cases"].as_array().expect("cases");
    let of = |area: &str| cases.iter().filter(|case| case["area"] == area).count();
    assert!(
        of("Splats") >= 30
            && of("Networks") >= 14
            && of("Losses and optimiser") >= 9
            && of("Stiff training") == 3
    );
    // Cases against f64 have errors below the limit.
    for case in cases.iter().filter(|case| case["area"] == "Splats" && !case["gradient_error"].is_null()) {
        assert!(case["value_error"].as_f64().is_some_and(|e| e < 2e-6), "{case}");
    }
    assert!(fs::read_to_string(report.join("report.md")).expect("a report").contains("| holds |"));
    let said = refused(snapsnap().args(["stability", "--only", "no such case", "-o"]).arg(&report));
    assert!(said.contains("no case has that"), "{said}");
}
