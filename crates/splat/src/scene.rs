//! Files of Gaussians, PLY or SPZ: which of the two a file is is told by its first bytes when it is read, and by its name when
//! it is written.

use std::io::{self, Read, Write};
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};

use snapsnap_base::{FileError, file};

use crate::{Camera, Gaussians, SplatError, ply, sh, spz};

/// Opacities are stored as logits; f32 saturates to ±∞ at 0 and 1, so they are kept this far away from both.
const OPACITY_MARGIN: f32 = 1e-6;
/// Scales are stored as logarithms; a scale that underflowed to 0 is stored as this many metres.
const MIN_SCALE: f32 = 1e-10;

/// A file's Gaussians.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// After activation; colours are those of SH degree 0, max(0, ½ + C₀·f_dc).
    pub gaussians: Gaussians,
    /// Coefficients `[N,K,3]` for [`sh::colors`], where the file has a degree above 0.
    pub harmonics: Option<Tensor<3>>,
}

impl Loaded {
    /// The Gaussians in the colours that a camera sees.
    ///
    /// # Errors
    /// [`SplatError::Shape`] for coefficients of no degree.
    pub fn seen_by(&self, camera: &Camera) -> Result<Gaussians, SplatError> {
        let gaussians = self.gaussians.clone();
        match &self.harmonics {
            None => Ok(gaussians),
            Some(harmonics) => {
                Ok(Gaussians { colors: sh::colors(harmonics, &gaussians.means, camera)?, ..gaussians })
            }
        }
    }
}

impl From<Gaussians> for Loaded {
    fn from(gaussians: Gaussians) -> Self {
        Self { gaussians, harmonics: None }
    }
}

/// Kinds of files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// 3D Gaussian PLY in the layout of the INRIA viewer.
    Ply,
    /// Niantic's compressed splats.
    Spz,
}

impl Kind {
    /// The kind that `path`'s extension names, if it is one.
    pub fn named(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "ply" => Some(Self::Ply),
            "spz" => Some(Self::Spz),
            _ => None,
        }
    }

    /// What `path` is to be by its extension: SPZ for `.spz`, else PLY.
    pub fn of(path: &Path) -> Self {
        Self::named(path).unwrap_or(Self::Ply)
    }
}

/// Gaussians as files hold them, before activation, column by column: see [`Stored::COLUMNS`].
#[derive(Debug, Clone)]
pub struct Stored {
    /// SH coefficients per channel: 1, 4, 9 or 16.
    pub(crate) coefficients: usize,
    /// [`Stored::COLUMNS`], then `f_rest_0` …: all of red's, green's, blue's. Equally long.
    pub(crate) columns: Vec<Vec<f32>>,
}

impl Stored {
    /// What is always there: centres in metres, quaternions (w, x, y, z), logarithms of standard deviations in metres, logits
    /// of opacities, and the coefficients of SH degree 0.
    pub const COLUMNS: [&str; 14] = [
        "x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity",
        "f_dc_0", "f_dc_1", "f_dc_2",
    ];

    /// As a file would have them: colours as `(rgb − ½) / `[`sh::C0`].
    ///
    /// # Errors
    /// [`SplatError::NotFinite`] for a NaN or an infinity in the tensors.
    pub fn of(gaussians: &Gaussians) -> Result<Self, SplatError> {
        let opacities = gaussians.opacities.clone().unsqueeze_dim::<2>(1);
        let mut all = columns(&gaussians.means, "means", |v| v)?;
        all.append(&mut columns(&gaussians.rotations, "rotations", |v| v)?);
        all.append(&mut columns(&gaussians.scales, "scales", |v| v.max(MIN_SCALE).ln())?);
        all.append(&mut columns(&opacities, "opacities", logit)?);
        all.append(&mut columns(&gaussians.colors, "colors", |v| (v - 0.5) / sh::C0)?);
        Ok(Self { coefficients: 1, columns: all })
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.columns[0].len()
    }

    /// Whether there is no Gaussian at all.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// SH degree, 0 to 3.
    pub fn degree(&self) -> usize {
        self.coefficients.isqrt() - 1
    }

    /// The coefficient that band `band` (0 to [`Self::coefficients`] − 1) has of a channel: a column.
    pub(crate) fn band(&self, band: usize, channel: usize) -> &[f32] {
        match band {
            0 => &self.columns[11 + channel],
            band => &self.columns[Self::COLUMNS.len() + channel * (self.coefficients - 1) + band - 1],
        }
    }

    /// Drops every Gaussian that has a value that is not finite; returns how many there were.
    pub fn drop_not_finite(&mut self) -> usize {
        let whole = |i: usize| self.columns.iter().all(|column| column[i].is_finite());
        let kept: Vec<bool> = (0..self.len()).map(whole).collect();
        let dropped = kept.iter().filter(|kept| !**kept).count();
        if dropped > 0 {
            for column in &mut self.columns {
                let mut kept = kept.iter();
                column.retain(|_| *kept.next().expect("as long as the columns"));
            }
        }
        dropped
    }

