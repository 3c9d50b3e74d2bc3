//! A temporary folder in which the program runs.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use image::{Rgba, RgbaImage};
use tempfile::TempDir;

use crate::{files, names, refused, root, snapsnap, succeed};

/// A temporary folder, which is removed when this is dropped.
pub struct Workplace(TempDir);

impl Workplace {
    /// An empty folder.
    pub fn empty() -> Self {
        Self(tempfile::tempdir().expect("temporary folder"))
    }

    /// A folder with tiny random weights `w` and the pictures `front.png` and `back.png`.
    pub fn with_weights() -> Self {
        let place = Self::empty();
        succeed(place.run("init-weights --seed 1 -o w --config").arg(root().join("configs/tiny.toml")));
        for (name, seed) in [("front.png", 1), ("back.png", 2)] {
            person(200, 320, seed, 0).save(place.path(name)).expect("PNG");
        }
        place
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        self.0.path()
    }

    /// A path in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder().join(name)
    }

    /// Writes a file of the folder.
    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.path(name), content).expect("written");
    }

    /// The content of a file of the folder.
    pub fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    /// The program in the folder, with the words of a line.
    pub fn run(&self, line: &str) -> Command {
        let mut command = snapsnap();
        command.current_dir(self.folder()).args(line.split_whitespace());
        command
    }

    /// `reconstruct` with the weights `w` on the CPU, and with the words of a line.
    pub fn reconstruct(&self, line: &str) -> Command {
        self.run(&format!("reconstruct --weights w --device cpu {line}"))
    }

    /// The message of a refused command, which may change nothing in the folder.
    pub fn refusal(&self, command: &mut Command) -> String {
        let present = || (names(self.folder()), files(self.folder()));
        let before = present();
        let message = refused(command);
        assert!(present() == before, "{command:?} changed something: {message}");
        message
    }
}

/// An ellipse of coloured stripes; `background` goes into the colours of fully transparent pixels.
pub fn person(width: u32, height: u32, seed: u32, background: u8) -> RgbaImage {
    RgbaImage::from_fn(width, height, |x, y| {
        let (u, v) = (x as f32 / width as f32 - 0.5, y as f32 / height as f32 - 0.5);
        if (u / 0.3).powi(2) + (v / 0.45).powi(2) < 1.0 {
            Rgba([(x * 7 + seed * 31) as u8, (y * 5) as u8, ((x + y) * 3) as u8, 255])
        } else {
            let value = background.wrapping_mul((x * 13 + y * 7) as u8);
            Rgba([value, value / 2, !value, 0])
        }
    })
}
