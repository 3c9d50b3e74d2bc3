//! `cargo xtask …`: tests, lints, and the program's own commands, on the one release build.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

mod bundle;
mod fuzz;
#[cfg(test)]
mod layers;

const USAGE: &str = "usage: cargo xtask test [FILTER…] | lint | dist [OPTION…] | fuzz [OPTION…] | bundle … | COMMAND…

  test     the whole suite on flex, then the numerical tests on ndarray and wgpu
  lint     formatting, clippy and documentation, warnings refused
  dist     the smallest program, target/dist/snapsnap, in 20 minutes; it reads pictures more slowly (docs/inference.md);
           options are cargo's
  fuzz     damaged files of every format that the program reads; see cargo xtask fuzz --help
  bundle   [--features vulkan]: program, tests, benchmark and a script that runs them and writes a report, for a machine
           without cargo, target/snapsnap-bundle.tar.xz
  COMMAND  a snapsnap command with its arguments, for example: cargo xtask demo";

/// Devices beside the default one that the numerical tests run on.
const FURTHER_DEVICES: [&str; 2] = ["ndarray", "wgpu"];

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let rest = arguments.get(1..).unwrap_or_default();
    let done = match arguments.first().map(String::as_str) {
        None | Some("help" | "--help" | "-h") => {
            println!("{USAGE}");
            return ExitCode::SUCCESS;
        }
        Some("test") => test(rest),
        Some("lint") => lint(),
        Some("dist") => dist(rest),
        Some("fuzz") => fuzz::run(rest),
        Some("bundle") => {
            let features = match rest {
                [] => None,
                [option, features] if option == "--features" => Some(features.as_str()),
                _ => {
                    eprintln!("{USAGE}");
                    return ExitCode::from(2);
                }
            };
            bundle::bundle(features).map_err(|e| eprintln!("error: {e}")).is_ok()
        }
        Some(_) => {
            let mut run = cargo(&["run", "--release", "--bin", "snapsnap", "--"]);
            let code = run.args(&arguments).status().ok().and_then(|status| status.code());
            return ExitCode::from(code.and_then(|code| u8::try_from(code).ok()).unwrap_or(1));
        }
    };
    if done { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// The program's feature for MPI, if this machine can build it: that takes `mpicc` and libclang.
fn features() -> Option<&'static str> {
    let mpicc = Command::new("mpicc").arg("-show").output().is_ok_and(|output| output.status.success());
    let missing = match (mpicc, has_libclang()) {
        (true, true) => return Some("snapsnap/mpi"),
        (false, _) => "mpicc",
        (_, false) => "libclang",
    };
    let packages = "libopenmpi-dev openmpi-bin libclang-dev";
    println!("== without MPI: there is no {missing} (Debian: apt-get install {packages})");
    None
}

/// Features of the tests' build: the Python package, and the program's.
fn built_features(program: Option<&str>) -> String {
    ["snapsnap-python/python"].into_iter().chain(program).collect::<Vec<_>>().join(",")
}

fn has_libclang() -> bool {
    /// Starts of the library's names with and without a version, not of its relatives such as `libclang-cpp`.
    const NAMES: [&str; 4] = ["libclang.so", "libclang.dylib", "libclang-1", "libclang-2"];
    let entries = |folder: &Path| {
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect::<Vec<_>>()
    };
    let below = entries(Path::new("/usr/lib")).into_iter().flat_map(|folder| [folder.join("lib"), folder]);
    let mut folders = below.chain(["/usr/lib".into(), "/usr/lib64".into()]);
    let is_it = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        NAMES.iter().any(|start| name.starts_with(start))
    };
    env::var_os("LIBCLANG_PATH").is_some() || folders.any(|folder| entries(&folder).iter().any(is_it))
}

fn test(filter: &[String]) -> bool {
    let mut all = vec!["test", "--release", "--workspace", "--no-fail-fast"];
    let features = features();
    let built = built_features(features);
    all.extend(["--features", &built]);
    let numerical = ["--test", "numerical"];
    let filter = || ["--"].into_iter().chain(filter.iter().map(String::as_str));
    // Output is shown so that skipped tests are seen with their reasons.
    let show = ["--show-output"];
    // The tests build the program.
    let environment = || features.map(|features| ("SNAPSNAP_FEATURES", features));
    let mut passed = succeeds("flex", cargo(&all).args(filter()).args(show).envs(environment()));
    for device in FURTHER_DEVICES {
        let mut command = cargo(&all);
        passed &= succeeds(
            device,
            command
                .args(numerical)
                .args(filter())
                .args(show)
                .envs(environment())
                .env("SNAPSNAP_TEST_DEVICE", device),
        );
    }
    passed
}

fn lint() -> bool {
    let mut clippy = vec!["clippy", "--release", "--workspace", "--all-targets"];
    let built = built_features(features());
    clippy.extend(["--features", &built]);
    clippy.extend(["--", "-D", "warnings"]);
    let doc = ["doc", "--release", "--workspace", "--no-deps", "--document-private-items"];
    succeeds("format", &mut cargo(&["fmt", "--all", "--check"]))
        & succeeds("clippy", &mut cargo(&clippy))
        & succeeds("documentation", cargo(&doc).env("RUSTDOCFLAGS", "-D warnings"))
}

fn dist(options: &[String]) -> bool {
    let mut build = cargo(&["rustc", "--profile", "dist", "--package", "snapsnap", "--bin", "snapsnap"]);
    build.args(options).args(["--", "-C", "strip=symbols"]);
    // Packed relocations take a fraction of the space. They need glibc 2.36.
    if cfg!(target_os = "linux") {
        build.args(["-C", "link-arg=-Wl,-z,pack-relative-relocs"]);
    }
    succeeds("dist", &mut build)
}

fn cargo(arguments: &[&str]) -> Command {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(arguments);
    command
}

fn succeeds(name: &str, command: &mut Command) -> bool {
    println!("== {name}");
    match command.status() {
        Ok(status) if status.success() => true,
        Ok(status) => {
            eprintln!("{name}: {status}");
            false
        }
        Err(e) => {
            eprintln!("{name}: cannot run cargo: {e}");
            false
        }
    }
}
