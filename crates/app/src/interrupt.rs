//! Ctrl-C: most commands end at once and leave nothing half-written; a training first writes down where it is.

use std::sync::atomic::{AtomicBool, Ordering};

use snapsnap_base::file;

use crate::say;

/// Whether the command ends by itself once it is asked to.
static PATIENT: AtomicBool = AtomicBool::new(false);
/// Whether it was asked to.
static STOP: AtomicBool = AtomicBool::new(false);

/// Whether being ended from outside is how the command ends.
static WELL: AtomicBool = AtomicBool::new(false);

/// Listens to Ctrl-C and to the signal that ends programs.
pub fn listen() {
    let handler = ctrlc::set_handler(|| {
        if PATIENT.load(Ordering::Relaxed) && !STOP.swap(true, Ordering::Relaxed) {
            say::err("stopping after this step; once more ends it at once");
            return;
        }
        // 130 as shells expect, and no temporary file stays behind.
        file::remove_unfinished();
        std::process::exit(if WELL.load(Ordering::Relaxed) { 0 } else { 130 });
    });
    if let Err(e) = handler {
        say::err(&format!("warning: Ctrl-C will not clean up temporary files: {e}"));
    }
}

/// From now on the first Ctrl-C sets the flag that is returned instead of ending the program.
pub fn patiently() -> &'static AtomicBool {
    PATIENT.store(true, Ordering::Relaxed);
    &STOP
}

/// From now on Ctrl-C is how the command ends, and no failure.
pub fn end_well() {
    WELL.store(true, Ordering::Relaxed);
}
