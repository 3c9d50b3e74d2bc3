//! Ctrl-C. Most commands end at once, without temporary files. A training saves its state first.

use std::sync::atomic::{AtomicBool, Ordering};

use snapsnap_base::file;

use crate::say;

/// Whether the command ends itself after the first Ctrl-C.
static PATIENT: AtomicBool = AtomicBool::new(false);
/// Whether the command must end itself.
static STOP: AtomicBool = AtomicBool::new(false);
/// Whether Ctrl-C is the normal end of the command.
static WELL: AtomicBool = AtomicBool::new(false);

/// Installs the handler of Ctrl-C and of termination signals.
pub fn listen() {
    let handler = ctrlc::set_handler(|| {
        if PATIENT.load(Ordering::Relaxed) && !STOP.swap(true, Ordering::Relaxed) {
            say::err("stopping after this step; once more ends it at once");
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

/// From now on the first Ctrl-C sets the returned flag instead of ending the program.
pub fn patiently() -> &'static AtomicBool {
    PATIENT.store(true, Ordering::Relaxed);
    &STOP
}

/// From now on Ctrl-C ends the program with exit code 0.
pub fn end_well() {
    WELL.store(true, Ordering::Relaxed);
}