    /// Puts them onto `device`. Values that are not finite are kept, a render counts and leaves them out.
    pub fn load(&self, device: &Device) -> Loaded {
        let (n, k) = (self.len(), self.coefficients);
        let rows = |count: usize, first: usize, f: fn(f32) -> f32| {
            let all = (0..n).flat_map(|i| (first..first + count).map(move |c| (c, i)));
            let values: Vec<f32> = all.map(|(c, i)| f(self.columns[c][i])).collect();
            Tensor::<2>::from_data(TensorData::new(values, [n, count]), device)
        };
        let gaussians = Gaussians {
            means: rows(3, 0, |v| v),
            rotations: rows(4, 3, |v| v),
            scales: rows(3, 7, f32::exp),
            opacities: rows(1, 10, |v| 1.0 / (1.0 + (-v).exp())).squeeze_dim(1),
            colors: rows(3, 11, |v| {
                let color = 0.5 + sh::C0 * v;
                // Not `max`: it would turn a NaN into black.
                if color < 0.0 && color.is_finite() { 0.0 } else { color }
            }),
        };
        let harmonics = (k > 1).then(|| {
            let bands = |i: usize| (0..k).flat_map(move |band| (0..3).map(move |c| (i, band, c)));
            let values: Vec<f32> =
                (0..n).flat_map(bands).map(|(i, band, channel)| self.band(band, channel)[i]).collect();
            Tensor::<3>::from_data(TensorData::new(values, [n, k, 3]), device)
        });
        Loaded { gaussians, harmonics }
    }

    /// Reads a file of either kind.
    ///
    /// # Errors
    /// [`SplatError::File`] if it cannot be read, is of neither kind, is cut short, or lacks something.
    pub fn read(path: &Path) -> Result<Self, SplatError> {
        let cannot = FileError::read(path);
        let mut file = file::open(path).map_err(&cannot)?;
        let mut start = [0; 2];
        let length = fill(&mut file, &mut start).map_err(&cannot)?;
        let whole = start[..length].chain(file);
        let read = match start {
            spz::GZIP => spz::read(whole),
            spz::BARE => Err("SPZ of version 4 or later; 1 to 3 are read".to_owned().into()),
            _ => ply::read(whole),
        };
        let read = read.map_err(|problem| match problem {
            Problem::Io(source) => cannot(source),
            Problem::Content(problem) => FileError::unsuitable(path, problem),
        });
        Ok(read?)
    }

    /// Writes the kind of file that `path`'s extension says, whole or not at all.
    ///
    /// # Errors
    /// [`SplatError::NotFinite`]; [`SplatError::File`] for values that an SPZ cannot hold, or if the file cannot be written.
    /// `path` is then left as it was.
    pub fn write(&self, path: &Path) -> Result<(), SplatError> {
        let kind = Kind::of(path);
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

    /// What a file of this kind would hold less well than its steps let expect: a sentence each.
    pub fn losses(&self, kind: Kind) -> Vec<String> {
        match kind {
            Kind::Ply => Vec::new(),
            Kind::Spz => spz::losses(self),
        }
    }

    fn encode(&self, kind: Kind, out: &mut impl Write) -> io::Result<()> {
        match kind {
            Kind::Ply => ply::write(self, out),
            Kind::Spz => spz::write(self, out),
        }
    }

    fn check(&self, kind: Kind, path: &Path) -> Result<(), SplatError> {
        for (column, values) in self.columns.iter().enumerate() {
            if let Some(index) = values.iter().position(|v| !v.is_finite()) {
                let field = Self::COLUMNS.get(column).copied().unwrap_or("f_rest");
                return Err(SplatError::NotFinite { field, index });
            }
        }
        match kind {
            Kind::Ply => Ok(()),
            Kind::Spz => Ok(spz::check(self).map_err(|problem| FileError::unsuitable(path, problem))?),
        }
    }
}

/// Reads the Gaussians of a PLY or SPZ onto `device`; as [`Stored::read`] and [`Stored::load`].
///
/// # Errors
/// Those of [`Stored::read`].
pub fn read(path: &Path, device: &Device) -> Result<Loaded, SplatError> {
    Ok(Stored::read(path)?.load(device))
}

/// Writes `gaussians` as [`Stored::of`] and [`Stored::write`] do.
///
/// # Errors
/// Theirs; `path` is then left as it was.
pub fn write(gaussians: &Gaussians, path: &Path) -> Result<(), SplatError> {
    Stored::of(gaussians)?.write(path)
}

/// What keeps a file from being read.
pub(crate) enum Problem {
    Io(io::Error),
    Content(String),
}

impl From<io::Error> for Problem {
    fn from(e: io::Error) -> Self {
        Self::Io(e)
    }
}

impl From<String> for Problem {
    fn from(problem: String) -> Self {
        Self::Content(problem)
    }
}

/// Reads until `buffer` is full or the input ends; returns how much there was.
fn fill(input: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    let mut length = 0;
    while length < buffer.len() {
        match input.read(&mut buffer[length..]) {
            Ok(0) => break,
            Ok(n) => length += n,
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(length)
}

fn logit(opacity: f32) -> f32 {
    let opacity = opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    (opacity / (1.0 - opacity)).ln()
}

fn columns(tensor: &Tensor<2>, field: &'static str, f: fn(f32) -> f32) -> Result<Vec<Vec<f32>>, SplatError> {
    let width = tensor.dims()[1];
    let values: Vec<f32> =
        tensor.to_data().convert::<f32>().try_into_vec().expect("converted to f32 on this very line");
    if let Some(at) = values.iter().position(|v| !v.is_finite()) {
        return Err(SplatError::NotFinite { field, index: at / width });
    }
    Ok((0..width).map(|c| values.iter().skip(c).step_by(width).map(|&v| f(v)).collect()).collect())
}
