//! Gaussians as files store them: before activation, column by column.

use std::io;
use std::ops::RangeInclusive;

use burn::tensor::{Device, Tensor, TensorData};

use crate::{Camera, Gaussians, SplatError, sh};

/// Least distance of a stored opacity from 0 and from 1, whose logits are infinite.
const OPACITY_MARGIN: f32 = 1e-6;
/// Lengths of quaternions that a render normalises; others have no rotation, or are no numbers.
const DRAWN_ROTATIONS: RangeInclusive<f64> = 1e-5..=1e17;
/// Least scale that is stored, metres: the logarithm of a scale that underflowed to 0 is infinite.
pub(crate) const MIN_SCALE: f32 = 1e-10;

/// Numbers of SH coefficients per channel up to degree 0, 1, 2 and 3.
pub(crate) const COEFFICIENTS: [usize; 4] = [1, 4, 9, 16];

/// The Gaussians of a file on a device.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// After activation, with the colours of SH degree 0: max(0, ½ + C₀·f_dc).
    pub gaussians: Gaussians,
    /// Coefficients `[N,K,3]` for [`sh::colors`], if the file has an SH degree above 0.
    pub harmonics: Option<Tensor<3>>,
}

impl Loaded {
    /// The Gaussians with their colours for a camera.
    ///
    /// # Errors
    /// [`SplatError::Shape`] if the number of coefficients belongs to no SH degree.
    pub fn seen_by(&self, camera: &Camera) -> Result<Gaussians, SplatError> {
        let mut gaussians = self.gaussians.clone();
        if let Some(harmonics) = &self.harmonics {
            gaussians.colors = sh::colors(harmonics, &gaussians.means, camera)?;
        }
        Ok(gaussians)
    }
}

impl From<Gaussians> for Loaded {
    fn from(gaussians: Gaussians) -> Self {
        Self { gaussians, harmonics: None }
    }
}

/// Gaussians before activation, column by column: see [`Stored::COLUMNS`].
#[derive(Debug, Clone)]
pub struct Stored {
    /// SH coefficients per channel: 1, 4, 9 or 16.
    pub(crate) coefficients: usize,
    /// [`Stored::COLUMNS`], then `f_rest_0` …: red's coefficients, then green's, then blue's. All equally long.
    pub(crate) columns: Vec<Vec<f32>>,
}

impl Stored {
    /// Columns that every file has: centres in metres, quaternions (w, x, y, z), logarithms of standard deviations in
    /// metres, logits of opacities, and the coefficients of SH degree 0.
    pub const COLUMNS: [&str; 14] = [
        "x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity",
        "f_dc_0", "f_dc_1", "f_dc_2",
    ];

    /// The values that a file of `gaussians` stores: colours as `(rgb − ½) / `[`sh::C0`].
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

    /// The column of SH coefficient `band` (0 to [`Self::coefficients`] − 1) of a channel.
    pub(crate) fn band(&self, band: usize, channel: usize) -> &[f32] {
        match band {
            0 => &self.columns[11 + channel],
            band => &self.columns[Self::COLUMNS.len() + channel * (self.coefficients - 1) + band - 1],
        }
    }

    /// Turns the Gaussians by 180° about the x axis, from y up to y down, or `back` in the opposite sense. Nothing is
    /// rounded.
    pub(crate) fn turn(&mut self, back: bool) {
        // For each SH basis function: whether its exponents of y and z have an odd sum. The turn negates it then.
        const REVERSED: [bool; 16] = [
            false, true, true, false, true, false, false, true, false, true, false, true, true, false, true,
            false,
        ];
        let negate = |column: &mut Vec<f32>| column.iter_mut().for_each(|value| *value = -*value);
        self.columns[1..3].iter_mut().for_each(negate);
        // The quaternion of the turn, i, times (w, x, y, z) is (−x, w, −z, y); −i gives (x, −w, z, −y).
        self.columns.swap(3, 4);
        self.columns.swap(5, 6);
        [3, 5].into_iter().for_each(|column| negate(&mut self.columns[column + usize::from(back)]));
        let rest = self.coefficients - 1;
        for (at, column) in self.columns[Self::COLUMNS.len()..].iter_mut().enumerate() {
            if REVERSED[1 + at % rest.max(1)] {
                negate(column);
            }
        }
    }

