//! `snapsnap doctor`: devices, features, weights and missing parts, each with its remedy.

use std::path::PathBuf;

use clap::Args;
use serde_json::{Value, json};
use snapsnap_eval::lpips::Lpips;

use super::ConfigArguments;
use crate::device::{self, Found};
use crate::failure::Failure;
use crate::{memory, perceptual, say, weights};

#[derive(Args)]
pub struct Arguments {
    /// Weights to look at as well: a file, or a folder with weights.safetensors.
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    /// Print it as JSON.
    #[arg(long)]
    json: bool,
}

/// Bytes that a reconstruction with the default weights takes, about (docs/weights.md).
const COMFORTABLE: u64 = 1_000_000_000;

/// Weights that were looked for.
struct Weights {
    name: String,
    /// Their description, or their fault.
    state: Result<String, String>,
    /// How sound ones are got.
    mend: &'static str,
}

const GET_WEIGHTS: &str = "make them again with import-weights or init-weights, or train them; docs/formats.md says what is in them";
const GET_LPIPS: &str = "snapsnap fetch-weights alexnet lpips";

/// Something that could be better, and how.
struct Missing {
    what: String,
    mend: String,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let devices = device::found();
    let (chosen, why) = chosen(&devices);
    let weights = weights_found(arguments);
    let memory = memory::there();
    let missing = missing(&devices, &weights, memory);
    if arguments.json {
        let device = |found: &Found| {
            json!({
                "name": found.name, "adapter": found.adapter, "backend": found.backend,
                "software": found.software, "memory_bytes": found.memory, "chosen": found.name == chosen,
            })
        };
        let weight = |w: &Weights| {
            let (sound, text) = match &w.state {
                Ok(text) => (true, text),
                Err(text) => (false, text),
            };
            json!({ "name": w.name, "sound": sound, "description": text })
        };
        let report = json!({
            "version": env!("CARGO_PKG_VERSION"),
            "commit": env!("SNAPSNAP_COMMIT"),
            "compiled_in": device::compiled_in(),
            "threads": threads(),
            "memory_bytes": memory,
            "devices": devices.iter().map(device).collect::<Vec<Value>>(),
            "chosen": chosen,
            "why": why,
            "weights": weights.iter().map(weight).collect::<Vec<Value>>(),
            "missing": missing.iter().map(|m| json!({ "what": m.what, "mend": m.mend })).collect::<Vec<Value>>(),
        });
        say::json(&format!("{report:#}"))?;
        return broken(&weights);
    }
    let mut lines = vec![
        format!("snapsnap {}, commit {}", env!("CARGO_PKG_VERSION"), env!("SNAPSNAP_COMMIT")),
        format!("compiled in  {}", device::compiled_in().join(", ")),
        format!("threads      {}", threads()),
        format!("memory       {}", gigabytes(memory)),
        "devices".into(),
    ];
    lines.extend(devices.iter().map(|found| {
        let mark = if found.name == chosen { "*" } else { " " };
        let software = if found.software { ", software" } else { "" };
        let memory = found.memory.map(|bytes| format!(", {}", gigabytes(bytes))).unwrap_or_default();
        format!("{mark} {:<10} {} ({}{software}{memory})", found.name, found.adapter, found.backend)
    }));
    lines.push(format!("  --device auto takes {chosen}: {why}"));
    lines.push("weights".into());
    lines.extend(weights.iter().map(|w| match &w.state {
        Ok(text) => format!("  {}: sound, {text}", w.name),
        Err(text) => format!("! {}: {text}", w.name),
    }));
    lines.push(if missing.is_empty() { "nothing is missing" } else { "what could be better" }.into());
    lines.extend(missing.iter().map(|Missing { what, mend }| format!("  {what}\n    {mend}")));
    say::lines(&lines.join("\n"))?;
    broken(&weights)
}

/// Weights that were asked for and are not sound are a failure; what merely could be better is none.
fn broken(weights: &[Weights]) -> Result<(), Failure> {
    match weights.iter().find_map(|w| w.state.as_ref().err().map(|state| (&w.name, state))) {
        // A message about a file begins with its name.
        Some((name, state)) if state.starts_with(name) => Err(Failure::Input(state.clone())),
        Some((name, state)) => Err(Failure::Input(format!("{name}: {state}"))),
        None => Ok(()),
    }
}

/// The name of the device that `--device auto` takes, and the reason.
fn chosen(devices: &[Found]) -> (String, &'static str) {
    match devices.iter().find(|found| found.card) {
        Some(found) => (found.name.clone(), "the first real GPU that answers"),
        None if devices.iter().any(|found| found.software) => {
            ("cpu".into(), "no real GPU answers, and software adapters are slower than the CPU itself")
        }
        None => ("cpu".into(), "no GPU answers"),
    }
}

fn weights_found(arguments: &Arguments) -> Vec<Weights> {
    let look = |path: Option<&PathBuf>, name: String| {
        let defaults = ConfigArguments { config: None, set: Vec::new() };
        let state = match weights::open(path.map(PathBuf::as_path), &defaults) {
            Ok(file) => {
                let (config, parameters) = (&file.config, file.parameters());
                Ok(format!(
                    "{:.1} million parameters, canvas of {}²",
                    parameters as f64 / 1e6,
                    config.network.resolution
                ))
            }
            Err(e) => Err(e.to_string()),
        };
        Weights { name, state, mend: GET_WEIGHTS }
    };
    let mut found = vec![look(None, weights::DEFAULT_NAME.into())];
    if let Some(path) = &arguments.weights {
        found.push(look(Some(path), path.display().to_string()));
    }
    let folder = PathBuf::from(perceptual::FOLDER);
    if Lpips::missing(&folder).is_empty() {
        let name = format!("LPIPS in {}", folder.display());
        let loaded = Lpips::published(&folder, &burn::tensor::Device::flex());
        found.push(Weights {
            name,
            state: loaded.map(|_| "the published ones".into()).map_err(|e| e.to_string()),
            mend: GET_LPIPS,
        });
    }
    found
}

fn missing(devices: &[Found], weights: &[Weights], memory: u64) -> Vec<Missing> {
    let mut missing = Vec::new();
    let mut add = |what: &str, mend: &str| missing.push(Missing { what: what.into(), mend: mend.into() });
    if !devices.iter().any(|found| found.card) {
        let mend = if snapsnap_splat::adapter::is_opengl() {
            "OpenGL alone knows a card here, and it is not used: install the card's Vulkan driver (Debian, Ubuntu: apt-get install \
             libvulkan1 mesa-vulkan-drivers, or NVIDIA's own)"
        } else {
            "a card needs its Vulkan driver (Debian, Ubuntu: apt-get install libvulkan1 mesa-vulkan-drivers, or NVIDIA's own); \
             without a card all is well: the CPU takes about a second"
        };
        add("no real GPU answers", mend);
    }
    if memory < COMFORTABLE {
        add(
            "less memory than a reconstruction with the default weights takes",
            "snapsnap reconstruct … --set network.resolution=512",
        );
    }
    let gone: Vec<String> =
        Lpips::missing(perceptual::FOLDER.as_ref()).iter().map(|file| file.display().to_string()).collect();
    if !gone.is_empty() {
        add(&format!("no {} here: evaluations go without LPIPS", gone.join(", no ")), GET_LPIPS);
    }
    for w in weights.iter().filter(|w| w.state.is_err()) {
        add(&format!("{} are not sound", w.name), w.mend);
    }
    missing
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn gigabytes(bytes: u64) -> String {
    format!("{:.1} GB", bytes as f64 / 1e9)
}
