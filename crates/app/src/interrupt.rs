//! Ctrl-C: most commands end at once and leave nothing half-written; a training first writes down where it is.

use std::sync::atomic::{AtomicBool, Ordering};

use snapsnap_splat::file;

use crate::say;

/// Whether the command ends by itself once it is asked to.
static PATIENT: AtomicBool = AtomicBool::new(false);
/// Whether it was asked to.
static STOP: AtomicBool = AtomicBool::new(false);

/// Listens to Ctrl-C and to the signal that ends programs.
pub fn listen() {
    let handler = ctrlc::set_handler(|| {
        if PATIENT.load(Ordering::Relaxed) && !STOP.swap(true, Ordering::Relaxed) {
            say::err("stopping after this step; once more ends it at once");
            return;
        }
        // 130 as shells expect, and no temporary file stays behind.
        file::remove_unfinished();
        std::process::exit(130);
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
