//! Importing the authors' checkpoints, strictly: every tensor is accounted for by name, or nothing is written. And our
//! weight file back in the authors' layout.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::slice;

use super::WeightsError;
use super::file::{Progress, WeightFile, mismatch, parts_of, write, write_tensors};
use super::init::draw;
use super::schema::{self, DETAILS, DUST3R, Part, SCALE, SIDE, TensorSpec, UNET};
use super::source::{CONFIG_KEY, Source};
use crate::config::{Config, Precision};

/// Choices an import leaves to the user.
#[derive(Debug, Clone, Copy)]
pub struct ImportOptions<'a> {
    /// A checkpoint that gives the tensors which are in none of the others.
    pub fill: Option<&'a Path>,
    /// Seed of random values.
    pub seed: u64,
    /// Float type of the written file.
    pub float: Precision,
}

/// The config in the metadata of weight files: `[regressor]`, `mode.rotation_frame` and `mode.crop` of the first file
/// with a config and a regressor, the rest of the first file with a config and a point predictor. If there is no such
/// file, the first config counts. `None` if no file has a config.
///
/// # Errors
/// [`WeightsError`] for a file that is no checkpoint, or whose config is refused.
pub fn stored_config<'a>(paths: impl Iterator<Item = &'a Path>) -> Result<Option<Config>, WeightsError> {
    let sources = paths.map(Source::open).collect::<Result<Vec<_>, _>>()?;
    let stored: Vec<_> = sources.iter().filter(|source| source.metadata.contains_key(CONFIG_KEY)).collect();
    let of = |part: Part| {
        let has = |source: &&&Source| parts_of(source.tensors().keys()).contains(&part);
        stored.iter().find(has).or(stored.first())
    };
    let (Some(points), Some(gaussians)) = (of(Part::PointPredictor), of(Part::Regressor)) else {
        return Ok(None);
    };
    let (mut config, gaussians) = (points.config()?, gaussians.config()?);
    // Keys stay unset where that means the same.
    if config.rotation_frame() != gaussians.rotation_frame() {
        config.mode.rotation_frame = Some(gaussians.rotation_frame());
    }
    if config.crop() != gaussians.crop() {
        config.mode.crop = Some(gaussians.crop());
    }
    Ok(Some(Config { regressor: gaussians.regressor, ..config }))
}

/// Report of an import.
#[derive(Debug, Default)]
pub struct ImportReport {
    /// Tensors written.
    pub tensors: usize,
    /// Parameters written.
    pub parameters: usize,
    /// Everything that was not a plain copy, one line each.
    pub notes: Vec<String>,
}

/// A file and a key in it.
type Place<'a> = (&'a Source, String);

/// The second name under which PyTorch lists a `layerN_rn` convolution (docs/method.md, "Weight files").
fn alias_of(name: &str) -> Option<String> {
    let (head, digit) = name.strip_suffix("_rn.weight")?.rsplit_once("scratch.layer")?;
    let n: usize = digit.parse().ok()?;
    Some(format!("{head}scratch.layer_rn.{}.weight", n - 1))
}

/// The name in a weight file for a key of the authors' files: prefix added, alias replaced.
fn canonical(key: &str) -> String {
    let bare = key.strip_prefix(DUST3R).unwrap_or(key);
    if bare == SCALE || ["pred_unet.", "gs_conv.", SIDE, UNET, DETAILS].iter().any(|p| bare.starts_with(p)) {
        return bare.to_owned();
    }
    if let Some((head, tail)) = bare.split_once("scratch.layer_rn.")
        && let Some(n) = tail.strip_suffix(".weight").and_then(|n| n.parse::<usize>().ok())
    {
        return format!("{DUST3R}{head}scratch.layer{}_rn.weight", n + 1);
    }
    format!("{DUST3R}{bare}")
}

