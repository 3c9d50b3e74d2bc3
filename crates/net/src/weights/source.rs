//! Reading tensors, one at a time, from `.safetensors` files and PyTorch checkpoints. No code of a pickle is executed.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use burn::tensor::{bf16, f16};
use pytorch_reader::{PickleError, PytorchError, PytorchReader};
use rayon::prelude::*;
use safetensors::Dtype;
use safetensors::tensor::Metadata;
use snapsnap_base::{FileError, file};

use super::WeightsError;
use crate::config::{Config, Precision, Schema};

/// Metadata key under which the config (TOML) is stored.
pub const CONFIG_KEY: &str = "snapsnap.config";

/// A checkpoint whose tensors can be read by name.
pub struct Source {
    path: PathBuf,
    tensors: BTreeMap<String, Entry>,
    reader: Reader,
    /// Text metadata of a `.safetensors` file.
    pub metadata: BTreeMap<String, String>,
}

/// Description of one tensor in the file.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Element type, named as in safetensors but in lower case (`f32`, `bf16`, `i64` …).
    pub dtype: String,
    /// Extents, outermost first.
    pub shape: Vec<usize>,
    /// First byte in a `.safetensors` file.
    start: u64,
    /// Bytes in a `.safetensors` file.
    len: usize,
}

enum Reader {
    Safetensors(File),
    /// A safetensors file in memory.
    Embedded(&'static [u8]),
    Pytorch(BTreeMap<String, pytorch_reader::Tensor>),
}

/// Largest `.safetensors` header accepted; the format's own limit.
const MAX_HEADER: u64 = 100_000_000;

impl Source {
    /// Opens a checkpoint; the kind is recognised by content, not by file name.
    ///
    /// # Errors
    /// [`WeightsError`] for a file that is missing, truncated, or neither of the two formats.
    pub fn open(path: &Path) -> Result<Self, WeightsError> {
        let read = FileError::read(path);
        let mut file = file::open(path).map_err(&read)?;
        let mut start = Vec::new();
        (&mut file).take(9).read_to_end(&mut start).map_err(&read)?;
        // A safetensors file starts with a little-endian header length and then JSON; every PyTorch container starts
        // with bytes that would make that length absurd.
        if let Some((length, b"{")) = start.split_first_chunk() {
            let header = u64::from_le_bytes(*length);
            if (1..=MAX_HEADER).contains(&header) {
                let size = file.metadata().map_err(&read)?.len();
                let mut text = vec![b'{'; 1];
                (&mut file).take(header - 1).read_to_end(&mut text).map_err(&read)?;
                return Self::described(path, &text, size, Reader::Safetensors(file));
            }
        }
        if path.extension().is_some_and(|e| e == "safetensors") {
            return Err(FileError::unsuitable(path, "not a safetensors file (no header)").into());
        }
        Self::pytorch(path)
    }

    /// A safetensors file that is part of the program; `name` stands for its path.
    ///
    /// # Errors
    /// [`WeightsError`] for other bytes.
    pub fn embedded(name: &str, bytes: &'static [u8]) -> Result<Self, WeightsError> {
        let path = Path::new(name);
        let Some((start, rest)) = bytes.split_first_chunk::<8>() else {
            return Err(FileError::unsuitable(path, "not a safetensors file (no header)").into());
        };
        let header = u64::from_le_bytes(*start);
        let text = &rest[..rest.len().min(usize::try_from(header).unwrap_or(usize::MAX))];
        Self::described(path, text, bytes.len() as u64, Reader::Embedded(bytes))
    }

    /// A safetensors file of `size` bytes with this header.
    fn described(path: &Path, text: &[u8], size: u64, reader: Reader) -> Result<Self, WeightsError> {
        let metadata: Metadata = serde_json::from_slice(text).map_err(|e| {
            FileError::unsuitable(path, format!("damaged or truncated safetensors header: {e}"))
        })?;
        let data = 8 + text.len() as u64;
        let expected = data + metadata.data_len() as u64;
        if size != expected {
            let message = format!("truncated or damaged: {size} bytes, the header promises {expected}");
            return Err(FileError::unsuitable(path, &message).into());
        }
        let tensors = metadata.tensors().into_iter().map(|(name, info)| {
            let (from, to) = info.data_offsets;
            let dtype = format!("{:?}", info.dtype).to_lowercase();
            (name, Entry { dtype, shape: info.shape.clone(), start: data + from as u64, len: to - from })
        });
        Ok(Self {
            path: path.to_owned(),
            tensors: unwrapped(tensors.collect()),
            reader,
            metadata: metadata.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect(),
        })
    }

