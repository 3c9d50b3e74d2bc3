//! Where a photograph comes from, what separates its person from the background, and how it is placed.

use std::path::Path;

use image::{DynamicImage, GrayImage, RgbImage};
use snapsnap_base::FileError;
use snapsnap_mesh::picture;

/// Placement of a photograph on its canvas. Heights are the person's, in pixels of a canvas of 1024.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Placement {
    /// The picture is the canvas.
    AsIs,
    /// The person's box is resized with antialiasing, to the place of the training subjects.
    Training { height: usize },
    /// As in the published demo: centred, resized without antialiasing, and valid only for pixels with a full mask.
    Demo { height: usize },
}

/// What separates the person from the background.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cutting {
    /// Masks and alpha channels alone.
    Given,
    /// A network, for photographs with neither a mask nor an alpha channel.
    Missing,
    /// A network, for all photographs without a mask file. Alpha channels are ignored.
    All,
}

impl Cutting {
    /// The way that users call auto, network or none.
    pub fn named(name: &str) -> Option<Self> {
        Some(match name {
            "auto" => Self::Missing,
            "network" => Self::All,
            "none" => Self::Given,
            _ => return None,
        })
    }
}

/// Where the pixels of a photograph come from.
#[derive(Clone, Copy)]
pub enum Content<'a> {
    /// The file at the source's path.
    File,
    /// The content of a file.
    Bytes(&'a [u8]),
    /// The pixels, and a mask (the person's share of each pixel) if there is one.
    Pixels(&'a RgbImage, Option<&'a GrayImage>),
}

/// A photograph and what is known about it.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// Path of the file, or a name for messages.
    pub path: &'a Path,
    /// Where the pixels come from.
    pub content: Content<'a>,
    /// File of the mask (white: person).
    pub mask: Option<&'a Path>,
    /// A picture of any size that corrects the mask: white keeps, black removes, 128 changes nothing.
    pub strokes: Option<&'a GrayImage>,
}

impl<'a> Source<'a> {
    /// A photograph in a file, without mask file and strokes.
    pub fn file(path: &'a Path) -> Self {
        Self { path, content: Content::File, mask: None, strokes: None }
    }

    /// A photograph in memory, with its mask if there is one.
    pub fn pixels(name: &'a Path, rgb: &'a RgbImage, mask: Option<&'a GrayImage>) -> Self {
        Self { content: Content::Pixels(rgb, mask), ..Self::file(name) }
    }

    pub(crate) fn decode(&self) -> Result<DynamicImage, FileError> {
        match self.content {
            Content::File => picture::photograph(self.path, None),
            Content::Bytes(bytes) => picture::photograph(self.path, Some(bytes)),
            Content::Pixels(rgb, _) => Ok(rgb.clone().into()),
        }
    }
}
