//! Output files and folders, and checks of their paths.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Component, Path, PathBuf};

use serde::Serialize;
use snapsnap_base::FileError;
use snapsnap_base::config::{differences, keys};
use snapsnap_base::file::{self, write_whole};
use snapsnap_splat::scene::Kind;

use crate::failure::Failure;

/// Writes a file, whole or not at all.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    Ok(write_whole(path, |out| out.write_all(bytes)).map_err(FileError::write(path))?)
}

/// Removes a file unless it is missing.
pub fn remove(path: &Path) -> Result<(), Failure> {
    match fs::remove_file(path) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(FileError::write(path)(e).into()),
        _ => Ok(()),
    }
}

/// Refuses a path that is no folder and cannot become one, or in which no file can be written.
pub fn check_folder(path: &Path) -> Result<(), Failure> {
    if path.exists() && !path.is_dir() {
        return Err(Failure::file(path, "exists and is no folder"));
    }
    let existing = path.ancestors().find(|path| path.exists()).unwrap_or(Path::new("."));
    Ok(tempfile::tempfile_in(existing).map(drop).map_err(FileError::write(path))?)
}

/// Makes a folder and its parents unless they exist.
pub fn make_folder(path: &Path) -> Result<(), Failure> {
    fs::create_dir_all(path).map_err(|e| Failure::file(path, format_args!("cannot make this folder: {e}")))
}

/// Refuses outputs that cannot be written, that are given twice or that are inputs.
pub fn check_outputs(outputs: &[&Path], inputs: &[&Path]) -> Result<(), Failure> {
    for (i, output) in outputs.iter().enumerate() {
        file::check_writable(output).map_err(FileError::write(output))?;
        if inputs.iter().any(|input| is_same_file(output, input)) {
            return Err(Failure::file(output, "is an input of this command and would be overwritten"));
        }
        if outputs[..i].iter().any(|other| place(output) == place(other) || is_same_file(output, other)) {
            return Err(Failure::file(output, "is given for two outputs"));
        }
    }
    Ok(())
}

/// Refuses a file of Gaussians with an unknown extension. A pipe or a device without one receives a PLY.
pub fn check_kind(path: &Path) -> Result<(), Failure> {
    if Kind::named(path).is_some() || file::is_special(path) {
        return Ok(());
    }
    Err(Failure::file(path, "is no .ply, .spz, .glb or .sog; the extension says what to write"))
}

/// Refuses to go on in the folder of a config, `there`, that differs from the `wanted` one.
pub fn check_settings(path: &Path, there: &impl Serialize, wanted: &impl Serialize) -> Result<(), Failure> {
    let differing = differences(&keys(there), &keys(wanted)).into_iter();
    let differing: Vec<String> = differing.map(|(_, message)| message).collect();
    if differing.is_empty() {
        return Ok(());
    }
    let differing = differing.join(", ");
    let message = format!("is of people made with other settings: {differing}; give another folder");
    Err(Failure::file(path, message))
}

/// Refuses an output in a data set or its source (one of `roots`): a data set would take a folder for a subject without
/// pictures.
pub fn outside_data<'a>(path: &Path, roots: impl IntoIterator<Item = &'a Path>) -> Result<(), Failure> {
    let whole = std::path::absolute(path).map_err(FileError::write(path))?;
    // Links of existing folders are followed. `..` after a missing folder is taken literally.
    let mut there = PathBuf::new();
    for part in whole.components() {
        match part {
            Component::ParentDir => drop(there.pop()),
            part => there.push(part),
        }
        there = there.canonicalize().unwrap_or(there);
    }
    for root in roots {
        let Ok(root) = root.canonicalize() else { continue };
        // The folder of a scan contains its materials and textures.
        let folder: &Path = if root.is_file() { root.parent().unwrap_or(&root) } else { &root };
        if there.starts_with(folder) {
            return Err(Failure::file(path, "lies in a data set or its source"));
        }
    }
    Ok(())
}

/// The canonical path of a file, which may be missing.
pub fn place(path: &Path) -> PathBuf {
    let path = file::target_of(path);
    let folder = file::folder_of(&path);
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}

/// Whether both paths lead to one existing regular file.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b && a.is_file())
}
