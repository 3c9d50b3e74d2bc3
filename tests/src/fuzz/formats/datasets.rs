//! Data sets in both layouts.

use std::path::Path;

use snapsnap_data::dataset::{self, Folder, Layout, Split};
use snapsnap_data::prepare::{DataConfig, Subject, ViewsConfig};

use super::super::Format;
use super::{nothing, scans};

/// Common settings.
const CHECK: Format = Format {
    name: "",
    sample: |_| (),
    changed: &[],
    command: "",
    file: None,
    partial: false,
    kept: &[],
    whole: nothing,
    share: 56,
};

pub const FORMATS: &[Format] = &[
    Format {
        name: "data-set",
        sample: |folder| write(&folder.join("set"), Layout::Exact),
        changed: &["dataset.toml", ".png", ".npz", ".json"],
        command: "prepare check in/set",
        ..CHECK
    },
    Format {
        name: "data-set-authors",
        sample: |folder| write(&folder.join("set_16_2"), Layout::Authors),
        changed: &["dataset.toml", ".jpg", ".png", ".npy"],
        command: "prepare check in/set_16_2",
        ..CHECK
    },
    Format {
        name: "data-set-packed",
        sample: |folder| {
            let temporary = tempfile::tempdir().expect("a folder");
            write(temporary.path(), Layout::Exact);
            let set = Folder::open(temporary.path()).expect("opens");
            dataset::pack(&set, &folder.join("packed"), 1 << 20, |_, _| {}).expect("packs");
        },
        changed: &["dataset.toml", "archives.csv", ".tar"],
        command: "prepare check in/packed",
        ..CHECK
    },
];

/// One subject of two views.
fn write(root: &Path, layout: Layout) {
    people(root, &[Split::Train], ViewsConfig { count: 2, resolution: 16, layout, ..ViewsConfig::default() });
}

/// One subject of four views in each split.
pub fn four_views(root: &Path, splits: &[Split]) {
    people(root, splits, ViewsConfig { count: 4, resolution: 64, ..ViewsConfig::default() });
}

fn people(root: &Path, splits: &[Split], views: ViewsConfig) {
    let config = DataConfig { views: ViewsConfig { samples_per_axis: 1, ..views }, ..DataConfig::default() };
    let folder = Folder::create(root, config.description("for tests")).expect("created");
    for split in splits {
        config.add(&folder, &Subject::plain(*split, "0000"), &scans::person()).expect("written");
    }
    folder.tidy();
}
