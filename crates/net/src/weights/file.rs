//! The weight file: writing it tensor by tensor, and opening it.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::io::{self, Write};
use std::path::Path;

use rayon::prelude::*;
use safetensors::tensor::{Metadata, TensorInfo};
use snapsnap_base::FileError;
use snapsnap_base::config::{differences, keys};
use snapsnap_base::file::write_whole;

use super::WeightsError;
use super::schema::{self, Part, TensorSpec};
use super::source::{CHUNK, CONFIG_KEY, Entry, Source};
use crate::config::{Config, Precision, Schema};

/// Called with the number of bytes written and their total.
pub type Progress<'a> = &'a dyn Fn(u64, u64);

/// Largest number of keys that a message names.
const MAX_DIFFERENCES: usize = 3;
/// Keys that change the meaning of the point predictor's tensors, but not the set of tensors.
const POINTS: [&str; 8] = [
    "network.anchor",
    "network.conf_mode",
    "network.dec_heads",
    "network.enc_heads",
    "network.fusion",
    "network.hooks",
    "network.mirror",
    "network.pair_degrees",
];
/// Keys that change the meaning of the regressor's tensors.
const GAUSSIANS: [&str; 2] = ["mode.rotation_frame", "regressor.start"];

/// Writes `tensors` in order. `values` returns one tensor at a time, so that only one is in memory. If values are not
/// finite, the error names all their tensors and `origin`, and no file is written.
pub(super) fn write(
    path: &Path,
    origin: &str,
    config: &Config,
    tensors: &[TensorSpec],
    float: Precision,
    mut values: impl FnMut(&TensorSpec) -> Result<Vec<f32>, WeightsError>,
    progress: Progress,
) -> Result<(), WeightsError> {
    let infos = tensors.iter().map(|t| (t.name.clone(), t.shape.clone()));
    // One entry only: the header lists metadata in no fixed order, and the same seed must give the same bytes.
    let metadata = HashMap::from([(CONFIG_KEY.into(), config.to_toml())]);
    write_tensors(path, origin, metadata, infos.collect(), float, |i| values(&tensors[i]), progress)
}

/// Writes tensors, by names and shapes, in order; `values` returns one at a time. They are rounded to the type `float`.
/// The order of `metadata` in the file is not fixed.
///
/// # Errors
/// [`WeightsError`] of `values`, for values that are not finite (with the name `origin`), or if the file cannot be
/// written. The former file then stays.
pub fn write_tensors(
    path: &Path,
    origin: &str,
    metadata: HashMap<String, String>,
    tensors: Vec<(String, Vec<usize>)>,
    float: Precision,
    mut values: impl FnMut(usize) -> Result<Vec<f32>, WeightsError>,
    progress: Progress,
) -> Result<(), WeightsError> {
    let names: Vec<String> = tensors.iter().map(|(name, _)| name.clone()).collect();
    let mut at = 0;
    let infos = tensors.into_iter().map(|(name, shape)| {
        let from = at;
        at += shape.iter().product::<usize>() * float.size();
        (name, TensorInfo { dtype: float.in_safetensors(), shape, data_offsets: (from, at) })
    });
    let header = Metadata::new(Some(metadata), infos.collect()).expect("consecutive, exactly sized tensors");
    let mut header = serde_json::to_vec(&header).expect("the header has only JSON types");
    // The format requires data aligned to 8 bytes and allows spaces for that.
    header.resize(header.len().next_multiple_of(8), b' ');

    // Errors of weights pass through `write_whole` as errors of the operating system.
    write_whole(path, |out| {
        out.write_all(&(header.len() as u64).to_le_bytes())?;
        out.write_all(&header)?;
        let mut written = 0;
        let mut problems = Vec::new();
        for (i, name) in names.iter().enumerate() {
            let values = values(i).map_err(io::Error::other)?;
            let bytes = float.bytes(&values);
            // Finite values beyond the range of 16 bits are infinite now.
            let beyond = || {
                Some(format!("beyond the range of 16 bits, {}", not_finite(name, &float.widened(&bytes))?))
            };
            problems.extend(not_finite(name, &values).or_else(beyond));
            out.write_all(&bytes)?;
            written += bytes.len();
            progress(written as u64, at as u64);
        }
        if problems.is_empty() {
            return Ok(());
        }
        Err(io::Error::other(WeightsError::Tensors { origin: origin.to_owned(), problems }))
    })
    .map_err(|e| e.downcast::<WeightsError>().unwrap_or_else(|e| FileError::write(path)(e).into()))
}

