//! `--device`: the devices of this build and this machine, and their names.

use std::ffi::OsString;
use std::panic;
use std::process::{Command, Stdio};
use std::sync::OnceLock;

#[cfg(feature = "gpu")]
use burn::tensor::DeviceKind;
use burn::tensor::{Device, DeviceType};
use serde::{Deserialize, Serialize};

use crate::failure::Failure;
use crate::memory;

/// The device called `name`.
///
/// # Errors
/// [`Failure::Input`] with a list of the devices.
pub fn choose(name: &str) -> Result<Device, Failure> {
    let (kind, index) = match name.split_once(':') {
        Some((kind, index)) => {
            let index = index.parse::<usize>().map_err(|_| unknown(name, "the index is no number"))?;
            (kind, Some(index))
        }
        None => (name, None),
    };
    if index.is_some() && ["auto", "cpu", "flex", "ndarray"].contains(&kind) {
        return Err(unknown(name, "this device has no index"));
    }
    match kind {
        "auto" => {
            let card = adapters().iter().find(|adapter| !adapter.software);
            let card = card.and_then(|card| choose(&card.name).ok());
            return Ok(card.unwrap_or_else(Device::flex));
        }
        "cpu" | "flex" => return Ok(Device::flex()),
        #[cfg(feature = "gpu")]
        #[allow(deprecated, reason = "kept as the second CPU implementation")]
        "ndarray" => return Ok(Device::ndarray()),
        _ => {}
    }
    match gpus().into_iter().find(|(compiled, ..)| *compiled == kind) {
        Some((.., kind)) => nth(name, kind, index),
        None if ["wgpu", "ndarray"].contains(&kind) => {
            Err(unknown(name, "not compiled in: build with --features gpu"))
        }
        None if ["vulkan", "cuda", "metal"].contains(&kind) => {
            Err(unknown(name, &format!("not compiled in: build with --features {kind}")))
        }
        None => Err(unknown(name, "no such kind of device")),
    }
}

/// The device called `name` for one person and small networks: `auto` is the CPU. Each process compiles the kernels of
/// a card anew, which takes longer than the CPU's whole work (docs/inference.md).
pub fn choose_for_one(name: &str) -> Result<Device, Failure> {
    choose(if name == "auto" { "cpu" } else { name })
}

/// The device called `name` for process `turn` of several on this machine. Without an index they take the GPUs in turn.
pub fn choose_in_turn(name: &str, turn: usize) -> Result<Device, Failure> {
    let device = choose(name)?;
    if memory::is_cpu(&device) || name.contains(':') {
        return Ok(device);
    }
    let cards = || adapters().iter().filter(|adapter| !adapter.software);
    let kind = cards().next().filter(|_| name == "auto").map_or(name, |card| card.kind());
    let cards: Vec<&Adapter> = cards().filter(|card| card.kind() == kind).collect();
    match cards.get(turn % cards.len().max(1)) {
        Some(card) => choose(&card.name),
        None => Ok(device),
    }
}

/// Both CPU backends, and of every compiled kind the first card, or else a software adapter that can run kernels.
pub fn all() -> Vec<Device> {
    compiled_in().into_iter().filter_map(|name| choose(name).ok()).collect()
}

/// A working device.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Adapter {
    /// Its name for `--device`.
    pub name: String,
    /// Name of the processor or the graphics adapter.
    pub adapter: String,
    /// Backend.
    pub backend: String,
    /// Whether it is a GPU made of software.
    pub software: bool,
    /// Memory in bytes, if it is known.
    #[serde(rename = "memory_bytes")]
    pub memory: Option<u64>,
}

impl Adapter {
    /// Its kind for `--device`.
    fn kind(&self) -> &str {
        self.name.split(':').next().unwrap_or_default()
    }
}

/// Names and backends of the devices of the processor.
const PROCESSORS: &[(&str, &str)] = &[
    ("cpu", "Burn's flex"),
    #[cfg(feature = "gpu")]
    ("ndarray", "Burn's ndarray"),
];

/// The devices of the processor, one of each backend.
pub fn processors() -> impl Iterator<Item = Adapter> {
    PROCESSORS.iter().map(|(name, backend)| Adapter {
        name: (*name).into(),
        adapter: processor(),
        backend: (*backend).into(),
        software: false,
        memory: Some(memory::there()),
    })
}

/// The answers of the graphics drivers: all adapters of the compiled kinds, and whether wgpu would take OpenGL, which is
/// not used.
type Drivers = (Vec<Adapter>, bool);

/// Name of the hidden command that prints [`probe`]'s text.
pub const PROBE: &str = "probe-adapters";

/// The answers of the graphics drivers, as JSON.
pub fn probe() -> String {
    let of_kind = |(kind, backend, device_type): (&str, &str, DeviceType)| {
        let adapter = |(index, device): (usize, Device)| Adapter {
            name: format!("{kind}:{index}"),
            adapter: identity(&device).map_or_else(|| "?".into(), |(name, _)| name),
            backend: backend.into(),
            software: !is_card(&device),
            // The graphics layer has no function for the memory of cards.
            memory: (!is_card(&device)).then(memory::there),
        };
        devices(kind, device_type).into_iter().enumerate().map(adapter).collect::<Vec<_>>()
    };
    let drivers: Drivers = (gpus().into_iter().flat_map(of_kind).collect(), graphics_has_only_opengl());
    serde_json::to_string(&drivers).expect("plain text and numbers")
}

/// What starts this program: its path, and perhaps arguments before a command.
static PROGRAM: OnceLock<Vec<OsString>> = OnceLock::new();

/// Sets what starts this program. Until then there are no graphics adapters.
pub fn set_program(program: &[OsString]) {
    PROGRAM.get_or_init(|| program.to_vec());
}

