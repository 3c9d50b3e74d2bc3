//! Our weight file back in the authors' layout.

use std::collections::HashMap;
use std::path::Path;

use super::WeightsError;
use super::file::{Progress, WeightFile, write_tensors};
use super::import::alias_of;
use super::source::Float;

/// Writes `from` (our file) to `to` with every name of the authors' state dicts, aliases included, and without our
/// metadata, so that a strict `load_state_dict` accepts each part. Values that are not finite are refused, as in an
/// import. Returns the number of tensors written.
///
/// # Errors
/// [`WeightsError`].
pub fn export(from: &Path, to: &Path, progress: Progress) -> Result<usize, WeightsError> {
    let file = WeightFile::open(from, None)?;
    let mut entries: Vec<(String, &str)> = Vec::new();
    for name in file.source.tensors().keys() {
        entries.push((name.clone(), name));
        entries.extend(alias_of(name).map(|alias| (alias, name.as_str())));
    }
    let shapes =
        entries.iter().map(|(alias, name)| (alias.clone(), file.source.tensors()[*name].shape.clone()));
    let metadata = HashMap::from([("format".to_owned(), "pt".to_owned())]);
    let values = |i: usize| file.source.read_f32(entries[i].1);
    write_tensors(to, &from.display().to_string(), metadata, shapes.collect(), Float::F32, values, progress)?;
    Ok(entries.len())
}
