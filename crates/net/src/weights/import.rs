//! Importing the authors' checkpoints, strictly: every tensor is accounted for by name, or nothing is written.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::WeightsError;
use super::file::{parts_of, write};
use super::init::{SideHeads, draw};
use super::schema::{self, DUST3R, SCALE, SIDE, TensorSpec};
use super::source::{Entry, Source, is_readable};
use crate::config::Config;

/// Choices an import leaves to the user.
#[derive(Debug, Clone, Copy)]
pub struct ImportOptions {
    /// Where side heads come from when the checkpoints have none.
    pub side_heads: SideHeads,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// What an import did.
#[derive(Debug, Default)]
pub struct ImportReport {
    /// Tensors written.
    pub tensors: usize,
    /// Parameters written.
    pub parameters: usize,
    /// Everything that was not a plain copy, one line each.
    pub notes: Vec<String>,
}

/// Where a tensor's values come from.
enum Origin<'a> {
    File(&'a Source, String),
    Seed,
}

/// Keys of the authors' files that play no part in inference or training here.
fn is_ignored(key: &str) -> bool {
    key == "mask_token" || key.starts_with("prediction_head.")
}

/// The second name under which PyTorch lists a `layerN_rn` convolution (SNAPSNAP §3.2).
pub(super) fn alias_of(name: &str) -> Option<String> {
    let (head, digit) = name.strip_suffix("_rn.weight")?.rsplit_once("scratch.layer")?;
    let n: usize = digit.parse().ok()?;
    Some(format!("{head}scratch.layer_rn.{}.weight", n - 1))
}

/// The name we keep for a key of the authors' files: prefix added, alias replaced.
fn canonical(key: &str) -> String {
    let bare = key.strip_prefix(DUST3R).unwrap_or(key);
    if bare == SCALE || ["pred_unet.", "gs_conv.", SIDE].iter().any(|p| bare.starts_with(p)) {
        return bare.to_owned();
    }
    if let Some((head, tail)) = bare.split_once("scratch.layer_rn.")
        && let Some(n) = tail.strip_suffix(".weight").and_then(|n| n.parse::<usize>().ok())
    {
        return format!("{DUST3R}{head}scratch.layer{}_rn.weight", n + 1);
    }
    format!("{DUST3R}{bare}")
}

/// A line for a tensor of the wrong shape or type.
pub(super) fn mismatch(spec: &TensorSpec, entry: &Entry, path: &Path) -> Option<String> {
    if !is_readable(&entry.dtype) {
        return Some(format!(
            "wrong type: {} is {} in {}, must be f32, f16 or bf16",
            spec.name,
            entry.dtype,
            path.display()
        ));
    }
    (entry.shape != spec.shape).then(|| {
        let (name, file, found) = (&spec.name, path.display(), &entry.shape);
        format!("wrong shape: {name} is {found:?} in {file}, the config asks for {:?}", spec.shape)
    })
}

/// Reads checkpoints of the authors, DUSt3R or CroCo, checks every tensor against `config` and writes one file of ours.
///
/// Each of the two parts (point predictor, regressor) must be complete or wholly absent, except that files without δ,
/// without side heads or without any heads, as DUSt3R's and CroCo's are, get those from the config and the seed.
///
/// # Errors
/// [`WeightsError`]; `to` is then left as it was.
pub fn import(
    from: &[PathBuf],
    config: &Config,
    options: ImportOptions,
    to: &Path,
) -> Result<ImportReport, WeightsError> {
    let sources = from.iter().map(|path| Source::open(path)).collect::<Result<Vec<_>, _>>()?;
    let mut report = ImportReport::default();
    let mut problems = Vec::new();
    let mut found = collect(&sources, &mut problems, &mut report)?;
    copy_decoder(config, &mut found, &mut report);

    let parts = parts_of(found.keys());
    let specs: Vec<_> = schema::tensors(config).into_iter().filter(|t| parts.contains(t.part)).collect();
    let released = found.contains_key(SCALE);
    let missing_heads: Vec<usize> = (1..=4)
        .filter(|k| {
            !released && !found.keys().any(|key| key.starts_with(&format!("{DUST3R}downstream_head{k}.")))
        })
        .collect();

    let mut plan: Vec<(&TensorSpec, Origin)> = Vec::new();
    for spec in &specs {
        if let Some((source, key)) = found.remove(&spec.name) {
            problems.extend(mismatch(spec, &source.tensors()[&key], source.path()));
            plan.push((spec, Origin::File(source, key)));
            continue;
        }
        let head =
            missing_heads.iter().find(|k| spec.name.starts_with(&format!("{DUST3R}downstream_head{k}.")));
        match (head, options.side_heads) {
            (Some(&k), SideHeads::Copy) if k > 2 => {
                let twin =
                    spec.name.replace(&format!("downstream_head{k}."), &format!("downstream_head{}.", k - 2));
                match plan.iter().find(|(s, _)| s.name == twin) {
                    Some((s, Origin::File(source, key))) if s.shape == spec.shape => {
                        let origin = Origin::File(source, key.clone());
                        plan.push((spec, origin));
                    }
                    Some((s, _)) if s.shape != spec.shape => problems.push(format!(
                        "cannot copy: {} needs {:?}, {} has {:?} (fusion = \"concat\" doubles the side heads' inputs)",
                        spec.name, spec.shape, twin, s.shape
                    )),
                    _ => plan.push((spec, Origin::Seed)),
                }
            }
            (Some(_), _) => plan.push((spec, Origin::Seed)),
            (None, _) if spec.name == SCALE => {
                report
                    .notes
                    .push(format!("δ (`scale`) is in no file: {} from the config", config.network.delta));
                plan.push((spec, Origin::Seed));
            }
            (None, _) => problems.push(format!("missing: {} {:?}", spec.name, spec.shape)),
        }
    }
    if parts.contains(schema::Part::PointPredictor) {
        let wanted = if config.network.side_heads { 4 } else { 2 };
        for k in missing_heads.into_iter().filter(|&k| k <= wanted) {
            report.notes.push(match options.side_heads {
                SideHeads::Copy if k > 2 => format!("head {k} is in no file: copied from head {}", k - 2),
                _ => format!("head {k} is in no file: drawn from seed {}", options.seed),
            });
        }
    }
    for (name, (source, _)) in &found {
        problems.push(format!("not part of the configured networks: {name} in {}", source.path().display()));
    }
    let origin = from.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ");
    if specs.is_empty() {
        problems.push("no tensor of a point predictor or a regressor".into());
    }
    if !problems.is_empty() {
        return Err(WeightsError::Tensors { origin, problems });
    }

    let ordered: Vec<&TensorSpec> = plan.iter().map(|(spec, _)| *spec).collect();
    let mut next = plan.iter();
    let mut broken = Vec::new();
    let result = write(to, config, &ordered, |spec| {
        let values = match &next.next().expect("one origin per tensor").1 {
            Origin::Seed => draw(spec, options.seed),
            Origin::File(source, key) => source.read_f32(key)?,
        };
        let bad = values.iter().filter(|v| !v.is_finite()).count();
        if bad > 0 {
            broken.push(format!("not finite: {} ({bad} of {} values)", spec.name, values.len()));
        }
        // The last tensor decides: an error here discards the temporary file.
        if next.len() == 0 && !broken.is_empty() {
            return Err(WeightsError::Tensors {
                origin: origin.clone(),
                problems: std::mem::take(&mut broken),
            });
        }
        Ok(values)
    });
    result?;
    report.tensors = ordered.len();
    report.parameters = ordered.iter().map(|t| t.elements()).sum();
    Ok(report)
}

type Found<'a> = BTreeMap<String, (&'a Source, String)>;

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
            if is_ignored(key.strip_prefix(DUST3R).unwrap_or(key)) {
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
    let (a, b) = (source.read_f32(a)?, source.read_f32(b)?);
    Ok(a.len() == b.len() && a.iter().zip(&b).all(|(a, b)| a.to_bits() == b.to_bits()))
}

/// CroCo checkpoints have one decoder; both sides start from it (SNAPSNAP §3.3).
fn copy_decoder(config: &Config, found: &mut Found, report: &mut ImportReport) {
    let (first, second) = (format!("{DUST3R}dec_blocks."), format!("{DUST3R}dec_blocks2."));
    if config.network.dec_depth == 0 || found.keys().any(|k| k.starts_with(&second)) {
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
