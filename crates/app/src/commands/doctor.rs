//! `snapsnap doctor`: devices, features, weights, and missing parts with their remedies.

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::Args;
use serde_json::{Value, json};
use snapsnap_eval::lpips::Lpips;
use snapsnap_ops::bf16;

use crate::arguments::ConfigArguments;
use crate::device::{self, Adapter};
use crate::failure::Failure;
use crate::{memory, perceptual, say, weights};

#[derive(Args)]
pub struct Arguments {
    /// Further weights to check: a file, or a folder with weights.safetensors.
    #[arg(long, value_name = "FILE|DIR")]
    weights: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Approximate memory of a reconstruction with the default weights, in bytes (docs/weights.md).
const COMFORTABLE: u64 = 1_000_000_000;

struct Weights {
    name: String,
    /// Their description, or their fault.
    state: Result<String, String>,
    /// Remedy of a fault.
    mend: &'static str,
}

const GET_WEIGHTS: &str = "make them again with import-weights or init-weights, or train them; docs/formats.md describes their content";
const GET_LPIPS: &str = "snapsnap fetch-weights alexnet lpips";

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let graphics = device::adapters();
    let devices: Vec<Adapter> = device::processors().chain(graphics.iter().cloned()).collect();
    let (chosen, why) = chosen(graphics);
    let weights = weights_found(arguments);
    let memory = memory::there();
    let missing = missing(graphics, &weights, memory);
    if arguments.json {
        let device = |found: &Adapter| {
            let mut value = json!(found);
            value["chosen"] = json!(found.name == chosen);
            value
        };
        let weight = |w: &Weights| {
            let (Ok(text) | Err(text)) = &w.state;
            json!({ "name": w.name, "sound": w.state.is_ok(), "description": text })
        };
        let part = |(what, mend): &(String, &str)| json!({ "what": what, "mend": mend });
        let report = json!({
            "version": env!("CARGO_PKG_VERSION"),
            "commit": env!("SNAPSNAP_COMMIT"),
            "compiled_in": device::compiled_in(),
            "mpi": cfg!(feature = "mpi"),
            "threads": threads(),
            "bf16": bf16::is_there(),
            "memory_bytes": (memory < u64::MAX).then_some(memory),
            "devices": devices.iter().map(device).collect::<Vec<Value>>(),
            "chosen": chosen,
            "why": why,
            "weights": weights.iter().map(weight).collect::<Vec<Value>>(),
            "missing": missing.iter().map(part).collect::<Vec<Value>>(),
        });
        say::json(&format!("{report:#}"))?;
        return broken(&weights);
    }
    let mpi =
        if cfg!(feature = "mpi") { "compiled in" } else { "not compiled in: build with --features mpi" };
    let bf16 = if bf16::is_there() { "AVX-512" } else { "no instructions for it in this processor" };
    let mut lines = vec![
        format!("snapsnap {}, commit {}", env!("CARGO_PKG_VERSION"), env!("SNAPSNAP_COMMIT")),
        format!("compiled in  {}", device::compiled_in().join(", ")),
        format!("MPI          {mpi}"),
        format!("threads      {}", threads()),
        format!("bf16         {bf16}"),
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
    if chosen != "cpu" {
        lines.push(
            "  for one person and small networks it takes cpu, which is faster than compiling a GPU's kernels"
                .into(),
        );
    }
    lines.push("weights".into());
    lines.extend(weights.iter().map(|w| match &w.state {
        Ok(text) => format!("  {}: sound, {text}", w.name),
        Err(text) => format!("! {}: {text}", w.name),
    }));
    lines.push(if missing.is_empty() { "nothing is missing" } else { "what could be better" }.into());
    lines.extend(missing.iter().map(|(what, mend)| format!("  {what}\n    {mend}")));
    say::lines(&lines.join("\n"))?;
    broken(&weights)
}

/// The failure of the first damaged weights. Missing parts are no failure.
fn broken(weights: &[Weights]) -> Result<(), Failure> {
    match weights.iter().find_map(|w| Some((&w.name, w.state.as_ref().err()?))) {
        None => Ok(()),
        // Messages about files begin with the file's name already.
        Some((name, message)) if message.starts_with(name) => Err(Failure::Input(message.clone())),
        Some((name, message)) => Err(Failure::Input(format!("{name}: {message}"))),
    }
}

/// The name of the device that `--device auto` takes, and the reason.
fn chosen(graphics: &[Adapter]) -> (&str, &'static str) {
    match graphics.iter().find(|found| !found.software) {
        Some(found) => (found.name.as_str(), "the first hardware GPU found"),
        None if graphics.is_empty() => ("cpu", "no GPU found"),
        None => ("cpu", "no hardware GPU found, and software adapters are slower than the CPU"),
    }
}

fn weights_found(arguments: &Arguments) -> Vec<Weights> {
    let open = |path: Option<&Path>, name: String| {
        let checked = weights::open(path, &ConfigArguments::default())
            .and_then(|file| file.check_values().map(|()| file).map_err(Failure::from));
        let opened = checked.map(|file| {
            let (millions, side) = (file.parameters() as f64 / 1e6, file.config.network.resolution);
            format!("{millions:.1} million parameters, canvas of {side}²")
        });
        Weights { name, state: opened.map_err(|e| e.to_string()), mend: GET_WEIGHTS }
    };
    let mut found = vec![open(None, weights::DEFAULT_NAME.into())];
    if let Some(path) = &arguments.weights {
        found.push(open(Some(path), path.display().to_string()));
    }
    let folder = Path::new(perceptual::FOLDER);
    if Lpips::missing(folder).is_empty() {
        let name = format!("LPIPS in {}", folder.display());
        let loaded = Lpips::published(folder, &Device::flex()).map(|_| "the published ones".into());
        found.push(Weights { name, state: loaded.map_err(|e| e.to_string()), mend: GET_LPIPS });
    }
    found
}

/// The missing parts, each with its remedy.
fn missing(graphics: &[Adapter], weights: &[Weights], memory: u64) -> Vec<(String, &'static str)> {
    let mut missing = Vec::new();
    let mut add = |what: &str, mend| missing.push((what.to_owned(), mend));
    if graphics.iter().all(|found| found.software) {
        let mend = if device::is_opengl() {
            "the card works with OpenGL only, which is not used: install its Vulkan driver (Debian, Ubuntu: apt-get install \
             libvulkan1 mesa-vulkan-drivers, or NVIDIA's own)"
        } else {
            "a card needs its Vulkan driver (Debian, Ubuntu: apt-get install libvulkan1 mesa-vulkan-drivers, or NVIDIA's own); \
             no card is necessary: the CPU takes about a second"
        };
        add("no hardware GPU found", mend);
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

/// Some systems do not tell their memory.
fn gigabytes(bytes: u64) -> String {
    if bytes == u64::MAX { "unknown".into() } else { format!("{:.1} GB", bytes as f64 / 1e9) }
}
