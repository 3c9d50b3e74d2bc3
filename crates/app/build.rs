//! Sets the program's commit and its date.

use std::path::Path;
use std::process::Command;

fn main() {
    let git = |arguments: &[&str]| -> Option<String> {
        let output = Command::new("git").args(arguments).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let commit = git(&["rev-parse", "--short=10", "HEAD"]).unwrap_or_else(|| "unknown".into());
    println!("cargo:rustc-env=SNAPSNAP_COMMIT={commit}");
    let date = git(&["show", "-s", "--format=%cs", "HEAD"]);
    let of = date.map_or_else(String::new, |date| format!(" ({commit}, {date})"));
    println!("cargo:rustc-env=SNAPSNAP_VERSION={}{of}", env!("CARGO_PKG_VERSION"));
    // The file of HEAD's branch changes with every commit.
    for name in ["HEAD".to_owned(), git(&["symbolic-ref", "-q", "HEAD"]).unwrap_or_default()] {
        let path = git(&["rev-parse", "--git-path", &name]).filter(|path| Path::new(path).is_file());
        if let Some(path) = path {
            println!("cargo:rerun-if-changed={path}");
        }
    }
}
