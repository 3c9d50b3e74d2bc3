//! How much memory there is, so that what cannot fit is refused before any work instead of ending in an abort.

use std::fs;

use burn::tensor::Device;
use snapsnap_net::weights::WeightFile;
use sysinfo::{MemoryRefreshKind, RefreshKind, System};

use crate::failure::Failure;

/// Refuses work on the CPU that needs more bytes than this process can ever get; `what` and `mend` say what it is and
/// how it needs less.
pub fn check(what: &str, needed: u64, mend: &str) -> Result<(), Failure> {
    let there = there();
    if needed <= there {
        return Ok(());
    }
    let gigabytes = |bytes: u64| bytes as f64 / 1e9;
    let message = format!(
        "{what} needs {:.1} GB of memory, this machine has {:.1} GB: {mend}",
        gigabytes(needed),
        gigabytes(there)
    );
    Err(Failure::Input(message))
}

/// Whether the device is the processor, whose memory is the machine's.
pub fn is_cpu(device: &Device) -> bool {
    device.identity().is_none()
}

/// Refuses networks whose canvas this process can never compute on the CPU.
pub fn check_networks(weights: &WeightFile, device: &Device) -> Result<(), Failure> {
    if !is_cpu(device) {
        return Ok(());
    }
    let what = format!("a canvas of {0}×{0} pixels", weights.config.network.resolution);
    check(&what, weights.config.memory_needed(weights.parameters()), "choose a smaller `network.resolution`")
}

/// Bytes that the machine has, or, where that is less, that this process is allowed.
pub fn there() -> u64 {
    let memory = RefreshKind::nothing().with_memory(MemoryRefreshKind::everything());
    let system = System::new_with_specifics(memory);
    // 0 where the system is not known.
    let total =
        Some(system.total_memory() + system.total_swap()).filter(|bytes| *bytes > 0).unwrap_or(u64::MAX);
    let group = system.cgroup_limits().map_or(u64::MAX, |limits| limits.total_memory);
    total.min(group).min(address_space().unwrap_or(u64::MAX))
}

/// Bytes that this process has at the moment, where the system tells.
pub fn used() -> Option<u64> {
    status("VmRSS")
}

/// Bytes that this process had at most, where the system tells.
pub fn most_used() -> Option<u64> {
    status("VmHWM")
}

fn status(key: &str) -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
    Some(line.split_whitespace().next()?.parse::<u64>().ok()? * 1024)
}

/// The limit that `ulimit -v` sets, in bytes.
fn address_space() -> Option<u64> {
    let limits = fs::read_to_string("/proc/self/limits").ok()?;
    let line = limits.lines().find_map(|line| line.strip_prefix("Max address space"))?;
    line.split_whitespace().next()?.parse().ok()
}