/// Writes the values of parameters, with the names and layouts of checkpoints, as a weight file of `config`. Values
/// of only one part make a file of that part.
///
/// # Errors
/// [`WeightsError::File`], or [`WeightsError::Tensors`] for values that are not finite.
///
/// # Panics
/// If a tensor of a present part is missing or has another size.
pub fn save(config: &Config, values: &BTreeMap<String, Vec<f32>>, path: &Path) -> Result<(), WeightsError> {
    let parts = parts_of(values.keys());
    let tensors: Vec<_> = schema::tensors(config).into_iter().filter(|t| parts.contains(&t.part)).collect();
    let read = |spec: &TensorSpec| {
        let values = &values[&spec.name];
        assert_eq!(values.len(), spec.elements(), "{}", spec.name);
        Ok(values.clone())
    };
    write(path, &path.display().to_string(), config, &tensors, Precision::F32, read, &|_, _| ())
}

/// A line for a tensor with values that are not finite.
pub fn not_finite(name: &str, values: &[f32]) -> Option<String> {
    let bad =
        values.par_chunks(CHUNK).map(|part| part.iter().filter(|v| !v.is_finite()).count()).sum::<usize>();
    (bad > 0).then(|| format!("not finite: {name} ({bad} of {} values)", values.len()))
}

/// An opened weight file whose tensors fit its config.
pub struct WeightFile {
    pub(super) source: Source,
    /// The config that the tensors fit.
    pub config: Config,
}

impl WeightFile {
    /// Opens `path` and checks every tensor's presence, shape and type against `config`, or, without one, against the
    /// config in the file's metadata. Values are checked when they are read.
    ///
    /// # Errors
    /// [`WeightsError`], naming every tensor that is missing, unused, mis-shaped or of the wrong type.
    pub fn open(path: &Path, config: Option<Config>) -> Result<Self, WeightsError> {
        Self::checked(Source::open(path)?, config)
    }

