//! Every format that the program reads: how a small sound sample is made, and which command reads it.

mod datasets;
mod evaluation;
mod gaussians;
mod makehuman;
mod pickle;
mod pictures;
mod scans;
mod training;
mod weights;

use std::fs;
use std::path::Path;

use super::Format;

/// All formats.
pub fn all() -> impl Iterator<Item = &'static Format> {
    let groups = [
        pictures::FORMATS,
        weights::FORMATS,
        gaussians::FORMATS,
        scans::FORMATS,
        datasets::FORMATS,
        makehuman::FORMATS,
        training::FORMATS,
        evaluation::FORMATS,
    ];
    groups.into_iter().flatten()
}

/// Writes a file of a sample, and the folders around it.
fn put(folder: &Path, name: &str, content: impl AsRef<[u8]>) {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().expect("in a folder")).expect("a folder");
    fs::write(path, content).expect("a file");
}

/// For commands that write nothing.
#[allow(clippy::unnecessary_wraps, reason = "as all judges of outputs")]
fn nothing(_: &Path) -> Result<(), String> {
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_has_a_name_of_its_own() {
        let mut names: Vec<&str> = all().map(|format| format.name).collect();
        let count = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), count);
        assert!(names.iter().all(|name| !name.contains([':', '/'])), "{names:?}");
    }
}
