//! `--device`: names of devices, and which of them this build and this machine have.

use burn::tensor::{Device, DeviceKind, DeviceType};
use snapsnap_splat::adapter;

use crate::failure::Failure;
use crate::memory;

/// The device called `name`.
///
/// # Errors
/// [`Failure::Input`] listing what there is.
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
        "auto" => return Ok(real_gpu().unwrap_or_else(Device::flex)),
        "cpu" | "flex" => return Ok(Device::flex()),
        "ndarray" => return Ok(ndarray()),
        _ => {}
    }
    match gpus().into_iter().find(|(compiled, _)| *compiled == kind) {
        Some((_, kind)) => nth(name, kind, index),
        None if ["vulkan", "cuda", "metal"].contains(&kind) => {
            Err(unknown(name, &format!("not compiled in: build with --features {kind}")))
        }
        None => Err(unknown(name, "no such kind of device")),
    }
}

/// Every device there is: both CPU backends, and of every compiled kind the first card, or the software adapter if it can run
/// kernels.
pub fn all() -> Vec<Device> {
    let gpus = gpus().into_iter().filter_map(|(name, _)| choose(name).ok());
    [Device::flex(), ndarray()].into_iter().chain(gpus).collect()
}

/// A device that answers.
pub struct Found {
    /// As `--device` wants it.
    pub name: String,
    /// As it calls itself.
    pub adapter: String,
    /// Backend.
    pub backend: &'static str,
    /// Whether it is a GPU made of software.
    pub software: bool,
    /// Whether it is a GPU that `auto` takes.
    pub card: bool,
    /// Bytes, where they are known.
    pub memory: Option<u64>,
}

/// Every device that answers, of all kinds that are compiled in.
pub fn found() -> Vec<Found> {
    let processor = |name: &str, backend| Found {
        name: name.into(),
        adapter: processor(),
        backend,
        software: false,
        card: false,
        memory: Some(memory::there()),
    };
    let mut found = vec![processor("cpu", "Burn's flex"), processor("ndarray", "Burn's ndarray")];
    for (kind, device_type) in gpus() {
        for (i, device) in devices(device_type).iter().enumerate() {
            let identity = device.identity();
            found.push(Found {
                name: format!("{kind}:{i}"),
                adapter: identity.as_ref().map_or_else(|| "?".into(), |identity| identity.name.clone()),
                backend: match kind {
                    "wgpu" => "wgpu, WGSL",
                    "vulkan" => "wgpu, SPIR-V",
                    "metal" => "wgpu, MSL",
                    _ => "CUDA",
                },
                software: !is_card(device),
                card: is_card(device),
                // The graphics layer does not tell.
                memory: (!is_card(device)).then(memory::there),
            });
        }
    }
    found
}

/// Kinds of devices of this build.
pub fn compiled_in() -> Vec<&'static str> {
    ["cpu", "ndarray"].into_iter().chain(gpus().into_iter().map(|(name, _)| name)).collect()
}

fn processor() -> String {
    let mut system = sysinfo::System::new();
    system.refresh_cpu_list(sysinfo::CpuRefreshKind::nothing());
    let brand = system.cpus().first().map(|cpu| cpu.brand().trim().to_owned());
    brand.filter(|brand| !brand.is_empty()).unwrap_or_else(|| "this processor".into())
}

/// Kinds of GPU devices that are compiled in, best first.
fn gpus() -> Vec<(&'static str, DeviceType)> {
    vec![
        #[cfg(feature = "cuda")]
        ("cuda", DeviceType::Cuda),
        #[cfg(feature = "metal")]
        ("metal", DeviceType::Metal),
        #[cfg(feature = "vulkan")]
        ("vulkan", DeviceType::Vulkan),
        ("wgpu", DeviceType::Wgpu),
    ]
}

/// A device in words.
pub fn describe(device: &Device) -> String {
    let Some(identity) = device.identity() else {
        return if *device == Device::flex() { "cpu (flex)".into() } else { "cpu (ndarray)".into() };
    };
    let software = if identity.physical.is_none() { ", software" } else { "" };
    format!("{}{software}", identity.name)
}

#[allow(deprecated, reason = "kept as the second CPU implementation")]
fn ndarray() -> Device {
    Device::ndarray()
}

/// A device that is a card, not a software adapter.
fn real_gpu() -> Option<Device> {
    gpus().into_iter().flat_map(|(_, kind)| devices(kind)).find(is_card)
}

fn devices(kind: DeviceType) -> Vec<Device> {
    let is_wgpu = matches!(kind, DeviceType::Wgpu);
    quietly(|| if is_wgpu && adapter::is_opengl() { Vec::new() } else { Device::enumerate(kind).into_vec() })
}

/// Runs `look`, taking a panic for "nothing there": the graphics layer panics where no driver answers.
fn quietly(look: impl FnOnce() -> Vec<Device> + std::panic::UnwindSafe) -> Vec<Device> {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let found = std::panic::catch_unwind(look);
    std::panic::set_hook(hook);
    found.unwrap_or_default()
}

fn nth(name: &str, kind: DeviceType, index: Option<usize>) -> Result<Device, Failure> {
    let devices = devices(kind);
    let found = devices.len();
    match index {
        _ if found == 0 => Err(unknown(
            name,
            "no adapter answers; is there a card, and is its driver installed (Vulkan, not OpenGL)?",
        )),
        // Without an index the runtime's own choice: the fastest card.
        None if name == "wgpu" => Ok(Device::wgpu(DeviceKind::DefaultDevice)),
        _ => {
            let message = format!("there are {found}, numbered from 0");
            let device = match index {
                Some(index) => devices.into_iter().nth(index),
                None => devices.iter().find(|device| is_card(device)).or(devices.first()).cloned(),
            };
            let device = device.ok_or_else(|| unknown(name, &message))?;
            if name.starts_with("vulkan") && !is_card(&device) {
                // Mesa's ends the program on the first kernel.
                let message = format!("{} does not bear SPIR-V kernels: use wgpu", describe(&device));
                return Err(unknown(name, &message));
            }
            Ok(device)
        }
    }
}

fn is_card(device: &Device) -> bool {
    device.identity().is_some_and(|identity| identity.physical.is_some())
}

fn unknown(name: &str, why: &str) -> Failure {
    let mut there = vec!["auto".to_owned(), "cpu (= flex)".into(), "ndarray".into()];
    for (kind, devices) in gpus().into_iter().map(|(name, kind)| (name, devices(kind))) {
        let listed = devices.iter().enumerate().map(|(i, d)| format!("{kind}:{i} ({})", describe(d)));
        there.extend(listed);
    }
    Failure::Input(format!("--device {name}: {why}. Here there are: {}", there.join(", ")))
}
