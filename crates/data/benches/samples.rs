//! Samples per second and memory of the loader: `cargo bench --workspace --bench samples -- [--full]`. `--full` also
//! measures the memory of 10,000 samples.

use std::sync::Arc;
use std::time::Instant;

use peak_alloc::PeakAlloc;
use snapsnap_data::dataset::{Folder, Layout, Split};
use snapsnap_data::prepare::DataConfig;
use snapsnap_data::sample::{Augment, Loader, SampleConfig, Stage1, Stage2};
use snapsnap_people::synth;

#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

const SUBJECTS: usize = 4;

fn data_set(root: &std::path::Path, layout: Layout, resolution: u32) -> Arc<Folder> {
    let mut config = DataConfig::default();
    config.views.layout = layout;
    config.views.resolution = resolution;
    config.views.samples_per_axis = 1;
    let person =
        |index: usize| (Split::Train, format!("{index:04}"), synth::person(&format!("bench/{index}"), None));
    let root = root.join(format!("{layout:?}_{resolution}_24"));
    config.make(&root, "bench", (0..SUBJECTS).map(person)).expect("makes the folder")
}

/// Loads `count` samples one by one. Prints rate and peak memory.
fn measure<I: Send + Sync + 'static>(name: &str, loader: &Loader<I>, count: usize) {
    ALLOCATOR.reset_peak_usage();
    let before = ALLOCATOR.current_usage_as_mb();
    let start = Instant::now();
    let batches = (0..).flat_map(|pass| loader.batches(pass, 0)).take(count);
    for (loaded, batch) in (1_u32..).zip(batches) {
        batch.expect("loads");
        if [100, 1000, 10_000].contains(&loaded) {
            let rate = f64::from(loaded) / start.elapsed().as_secs_f64();
            let peak = ALLOCATOR.peak_usage_as_mb() - before;
            println!("| {name} | {loaded} | {rate:.1} | {peak:.0} MB |");
        }
    }
}

fn main() {
    let full = std::env::args().any(|argument| argument == "--full");
    let temporary = tempfile::tempdir().expect("temporary folder");
    let ours = SampleConfig::default();
    let plain = SampleConfig { augment: Augment::none(), ..SampleConfig::default() };
    let compat = SampleConfig { high_resolution: false, ..SampleConfig::compat() };
    println!("| samples | loaded | per second | peak memory |\n|---|---:|---:|---:|");
    for resolution in [512, 1024] {
        let exact = data_set(temporary.path(), Layout::Exact, resolution);
        let authors = data_set(temporary.path(), Layout::Authors, resolution);
        let sets = [
            ("exact, ours", &exact, &ours),
            ("exact, not augmented", &exact, &plain),
            ("authors' layout, compat", &authors, &compat),
        ];
        for (name, folder, config) in sets {
            let stage = Stage1::new(folder.clone(), Some(Split::Train), config.clone()).expect("samples");
            measure(&format!("stage 1, {resolution}², {name}"), &Loader::new(stage, 1, 2, 2), 100);
            let stage = Stage2::new(folder.clone(), Some(Split::Train), config.clone()).expect("samples");
            measure(&format!("stage 2, {resolution}², {name}"), &Loader::new(stage, 1, 2, 2), 100);
        }
        if full && resolution == 512 {
            let stage = Stage1::new(exact, Some(Split::Train), ours.clone()).expect("samples");
            let loader = Loader::new(stage, 1, 2, 2).shuffled(1);
            measure("stage 1, 512², exact, ours", &loader, 10_000);
        }
    }
}
