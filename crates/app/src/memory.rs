//! Limits and use of memory. Work that cannot fit is refused instead of aborted.

use std::fs;

use burn::tensor::Device;
use snapsnap_net::weights::WeightFile;
pub use snapsnap_ops::is_cpu;
use sysinfo::{MemoryRefreshKind, RefreshKind, System};

use crate::failure::{Failure, bail};

/// Refuses work on the CPU that needs more bytes than this process can have. The message contains the work (`what`) and
/// the remedy (`mend`).
pub fn check(what: &str, needed: u64, mend: &str) -> Result<(), Failure> {
    let there = there();
    if needed <= there {
        return Ok(());
    }
    let [needed, there] = [needed, there].map(|bytes| bytes as f64 / 1e9);
    bail!("{what} needs {needed:.1} GB of memory, but this process can have only {there:.1} GB: {mend}")
}

/// The device. Refuses the CPU if the networks need more memory than this process can have.
pub fn with_room(device: Device, weights: &WeightFile) -> Result<Device, Failure> {
    if is_cpu(&device) {
        let what = format!("a canvas of {0}×{0} pixels", weights.config.network.resolution);
        let needed = weights.config.memory_needed(weights.parameters());
        check(&what, needed, "choose a smaller `network.resolution`")?;
    }
    Ok(device)
}

/// Memory of the machine in bytes, or the limit of this process if it is smaller.
pub fn there() -> u64 {
    let memory = RefreshKind::nothing().with_memory(MemoryRefreshKind::everything());
    let system = System::new_with_specifics(memory);
    // 0 on unknown systems.
    let total =
        Some(system.total_memory() + system.total_swap()).filter(|bytes| *bytes > 0).unwrap_or(u64::MAX);
    let group = system.cgroup_limits().map_or(u64::MAX, |limits| limits.total_memory);
    total.min(group).min(address_space().unwrap_or(u64::MAX))
}

/// Current memory of this process in bytes, on Linux.
pub fn used() -> Option<u64> {
    status("VmRSS:")
}

/// Largest memory of this process so far in bytes, on Linux.
pub fn most_used() -> Option<u64> {
    status("VmHWM:")
}

fn status(key: &str) -> Option<u64> {
    Some(number("/proc/self/status", key)? * 1024)
}

/// The limit that `ulimit -v` sets, in bytes, without addresses that this process has reserved and does not use.
fn address_space() -> Option<u64> {
    let limit = number("/proc/self/limits", "Max address space")?;
    let reserved = status("VmSize:")?.saturating_sub(used()?);
    Some(limit.saturating_sub(reserved))
}

/// The number behind `key` in a file of lines.
fn number(file: &str, key: &str) -> Option<u64> {
    let text = fs::read_to_string(file).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    line.split_whitespace().next()?.parse().ok()
}
