//! Ctrl-C and termination signals. Most commands remove their temporary files and end. Training saves its state first.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};

use snapsnap_base::file;

use crate::say;

/// Whether the command ends itself after the first signal.
static PATIENT: AtomicBool = AtomicBool::new(false);
/// Whether there was a signal.
static SIGNALLED: AtomicBool = AtomicBool::new(false);
/// Whether the command must end itself.
static STOP: LazyLock<Arc<AtomicBool>> = LazyLock::new(Arc::default);
/// Whether the signal was SIGTERM or SIGUSR1.
static TERMINATED: LazyLock<Arc<AtomicBool>> = LazyLock::new(Arc::default);
/// Whether Ctrl-C is the normal end of the command.
static WELL: AtomicBool = AtomicBool::new(false);

/// Installs the handler of Ctrl-C and of termination signals.
pub fn listen() {
    let handler = ctrlc::set_handler(|| {
        if PATIENT.load(Ordering::Relaxed) && !SIGNALLED.swap(true, Ordering::Relaxed) {
            STOP.store(true, Ordering::Relaxed);
            say::note("stopping after this step; a second signal stops at once");
            return;
        }
        file::remove_unfinished();
        // 130 is the convention of shells for an interrupted command.
        std::process::exit(if WELL.load(Ordering::Relaxed) { 0 } else { 130 });
    });
    if let Err(e) = handler {
        say::err(&format!("warning: Ctrl-C will not clean up temporary files: {e}"));
    }
}

/// From now on the first signal sets the returned flag instead of ending the program. SIGUSR1 counts as a signal:
/// batch systems can send it before a job's time is over.
pub fn patiently() -> &'static AtomicBool {
    PATIENT.store(true, Ordering::Relaxed);
    #[cfg(unix)]
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGUSR1] {
        for flag in [&TERMINATED, &STOP] {
            if let Err(e) = signal_hook::flag::register(signal, Arc::clone(flag)) {
                say::err(&format!("warning: signal {signal} cannot be handled: {e}"));
            }
        }
    }
    &STOP
}

/// Whether SIGTERM or SIGUSR1 came.
pub fn was_terminated() -> bool {
    TERMINATED.load(Ordering::Relaxed)
}

/// From now on Ctrl-C ends the program with exit code 0.
pub fn end_well() {
    WELL.store(true, Ordering::Relaxed);
}