/// Reads checkpoints of the authors, DUSt3R or CroCo, checks every tensor against `config` and writes one weight file.
///
/// Each of the two parts (point predictor, regressor) must be complete or wholly absent, except that files without δ,
/// without side heads or without any heads (DUSt3R's, CroCo's) get these from the config and the seed. Without
/// `network.side_heads`, tensors of the unseen sides are left out. Tensors of `from` win over `options.fill`.
///
/// # Errors
/// [`WeightsError`]; `to` is then left as it was.
pub fn import(
    from: &[PathBuf],
    config: &Config,
    options: ImportOptions,
    to: &Path,
    progress: Progress,
) -> Result<ImportReport, WeightsError> {
    let sources = from.iter().map(|path| Source::open(path)).collect::<Result<Vec<_>, _>>()?;
    let fill = options.fill.map(Source::open).transpose()?;
    let paths = from.iter().map(PathBuf::as_path).chain(options.fill);
    let origin = paths.map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ");
    let mut report = ImportReport::default();
    let mut problems = Vec::new();
    let mut found = collect(&sources, &mut problems, &mut report)?;
    copy_decoder(&mut found, &mut report);
    // DUSt3R's files lack δ and the side heads, CroCo's files all heads. Snap-Snap's files are complete, or damaged.
    let lacks_heads = !found.contains_key(SCALE);
    if let Some(fill) = &fill {
        let others = collect(slice::from_ref(fill), &mut problems, &mut report)?;
        for (name, place) in others {
            found.entry(name).or_insert(place);
        }
    }
    if !config.network.side_heads {
        let all = found.len();
        found.retain(|name, _| !is_of_sides(name));
        if found.len() < all {
            let count = all - found.len();
            let why = "`network.side_heads` is false";
            report.notes.push(format!("{count} tensors of the unseen sides are left out: {why}"));
        }
    }
    let parts = parts_of(found.keys());
    let specs: Vec<_> = schema::tensors(config).into_iter().filter(|t| parts.contains(&t.part)).collect();
    if specs.is_empty() {
        problems.push("no tensor of a point predictor or a regressor".into());
    }
    if let Some(fill) = &fill {
        let count = found.values().filter(|(source, _)| std::ptr::eq(*source, fill)).count();
        let path = fill.path().display();
        report.notes.push(format!("{count} tensors are in none of the others: from {path}"));
    }
    let plan = plan(&specs, found, (options.seed, lacks_heads), &mut problems, &mut report);
    if !problems.is_empty() {
        return Err(WeightsError::Tensors { origin, problems });
    }

    let mut next = plan.iter();
    let values = |spec: &TensorSpec| match next.next().expect("one entry per tensor") {
        None => Ok(draw(spec, options.seed)),
        Some((source, key)) => source.read_f32(key),
    };
    write(to, &origin, config, &specs, options.float, values, progress)?;
    report.tensors = specs.len();
    report.parameters = specs.iter().map(TensorSpec::elements).sum();
    Ok(report)
}

/// Whether the tensor belongs to the unseen sides alone.
fn is_of_sides(name: &str) -> bool {
    let of_unet = |tail: &str| tail.starts_with("side_") || tail.starts_with("completion.");
    name.starts_with(SIDE)
        || [3, 4].iter().any(|k| name.starts_with(&head(*k)))
        || name.strip_prefix(UNET).is_some_and(of_unet)
}

/// The key of head `k`'s tensors up to their own names.
fn head(k: usize) -> String {
    format!("{DUST3R}downstream_head{k}.")
}

