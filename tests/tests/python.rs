//! The Python package, by its own tests (crates/python/tests).

use std::env;
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use snapsnap_tests::{build, root, succeed};

/// An interpreter that has NumPy and pytest: `SNAPSNAP_PYTHON`, or python3. Otherwise the reason is printed, or it is an
/// error if `SNAPSNAP_REQUIRE_PYTHON` is set.
fn python() -> Option<PathBuf> {
    let python = env::var_os("SNAPSNAP_PYTHON").map_or_else(|| "python3".into(), PathBuf::from);
    let tried = Command::new(&python).args(["-c", "import numpy, pytest"]).output();
    let missing = match tried {
        Ok(output) if output.status.success() => return Some(python),
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(e) => e.to_string(),
    };
    let message = format!("{} cannot run the tests of the Python package: {missing}", python.display());
    assert!(env::var_os("SNAPSNAP_REQUIRE_PYTHON").is_none(), "{message}");
    println!("SKIPPED: {message}");
    None
}

#[test]
fn the_package_passes_its_own_tests() {
    let Some(python) = python() else { return };
    let native = build(&["--package", "snapsnap-python", "--lib"], "snapsnap-python/python").join(format!(
        "{}snapsnap_python{}",
        env::consts::DLL_PREFIX,
        env::consts::DLL_SUFFIX
    ));
    // The package as an installation has it.
    let folder = tempfile::tempdir().expect("folder");
    let package = folder.path().join("snapsnap");
    fs::create_dir(&package).expect("a folder");
    for file in fs::read_dir(root().join("crates/python/snapsnap")).expect("the package") {
        let file = file.expect("a file");
        if file.path().is_file() {
            fs::copy(file.path(), package.join(file.file_name())).expect("copied");
        }
    }
    let suffix = if cfg!(windows) { "pyd" } else { "abi3.so" };
    fs::copy(&native, package.join(format!("_native.{suffix}"))).expect("copied");
    let mut tests = Command::new(python);
    tests
        .args(["-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider"])
        .arg(root().join("crates/python/tests"));
    tests.env("PYTHONPATH", folder.path()).env("PYTHONDONTWRITEBYTECODE", "1").current_dir(folder.path());
    println!("{}", succeed(&mut tests));
}
