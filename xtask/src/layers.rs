//! The layers of the workspace: the crates that each crate may depend on.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Crates, lowest layer first, and the crates of the workspace that each may depend on.
const LAYERS: [(&str, &[&str]); 13] = [
    ("base", &[]),
    ("splat", &["base"]),
    ("ops", &["base"]),
    ("mesh", &["splat", "base"]),
    ("net", &["splat", "ops", "base"]),
    ("people", &["mesh", "base"]),
    ("photo", &["net", "ops", "mesh", "splat", "base"]),
    ("rig", &["photo", "people", "mesh", "splat"]),
    ("data", &["photo", "people", "net", "mesh", "splat", "base"]),
    ("eval", &["data", "photo", "net", "ops", "mesh", "splat", "base"]),
    ("train", &["eval", "data", "people", "net", "ops", "mesh", "splat", "base"]),
    ("app", &["train", "eval", "data", "rig", "photo", "people", "net", "ops", "mesh", "splat", "base"]),
    ("python", &["app", "photo", "net", "ops", "mesh", "splat"]),
];

/// Dependencies within the workspace, of tests too, by the manifest of each folder below `crates`.
fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates");
    let folders = fs::read_dir(crates).expect("the crates").map(|entry| entry.expect("an entry").path());
    let ours = |line: &str| {
        let name: String = line.chars().take_while(|c| c.is_alphanumeric() || *c == '-').collect();
        let name = if name == "snapsnap" { "snapsnap-app" } else { &name };
        name.strip_prefix("snapsnap-").map(str::to_owned)
    };
    folders
        .map(|folder| {
            let manifest = fs::read_to_string(folder.join("Cargo.toml")).expect("a manifest");
            let name = folder.file_name().expect("a name").to_string_lossy().into_owned();
            (name, manifest.lines().filter_map(ours).collect())
        })
        .collect()
}

#[test]
fn no_crate_depends_on_one_above_it() {
    let found = dependencies();
    let names: BTreeSet<&str> = LAYERS.iter().map(|(name, _)| *name).collect();
    assert_eq!(found.keys().map(String::as_str).collect::<BTreeSet<_>>(), names, "crates and layers");
    for (row, (name, allowed)) in LAYERS.iter().enumerate() {
        let below: BTreeSet<&str> = LAYERS[..row].iter().map(|(name, _)| *name).collect();
        for dependency in &found[*name] {
            assert!(
                allowed.contains(&dependency.as_str()) && below.contains(dependency.as_str()),
                "{name} depends on {dependency}"
            );
        }
    }
}