    fn pytorch(path: &Path) -> Result<Self, WeightsError> {
        let all = PytorchReader::new(path)
            .map_err(|e| {
                let message = match &e {
                    PytorchError::Pickle(PickleError::UnexpectedOpCode(_)) => {
                        "holds a `defaultdict`, a `deque` or the like beside its weights, which is not read: load it in \
                         PyTorch and save the weights alone"
                            .into()
                    }
                    e => format!("neither safetensors nor a PyTorch checkpoint: {e}"),
                };
                FileError::unsuitable(path, message)
            })?
            .into_tensors();
        let reader = unwrapped(all.into_iter().collect());
        let entry = |(name, tensor): (&String, &pytorch_reader::Tensor)| {
            let dtype = format!("{:?}", tensor.dtype()).to_lowercase();
            (name.clone(), Entry { dtype, shape: tensor.shape().to_vec(), start: 0, len: tensor.byte_len() })
        };
        let (path, tensors) = (path.to_owned(), reader.iter().map(entry).collect());
        Ok(Self { path, tensors, reader: Reader::Pytorch(reader), metadata: BTreeMap::new() })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The config in the file's metadata.
    ///
    /// # Errors
    /// [`WeightsError`] if there is none, or if it is refused.
    pub(super) fn config(&self) -> Result<Config, WeightsError> {
        let text = self.metadata.get(CONFIG_KEY).ok_or_else(|| {
            let message = "has no config in its metadata; give one with --config, or import it first";
            FileError::unsuitable(&self.path, message)
        })?;
        Ok(Config::from_toml(text, &format!("{} (metadata {CONFIG_KEY})", self.path.display()), &[])?)
    }

    /// All tensors by name.
    pub fn tensors(&self) -> &BTreeMap<String, Entry> {
        &self.tensors
    }

    /// Reads one float tensor as f32 in row-major order; f16 and bf16 are widened.
    ///
    /// # Errors
    /// [`WeightsError`] if the file cannot be read or `name` is absent or of another type.
    pub fn read_f32(&self, name: &str) -> Result<Vec<f32>, WeightsError> {
        let entry = self
            .tensors
            .get(name)
            .ok_or_else(|| FileError::unsuitable(&self.path, format!("has no tensor `{name}`")))?;
        let kind = Precision::called(&entry.dtype).ok_or_else(|| {
            FileError::unsuitable(&self.path, format!("`{name}` is {}, not f32, f16 or bf16", entry.dtype))
        })?;
        let values = match &self.reader {
            Reader::Safetensors(file) => read_values(file, entry, kind),
            Reader::Embedded(bytes) => {
                let start = usize::try_from(entry.start).expect("checked against the size");
                Ok(kind.widened(&bytes[start..start + entry.len]))
            }
            Reader::Pytorch(tensors) => tensors[name].read().map(|bytes| kind.widened(&bytes)),
        };
        Ok(values.map_err(FileError::read(&self.path))?)
    }
}

/// Tensors by their names in the networks. The weights of Snap-Snap are below `network`, the weights of DUSt3R and CroCo
/// below `model`, beside optimiser states. PyTorch's wrappers of networks add parts to the names.
fn unwrapped<T>(mut tensors: BTreeMap<String, T>) -> BTreeMap<String, T> {
    const WRAPPERS: [&str; 4] = ["network.", "model.", "state_dict.", "model_state_dict."];
    while let Some(wrapper) = WRAPPERS.into_iter().find(|w| tensors.keys().any(|key| key.starts_with(w))) {
        let inner =
            tensors.into_iter().filter_map(|(key, t)| Some((key.strip_prefix(wrapper)?.to_owned(), t)));
        tensors = inner.collect();
    }
    let is_name = |part: &&str| !matches!(*part, "module" | "_orig_mod");
    let bare = |key: &str| key.split('.').filter(is_name).collect::<Vec<_>>().join(".");
    tensors.into_iter().map(|(key, tensor)| (bare(&key), tensor)).collect()
}

/// Numbers in files. f32 holds all of them without loss.
impl Precision {
    /// The type of this name; `None` for types whose tensors cannot become f32 without loss.
    pub(super) fn called(name: &str) -> Option<Self> {
        [Self::F32, Self::Bf16, Self::F16].into_iter().find(|one| one.name() == name)
    }

    /// Name in a safetensors file.
    pub(super) fn in_safetensors(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::F16 => Dtype::F16,
            Self::Bf16 => Dtype::BF16,
        }
    }

    /// The nearest numbers of this type, little-endian.
    pub(super) fn bytes(self, values: &[f32]) -> Vec<u8> {
        match self {
            Self::F32 => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
            Self::F16 => values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect(),
            Self::Bf16 => values.iter().flat_map(|v| bf16::from_f32(*v).to_le_bytes()).collect(),
        }
    }

    pub(super) fn widened(self, bytes: &[u8]) -> Vec<f32> {
        let mut values = vec![0.0; bytes.len() / self.size()];
        self.widen(bytes, &mut values);
        values
    }

    /// Bytes of a number.
    pub(super) fn size(self) -> usize {
        if self == Self::F32 { 4 } else { 2 }
    }

    fn widen(self, bytes: &[u8], values: &mut [f32]) {
        fn each<const N: usize>(bytes: &[u8], values: &mut [f32], number: impl Fn([u8; N]) -> f32) {
            values.iter_mut().zip(bytes.as_chunks().0).for_each(|(v, b)| *v = number(*b));
        }
        match self {
            Self::F32 => each(bytes, values, f32::from_le_bytes),
            Self::F16 => each(bytes, values, |b| f16::from_le_bytes(b).to_f32()),
            Self::Bf16 => each(bytes, values, |b| bf16::from_le_bytes(b).to_f32()),
        }
    }
}

/// Values that are read and widened at a time: few enough to stay in the second-level cache.
pub(super) const CHUNK: usize = 1 << 16;

/// The values of one tensor, read by all cores. The first touch of fresh memory takes most of the time, so each page
/// of the result is touched once, by the core that fills it.
fn read_values(file: &File, entry: &Entry, kind: Precision) -> io::Result<Vec<f32>> {
    let count = entry.len / kind.size();
    let mut values = vec![0.0_f32; count];
    values
        .par_chunks_mut(CHUNK)
        .enumerate()
        .map_init(Vec::new, |bytes, (chunk, values)| {
            bytes.resize(values.len() * kind.size(), 0);
            file::read_exact_at(file, bytes, entry.start + (chunk * CHUNK * kind.size()) as u64)?;
            kind.widen(bytes, values);
            Ok(())
        })
        .collect::<io::Result<()>>()?;
    Ok(values)
}