/// The graphics drivers, asked by another process: they may crash, for example when memory is short, and their loaders
/// print warnings.
fn drivers() -> &'static Drivers {
    static DRIVERS: OnceLock<Drivers> = OnceLock::new();
    DRIVERS.get_or_init(|| {
        let (program, arguments) = PROGRAM.get().and_then(|program| program.split_first()).unzip();
        let probed = program.and_then(|program| {
            let mut command = Command::new(program);
            command.args(arguments.unwrap_or_default()).arg(PROBE).stdin(Stdio::null());
            command.stderr(Stdio::null()).output().ok()
        });
        let probed = probed.filter(|output| output.status.success());
        probed.and_then(|output| serde_json::from_slice(&output.stdout).ok()).unwrap_or_default()
    })
}

/// The graphics adapters that answer.
pub fn adapters() -> &'static [Adapter] {
    &drivers().0
}

/// Whether the only graphics driver is OpenGL's, which is not used.
pub fn is_opengl() -> bool {
    drivers().1
}

/// Kinds of devices of this build.
pub fn compiled_in() -> Vec<&'static str> {
    PROCESSORS.iter().map(|(name, _)| *name).chain(gpus().into_iter().map(|(name, ..)| name)).collect()
}

fn processor() -> String {
    let mut system = sysinfo::System::new();
    system.refresh_cpu_list(sysinfo::CpuRefreshKind::nothing());
    let brand = system.cpus().first().map(|cpu| cpu.brand().trim().to_owned());
    brand.filter(|brand| !brand.is_empty()).unwrap_or_else(|| "this processor".into())
}

/// Whether wgpu would use OpenGL.
fn graphics_has_only_opengl() -> bool {
    #[cfg(feature = "gpu")]
    return snapsnap_splat::graphics_api::is_opengl();
    #[cfg(not(feature = "gpu"))]
    false
}

/// Kinds of GPU devices that are compiled in, best first, each with its backend.
fn gpus() -> Vec<(&'static str, &'static str, DeviceType)> {
    vec![
        #[cfg(feature = "cuda")]
        ("cuda", "CUDA", DeviceType::Cuda),
        #[cfg(feature = "metal")]
        ("metal", "wgpu, MSL", DeviceType::Metal),
        #[cfg(feature = "vulkan")]
        ("vulkan", "wgpu, SPIR-V", DeviceType::Vulkan),
        #[cfg(feature = "gpu")]
        ("wgpu", "wgpu, WGSL", DeviceType::Wgpu),
    ]
}

/// A device in words.
pub fn describe(device: &Device) -> String {
    let Some((name, is_card)) = identity(device) else {
        return if *device == Device::flex() { "cpu (flex)".into() } else { "cpu (ndarray)".into() };
    };
    let software = if is_card { "" } else { ", software" };
    format!("{name}{software}")
}

/// Name of a GPU, and whether it is a card; `None` for the processor.
fn identity(device: &Device) -> Option<(String, bool)> {
    #[cfg(feature = "gpu")]
    let identity = device.identity().map(|identity| (identity.name, identity.physical.is_some()));
    #[cfg(not(feature = "gpu"))]
    let identity = (*device != Device::flex()).then(|| (String::new(), true));
    identity
}

/// The devices of a kind. Without a driver the graphics layer panics, and there are none.
fn devices(kind: &str, device_type: DeviceType) -> Vec<Device> {
    let hook = panic::take_hook();
    panic::set_hook(Box::new(|_| {}));
    let found = panic::catch_unwind(|| match kind == "wgpu" && graphics_has_only_opengl() {
        true => Vec::new(),
        false => Device::enumerate(device_type).into_vec(),
    });
    panic::set_hook(hook);
    found.unwrap_or_default()
}

fn nth(name: &str, kind: DeviceType, index: Option<usize>) -> Result<Device, Failure> {
    let kind_name = name.split(':').next().unwrap_or(name);
    let is_there = adapters().iter().any(|adapter| adapter.kind() == kind_name);
    let devices = if is_there { devices(kind_name, kind) } else { Vec::new() };
    let found = devices.len();
    if found == 0 {
        let message =
            "no graphics adapter found; is there a GPU, and is its driver installed (Vulkan, not OpenGL)?";
        return Err(unknown(name, message));
    }
    let device = match index {
        // The runtime chooses the fastest card.
        #[cfg(feature = "gpu")]
        None if name == "wgpu" => return Ok(Device::wgpu(DeviceKind::DefaultDevice)),
        None => devices.iter().find(|device| is_card(device)).or(devices.first()),
        Some(index) => devices.get(index),
    };
    let device = device.ok_or_else(|| unknown(name, &format!("there are {found}, numbered from 0")))?;
    if name.starts_with("vulkan") && !is_card(device) {
        // Mesa's software adapter aborts the program on the first kernel.
        let message = format!("{} cannot run SPIR-V kernels: use wgpu", describe(device));
        return Err(unknown(name, &message));
    }
    Ok(device.clone())
}

fn is_card(device: &Device) -> bool {
    identity(device).is_some_and(|(_, is_card)| is_card)
}

fn unknown(name: &str, why: &str) -> Failure {
    let mut there = vec!["auto".to_owned(), "cpu (= flex)".into()];
    there.extend(PROCESSORS[1..].iter().map(|(name, _)| (*name).to_owned()));
    there.extend(adapters().iter().map(|adapter| {
        let software = if adapter.software { ", software" } else { "" };
        format!("{} ({}{software})", adapter.name, adapter.adapter)
    }));
    Failure::Input(format!("--device {name}: {why}. Available devices: {}", there.join(", ")))
}
