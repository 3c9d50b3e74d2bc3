//! The kernel of AMX. Rust has no stable intrinsics for tiles, but inline assembly knows their instructions.

#![allow(unsafe_code, reason = "inline assembly")]

use std::arch::asm;
use std::arch::x86_64::__cpuid_count;

use super::{Left, PAIRS, PANEL, Right, SLACK, Sums, Unit, unit};

/// Whether the processor has tiles for bf16, and Linux lets this process use them. Linux keeps the registers of tiles,
/// 8 KiB per thread, only for processes that asked.
pub fn permitted() -> bool {
    /// Bits of EDX in leaf 7: AMX-BF16 and AMX-TILE.
    const FEATURES: u32 = 1 << 22 | 1 << 24;
    let leaves = __cpuid_count(0, 0).eax;
    leaves >= 7 && __cpuid_count(7, 0).edx & FEATURES == FEATURES && request()
}

/// `arch_prctl(ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA)`, for all threads of the process.
#[cfg(target_os = "linux")]
fn request() -> bool {
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: i64 = 0x1023;
    const XFEATURE_XTILEDATA: i64 = 18;
    let mut result = ARCH_PRCTL;
    // SAFETY: the system call touches no memory of this process; it clobbers RCX and R11.
    unsafe {
        asm!(
            "syscall",
            inlateout("rax") result,
            in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") XFEATURE_XTILEDATA,
            out("rcx") _,
            out("r11") _,
            options(nostack),
        );
    }
    result == 0
}

#[cfg(not(target_os = "linux"))]
fn request() -> bool {
    false
}

/// While it lives, this thread's tiles are configured: eight of 16 rows of 64 bytes.
pub struct Tiles(());

impl Tiles {
    /// Configures the tiles.
    ///
    /// # Panics
    /// If there are none for this process.
    pub fn configured() -> Self {
        assert_eq!(unit(), Some(Unit::Amx), "this processor has tiles");
        #[repr(align(64))]
        struct Config([u8; 64]);
        let mut config = Config([0; 64]);
        // The palette; then bytes per row (two bytes each, from byte 16 on) and rows (from byte 48 on) of every tile.
        config.0[0] = 1;
        for tile in 0..8 {
            config.0[16 + 2 * tile] = 64;
            config.0[48 + tile] = 16;
        }
        // SAFETY: the processor has tiles, and the process has the permission.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &raw const config, options(nostack, preserves_flags)) };
        Self(())
    }
}

impl Drop for Tiles {
    fn drop(&mut self) {
        // SAFETY: as above. It lets the system forget the registers when it switches threads.
        unsafe { asm!("tilerelease", options(nostack, preserves_flags)) };
    }
}

/// Sums of 32 rows from `row` on, in four tiles, which are configured.
pub fn block(_tiles: &Tiles, left: &Left, row: usize, panel: &Right, sums: &mut Sums) {
    let blocks = left.starts.len();
    assert!(blocks > 0 && panel.starts.len() == blocks);
    let last = left.starts.iter().max().map_or(0, |start| start + row + SLACK);
    assert!(last <= left.values.len(), "blocks lie inside");
    let last = panel.starts.iter().max().map_or(0, |start| start + (PAIRS - 1) * panel.pair + PANEL);
    assert!(last <= panel.values.len(), "the panel lies inside");
    // SAFETY: every block reads 32 rows of 64 bytes of the left factor, and 16 pairs of 128 bytes of the panel; 32 rows of
    // 128 bytes are written. The assertions, and the type of `sums`, say that all of it is there.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "2:",
            // The block's first row.
            "mov {rows}, qword ptr [{starts}]",
            "shl {rows}, 6",
            "add {rows}, {left}",
            "tileloadd tmm4, [{rows} + {row}*1]",
            "tileloadd tmm5, [{rows} + {row}*1 + 1024]",
            // The block's first pair.
            "mov {rows}, qword ptr [{firsts}]",
            "lea {rows}, [{panel} + {rows}*4]",
            "tileloadd tmm6, [{rows} + {pair}*1]",
            "tileloadd tmm7, [{rows} + {pair}*1 + 64]",
            "tdpbf16ps tmm0, tmm4, tmm6",
            "tdpbf16ps tmm1, tmm4, tmm7",
            "tdpbf16ps tmm2, tmm5, tmm6",
            "tdpbf16ps tmm3, tmm5, tmm7",
            "add {starts}, 8",
            "add {firsts}, 8",
            "dec {blocks}",
            "jnz 2b",
            "tilestored [{sums} + {line}*1], tmm0",
            "tilestored [{sums} + {line}*1 + 64], tmm1",
            "tilestored [{sums} + {line}*1 + 2048], tmm2",
            "tilestored [{sums} + {line}*1 + 2112], tmm3",
            rows = out(reg) _,
            starts = inout(reg) left.starts.as_ptr() => _,
            firsts = inout(reg) panel.starts.as_ptr() => _,
            panel = in(reg) panel.values.as_ptr(),
            blocks = inout(reg) blocks => _,
            left = in(reg) left.values[row..].as_ptr(),
            sums = in(reg) sums.as_mut_ptr(),
            row = in(reg) 64_usize,
            line = in(reg) 128_usize,
            pair = in(reg) 4 * panel.pair,
            options(nostack),
        );
    }
}
