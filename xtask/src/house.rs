//! The floors of the house: which crate may know which.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Crates and the crates of ours that each may depend on, lowest floor first.
const FLOORS: [(&str, &[&str]); 9] = [
    ("splat", &[]),
    ("ops", &[]),
    ("mesh", &["splat"]),
    ("net", &["splat", "ops"]),
    ("people", &["mesh"]),
    ("data", &["people", "mesh", "splat"]),
    ("eval", &["net", "data", "ops", "mesh", "splat"]),
    ("train", &["eval", "data", "people", "net", "ops", "mesh", "splat"]),
    ("app", &["train", "eval", "data", "people", "net", "ops", "mesh", "splat"]),
];

/// Our crates that the manifest of each folder below `crates` asks for, those for tests included.
fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates");
    let folders = fs::read_dir(crates).expect("the crates").map(|entry| entry.expect("an entry").path());
    let ours = |line: &str| {
        let name: String = line.chars().take_while(|c| c.is_alphanumeric() || *c == '-').collect();
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
fn no_crate_knows_one_above_it() {
    let found = dependencies();
    let names: BTreeSet<&str> = FLOORS.iter().map(|(name, _)| *name).collect();
    assert_eq!(found.keys().map(String::as_str).collect::<BTreeSet<_>>(), names, "crates and floors");
    for (row, (name, allowed)) in FLOORS.iter().enumerate() {
        let below: BTreeSet<&str> = FLOORS[..row].iter().map(|(name, _)| *name).collect();
        for known in &found[*name] {
            assert!(
                allowed.contains(&known.as_str()) && below.contains(known.as_str()),
                "{name} knows {known}"
            );
        }
    }
}
