//! Time per synthetic person: `cargo bench --workspace --bench people -- [MAKEHUMAN_DATA]`.
//!
//! The time includes building or morphing, posing, dressing, meshing and painting.

use std::path::Path;
use std::time::Instant;

use snapsnap_mesh::mesh::Mesh;
use snapsnap_people::makehuman::{self, Library};
use snapsnap_people::{Detail, synth};

/// People of each kind.
const COUNT: usize = 20;

fn measure(kind: &str, make: impl Fn(&str) -> Mesh) {
    // Excludes files that are read only once.
    make("warm");
    let start = Instant::now();
    let triangles: usize = (0..COUNT).map(|index| make(&format!("train/1/{index}")).faces.len()).sum();
    let seconds = start.elapsed().as_secs_f64() / COUNT as f64;
    println!("| {kind} | {:.2} s | {:.0} | {}k |", seconds, 60.0 / seconds, triangles / COUNT / 1000);
}

fn main() {
    println!("| people | each | per minute | triangles |\n|---|---:|---:|---:|");
    measure("synthetic", |name| synth::person(name, None, Detail::Fine));
    // Cargo adds flags.
    match std::env::args().skip(1).find(|argument| !argument.starts_with('-')) {
        Some(folder) => {
            let library = Library::open(Path::new(&folder)).expect("MakeHuman's data");
            measure("MakeHuman", |name| makehuman::person(&library, name, None, Detail::Fine).expect("made"));
        }
        None => println!("SKIPPED: MakeHuman people, no folder of its data was given"),
    }
}