/// The place of each tensor of `specs`, in order; `None` for tensors that are drawn. Tensors without an origin and
/// unused keys are problems.
fn plan<'a>(
    specs: &[TensorSpec],
    mut found: Found<'a>,
    (seed, lacks_heads): (u64, bool),
    problems: &mut Vec<String>,
    report: &mut ImportReport,
) -> Vec<Option<Place<'a>>> {
    let wanted = |k: &usize| specs.iter().any(|spec| spec.name.starts_with(&head(*k)));
    let given = |k: &usize| found.keys().any(|key| key.starts_with(&head(*k)));
    let absent: Vec<usize> = (1..=4).filter(|k| lacks_heads && wanted(k) && !given(k)).collect();
    for k in &absent {
        report.notes.push(format!("head {k} is in no file: drawn from seed {seed}"));
    }

    let place = |spec: &TensorSpec| {
        let of_absent_head = absent.iter().find(|k| spec.name.starts_with(&head(**k)));
        match (found.remove(&spec.name), of_absent_head) {
            (Some((source, key)), _) => {
                problems.extend(mismatch(spec, &source.tensors()[&key], source.path()));
                Some((source, key))
            }
            (None, Some(_)) => None,
            (None, None) if spec.name == SCALE => {
                report.notes.push("δ (`scale`) is in no file: `network.delta` of the config".into());
                None
            }
            (None, None) => {
                problems.push(format!("missing: {} {:?}", spec.name, spec.shape));
                None
            }
        }
    };
    let plan = specs.iter().map(place).collect();
    for (name, (source, _)) in &found {
        let name = name.escape_debug();
        problems.push(format!("not part of the configured networks: {name} in {}", source.path().display()));
    }
    plan
}

/// Places by canonical names.
type Found<'a> = BTreeMap<String, Place<'a>>;

/// Every tensor of every source under its canonical name; aliases are compared, clashes are problems.
fn collect<'a>(
    sources: &'a [Source],
    problems: &mut Vec<String>,
    report: &mut ImportReport,
) -> Result<Found<'a>, WeightsError> {
    let mut found = Found::new();
    for source in sources {
        let mut ignored = Vec::new();
        for key in source.tensors().keys() {
            // Neither inference nor training uses these keys of the authors' files.
            let bare = key.strip_prefix(DUST3R).unwrap_or(key);
            if bare == "mask_token" || bare.starts_with("prediction_head.") {
                ignored.push(key.as_str());
                continue;
            }
            let name = canonical(key);
            let Some((other, twin)) = found.get(&name) else {
                found.insert(name, (source, key.clone()));
                continue;
            };
            if !std::ptr::eq(*other, source) {
                let (a, b) = (other.path().display(), source.path().display());
                problems.push(format!("given twice: {name} by {a} and by {b}"));
            } else if !same_bits(source, key, twin)? {
                problems.push(format!("contradiction: {key} and {twin} name one tensor but differ"));
            }
        }
        if !ignored.is_empty() {
            report.notes.push(format!("{}: ignored {}", source.path().display(), ignored.join(", ")));
        }
    }
    Ok(found)
}

fn same_bits(source: &Source, a: &str, b: &str) -> Result<bool, WeightsError> {
    let [entry, other] = [a, b].map(|key| &source.tensors()[key]);
    // A type that cannot be read is named later.
    if [entry, other].iter().any(|entry| Precision::called(&entry.dtype).is_none()) {
        return Ok(true);
    }
    if entry.shape != other.shape || entry.dtype != other.dtype {
        return Ok(false);
    }
    let (a, b) = (source.read_f32(a)?, source.read_f32(b)?);
    Ok(a.iter().zip(&b).all(|(a, b)| a.to_bits() == b.to_bits()))
}

/// CroCo checkpoints have one decoder. Both decoders start from it.
fn copy_decoder(found: &mut Found, report: &mut ImportReport) {
    let (first, second) = (format!("{DUST3R}dec_blocks."), format!("{DUST3R}dec_blocks2."));
    if found.keys().any(|k| k.starts_with(&second)) {
        return;
    }
    let copies: Vec<_> = found
        .iter()
        .filter_map(|(k, (s, key))| Some((format!("{second}{}", k.strip_prefix(&first)?), (*s, key.clone()))))
        .collect();
    if !copies.is_empty() {
        report.notes.push("`dec_blocks2` is in no file: copied from `dec_blocks`".into());
        found.extend(copies);
    }
}

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
    let origin = from.display().to_string();
    write_tensors(to, &origin, metadata, shapes.collect(), Precision::F32, values, progress)?;
    Ok(entries.len())
}