    /// Makes drawable what other programs' files have: logits of the opacities 0 and 1 and logarithms of the scale 0
    /// become those that [`Self::of`] stores, and quaternions that a render takes for damage get the length 1.
    pub(crate) fn limit(&mut self) {
        // Infinite sizes stay.
        let scales = self.columns[7..10].iter_mut().flatten().filter(|log| **log == f32::NEG_INFINITY);
        scales.for_each(|log| *log = MIN_SCALE.ln());
        for value in self.columns[10].iter_mut().filter(|value| value.is_infinite()) {
            *value = logit(if *value > 0.0 { 1.0 } else { 0.0 });
        }
        for i in 0..self.len() {
            let q = [3, 4, 5, 6].map(|column| self.columns[column][i]);
            let length = length(q);
            if length > 0.0 && !DRAWN_ROTATIONS.contains(&length) {
                unit(q).into_iter().enumerate().for_each(|(at, value)| self.columns[3 + at][i] = value);
            }
        }
    }

    /// Drops every Gaussian that cannot be drawn: with a value that is not finite, or a quaternion of length 0. Returns
    /// the number of dropped Gaussians.
    pub fn drop_undrawable(&mut self) -> usize {
        let whole = |i: usize| {
            self.columns.iter().all(|column| column[i].is_finite())
                && (3..7).any(|column| self.columns[column][i] != 0.0)
        };
        let kept: Vec<bool> = (0..self.len()).map(whole).collect();
        for column in &mut self.columns {
            let mut kept = kept.iter();
            column.retain(|_| *kept.next().expect("as long as the columns"));
        }
        kept.len() - self.len()
    }

    /// Activates the Gaussians and uploads them to `device`. Values that are not finite are kept; a render culls them.
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
            opacities: rows(1, 10, opacity).squeeze_dim(1),
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
}

/// Reason why a file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    /// A failing disk.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// A fault of the content, without the file's name.
    #[error("{0}")]
    Content(String),
}

impl From<String> for Problem {
    fn from(problem: String) -> Self {
        Self::Content(problem)
    }
}

/// A compressed file is refused if its content exceeds both limits, in bytes and relative to the file: a few kilobytes
/// of equal Gaussians keep a rasteriser busy for minutes. Real files decompress to up to 5 times their size.
const MAX_CONTENT: u64 = 1 << 20;
const MAX_RATIO: u64 = 100;

/// Refuses `n` Gaussians with `content` decompressed bytes in a file of `length` bytes.
pub(crate) fn check_ratio(n: usize, content: u64, length: u64) -> Result<(), Problem> {
    if content <= MAX_CONTENT || content / MAX_RATIO <= length {
        return Ok(());
    }
    let ratio = content / length.max(1);
    let message = format!(
        "{n} Gaussians in {length} bytes: the content is {ratio} times as large as the file, which no real scene reaches"
    );
    Err(message.into())
}

fn length(q: [f32; 4]) -> f64 {
    q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt()
}

/// A quaternion (w, x, y, z), normalised. A quaternion of length 0 becomes the identity.
pub(crate) fn unit(q: [f32; 4]) -> [f32; 4] {
    let length = length(q);
    if length > 0.0 { q.map(|v| (f64::from(v) / length) as f32) } else { [1.0, 0.0, 0.0, 0.0] }
}

/// A quaternion (w, x, y, z) without its largest component, from the places of the others in the range of ±√½.
pub(crate) fn smallest_three(largest: usize, places: [f32; 3]) -> [f32; 4] {
    let mut q = [0.0_f32; 4];
    for (i, place) in (0..4).filter(|i| *i != largest).zip(places) {
        q[i] = (place - 0.5) * std::f32::consts::SQRT_2;
    }
    q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    q
}

/// The opacity of a logit.
pub(crate) fn opacity(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// The logit of an opacity, limited by [`OPACITY_MARGIN`].
pub(crate) fn logit(opacity: f32) -> f32 {
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
