//! What lies in a folder, to be written once more and compared.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};

/// Something in a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Entry {
    /// A file and its content.
    File(Vec<u8>),
    /// A folder.
    Folder,
    /// A symbolic link and where it leads.
    Link(PathBuf),
    /// A pipe.
    Pipe,
    /// Anything else.
    Other,
}

/// Everything below a folder, by path.
pub type Tree = BTreeMap<PathBuf, Entry>;

/// Reads a folder.
///
/// # Panics
/// If it cannot be read.
pub fn read(root: &Path) -> Tree {
    let mut tree = Tree::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let kind = fs::symlink_metadata(&path).expect("an entry").file_type();
            let entry = if kind.is_symlink() {
                Entry::Link(fs::read_link(&path).expect("a link"))
            } else if kind.is_dir() {
                folders.push(path.clone());
                Entry::Folder
            } else if kind.is_file() {
                Entry::File(fs::read(&path).expect("a file"))
            } else if kind.is_fifo() {
                Entry::Pipe
            } else {
                Entry::Other
            };
            tree.insert(path.strip_prefix(root).expect("below").to_owned(), entry);
        }
    }
    tree
}

/// Writes files and folders into `root`.
///
/// # Panics
/// If they cannot be written.
pub fn write(tree: &Tree, root: &Path) {
    fs::create_dir_all(root).expect("a folder");
    for (path, entry) in tree {
        let path = root.join(path);
        match entry {
            // Folders come before what they hold.
            Entry::Folder => fs::create_dir_all(path).expect("a folder"),
            Entry::File(bytes) => fs::write(path, bytes).expect("a file"),
            Entry::Link(_) | Entry::Pipe | Entry::Other => panic!("samples have files and folders only"),
        }
    }
}