    /// Opens a safetensors file that is part of the program; `name` stands for its path.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn embedded(name: &str, bytes: &'static [u8], config: Option<Config>) -> Result<Self, WeightsError> {
        Self::checked(Source::embedded(name, bytes)?, config)
    }

    fn checked(source: Source, config: Option<Config>) -> Result<Self, WeightsError> {
        let path = source.path();
        let config = config.map_or_else(|| source.config(), Ok)?;
        let mut problems = Vec::new();
        let parts = parts_of(source.tensors().keys());
        let expected: Vec<_> =
            schema::tensors(&config).into_iter().filter(|t| parts.contains(&t.part)).collect();
        for spec in &expected {
            match source.tensors().get(&spec.name) {
                None => problems.push(format!("missing: {} {:?}", spec.name, spec.shape)),
                Some(entry) => problems.extend(mismatch(spec, entry, path)),
            }
        }
        let names: BTreeSet<_> = expected.iter().map(|t| t.name.as_str()).collect();
        let unused = source.tensors().keys().filter(|k| !names.contains(k.as_str()));
        problems.extend(unused.map(|k| format!("not part of the configured networks: {}", k.escape_debug())));
        if problems.is_empty() {
            return Ok(Self { source, config });
        }
        // If the file's own config differs, its keys say more than the tensors.
        let own = source.config().map(|own| differences(&keys(&own), &keys(&config))).unwrap_or_default();
        // `mode` changes no tensor.
        let own: Vec<_> = own.into_iter().filter(|(key, _)| !key.starts_with("mode.")).collect();
        if !own.is_empty() {
            return Err(of_others(path, own));
        }
        Err(WeightsError::Tensors { origin: path.display().to_string(), problems })
    }

    /// Refuses weights whose file contains a config in which the tensors of this part mean something else, such as
    /// points without the anchors of this config. A file without a config or without this part passes.
    ///
    /// # Errors
    /// [`WeightsError::File`] that names the keys.
    pub fn require_meaning(&self, part: Part) -> Result<(), WeightsError> {
        let (Ok(own), Ok(())) = (self.source.config(), self.require(part)) else { return Ok(()) };
        let mut differing = differences(&keys(&own.resolved()), &keys(&self.config.resolved()));
        differing.retain(|(key, _)| match part {
            Part::PointPredictor => POINTS.contains(&key.as_str()),
            Part::Regressor => GAUSSIANS.contains(&key.as_str()),
        });
        if differing.is_empty() {
            return Ok(());
        }
        differing.truncate(MAX_DIFFERENCES - 1);
        differing.push((String::new(), "`import-weights --set` writes such a file for other keys".into()));
        Err(of_others(self.path(), differing))
    }

    /// Reads every tensor, one at a time.
    ///
    /// # Errors
    /// [`WeightsError`] if a read fails or a value is not finite.
    pub fn check_values(&self) -> Result<(), WeightsError> {
        let mut problems = Vec::new();
        for name in self.source.tensors().keys() {
            problems.extend(not_finite(name, &self.source.read_f32(name)?));
        }
        match problems.is_empty() {
            true => Ok(()),
            false => Err(WeightsError::Tensors { origin: self.path().display().to_string(), problems }),
        }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.source.path()
    }

    /// Number of parameters.
    pub fn parameters(&self) -> u64 {
        let elements = |entry: &Entry| entry.shape.iter().map(|side| *side as u64).product::<u64>();
        self.source.tensors().values().map(elements).sum()
    }

    /// Refuses a file that lacks one of the parts.
    ///
    /// # Errors
    /// [`WeightsError::File`], saying which checkpoint to import as well.
    pub fn require(&self, part: Part) -> Result<(), WeightsError> {
        let parts = parts_of(self.source.tensors().keys());
        if parts.contains(&part) {
            return Ok(());
        }
        let (name, keys, stage) = match part {
            Part::PointPredictor => ("point predictor", "`dust3r.*`, `unet.*`", 1),
            Part::Regressor => ("Gaussian regressor", "`pred_unet.*`, `gs_conv.*`", 2),
        };
        let message = format!("has no {name} ({keys}): import a stage-{stage} checkpoint as well");
        Err(FileError::unsuitable(self.path(), message).into())
    }
}

/// The error for weights with these differences from the config.
fn of_others(path: &Path, differences: Vec<(String, String)>) -> WeightsError {
    let shown: Vec<String> =
        differences.into_iter().take(MAX_DIFFERENCES).map(|(_, message)| message).collect();
    let message = format!("not the weights of the configured networks: {}", shown.join(", "));
    FileError::unsuitable(path, message).into()
}

/// The parts that a set of keys belongs to.
pub(super) fn parts_of<'a>(keys: impl Iterator<Item = &'a String>) -> HashSet<Part> {
    let is_regressors = |key: &str| {
        ["pred_unet.", "gs_conv."].iter().any(|p| key.trim_start_matches(schema::SIDE).starts_with(p))
    };
    keys.map(|key| if is_regressors(key) { Part::Regressor } else { Part::PointPredictor }).collect()
}

/// A line for a tensor of the wrong shape or type.
pub(super) fn mismatch(spec: &TensorSpec, entry: &Entry, path: &Path) -> Option<String> {
    let (name, file, Entry { dtype, shape: found, .. }) = (&spec.name, path.display(), entry);
    if Precision::called(dtype).is_none() {
        return Some(format!("wrong type: {name} is {dtype} in {file}, must be f32, f16 or bf16"));
    }
    (*found != spec.shape)
        .then(|| format!("wrong shape: {name} is {found:?} in {file}, the config asks for {:?}", spec.shape))
}
