//! Files of Gaussians: PLY, SPZ, GLB, SOG, and .splat, which is only read. The kind of a file follows from its first
//! bytes when it is read (a .splat has no first bytes of its own), and from its extension when it is written.

use std::io::{self, Read, Write};
use std::path::Path;

use burn::tensor::Device;
use snapsnap_base::{FileError, file};

use crate::stored::Problem;
pub use crate::stored::{Loaded, Stored};
use crate::{Gaussians, SplatError, glb, ply, sog, splat_file, spz};

/// First bytes of a ZIP archive.
const ZIP: [u8; 2] = *b"PK";

/// Kinds of files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// 3D Gaussian PLY in the layout of the INRIA viewer.
    Ply,
    /// A PLY whose world has y down, for viewers that expect the axes of INRIA's scenes. By a comment in the header,
    /// [`Stored::read`] recognises the file and turns the Gaussians back.
    YDown,
    /// Niantic's compressed splats.
    Spz,
    /// Binary glTF with the extension `KHR_gaussian_splatting`.
    Glb,
    /// PlayCanvas' compressed splats.
    Sog,
}

impl Kind {
    /// The kind with `path`'s extension; `None` for any other extension.
    pub fn named(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "ply" => Some(Self::Ply),
            "spz" => Some(Self::Spz),
            "glb" => Some(Self::Glb),
            "sog" => Some(Self::Sog),
            _ => None,
        }
    }

    /// The kind with `path`'s extension; PLY for any other extension.
    pub fn of(path: &Path) -> Self {
        Self::named(path).unwrap_or(Self::Ply)
    }
}

impl Stored {
    /// Reads a file of any kind.
    ///
    /// # Errors
    /// [`SplatError::File`] if the file cannot be read, is of another kind, is truncated, or lacks a property.
    pub fn read(path: &Path) -> Result<Self, SplatError> {
        let cannot = FileError::read(path);
        let mut file = file::open(path).map_err(&cannot)?;
        let mut start = Vec::new();
        (&mut file).take(2).read_to_end(&mut start).map_err(&cannot)?;
        let magic = <[u8; 2]>::try_from(&start[..]).unwrap_or_default();
        let length = file.metadata().map_err(&cannot)?.len();
        let whole = start.as_slice().chain(file);
        let read = match magic {
            spz::GZIP => spz::read(whole, length),
            glb::MAGIC => glb::read(whole, length),
            spz::BARE => spz::read_streams(whole, length),
            ZIP => sog::read(whole, length),
            _ if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("splat")) => {
                splat_file::read(whole, length)
            }
            _ => ply::read(whole),
        };
        let read = read.map_err(|problem| match problem {
            Problem::Io(source) => cannot(source),
            Problem::Content(problem) => FileError::unsuitable(path, problem),
        });
        let mut read = read?;
        read.limit();
        Ok(read)
    }

    /// Writes a file of this kind, whole or not at all.
    ///
    /// # Errors
    /// [`SplatError::NotFinite`]; [`SplatError::File`] for values that an SPZ, GLB or SOG cannot hold, or if the file
    /// cannot be written. `path` is then left as it was.
    pub fn write(&self, kind: Kind, path: &Path) -> Result<(), SplatError> {
        self.check(kind, path)?;
        Ok(file::write_whole(path, |out| self.encode(kind, out)).map_err(FileError::write(path))?)
    }

    /// The bytes of a file of this kind.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn to_bytes(&self, kind: Kind) -> Result<Vec<u8>, SplatError> {
        let path = Path::new("memory");
        self.check(kind, path)?;
        let mut bytes = Vec::new();
        self.encode(kind, &mut bytes).map_err(FileError::write(path))?;
        Ok(bytes)
    }

    /// Losses beyond the usual quantisation of this kind of file, one sentence each.
    pub fn losses(&self, kind: Kind) -> Vec<String> {
        match kind {
            Kind::Ply | Kind::YDown | Kind::Glb => Vec::new(),
            Kind::Spz => spz::losses(self),
            Kind::Sog => sog::losses(self),
        }
    }

    fn encode(&self, kind: Kind, out: &mut impl Write) -> io::Result<()> {
        match kind {
            Kind::Ply => ply::write(self, None, out),
            Kind::YDown => {
                let mut turned = self.clone();
                turned.turn(false);
                ply::write(&turned, Some(ply::Y_DOWN), out)
            }
            Kind::Spz => spz::write(self, out),
            Kind::Glb => glb::write(self, out),
            Kind::Sog => sog::write(self, out),
        }
    }

    fn check(&self, kind: Kind, path: &Path) -> Result<(), SplatError> {
        for (column, values) in self.columns.iter().enumerate() {
            if let Some(index) = values.iter().position(|v| !v.is_finite()) {
                let field = Self::COLUMNS.get(column).copied().unwrap_or("f_rest");
                return Err(SplatError::NotFinite { field, index });
            }
        }
        let checked = match kind {
            Kind::Ply | Kind::YDown => Ok(()),
            Kind::Spz => spz::check(self),
            Kind::Glb => glb::check(self),
            Kind::Sog => sog::check(self),
        };
        Ok(checked.map_err(|problem| FileError::unsuitable(path, problem))?)
    }
}

/// Reads the Gaussians of a file onto `device`: [`Stored::read`], then [`Stored::load`].
///
/// # Errors
/// As [`Stored::read`].
pub fn read(path: &Path, device: &Device) -> Result<Loaded, SplatError> {
    Ok(Stored::read(path)?.load(device))
}

/// Writes `gaussians`: [`Stored::of`], then [`Stored::write`] with the kind of `path`'s extension.
///
/// # Errors
/// As [`Stored::of`] and [`Stored::write`]; `path` is then left as it was.
pub fn write(gaussians: &Gaussians, path: &Path) -> Result<(), SplatError> {
    Stored::of(gaussians)?.write(Kind::of(path), path)
}
