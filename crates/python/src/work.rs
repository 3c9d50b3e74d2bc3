//! Work beside the interpreter, and its errors.

use std::panic::resume_unwind;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use snapsnap::Failure;

/// Time between two looks for Ctrl-C.
const TICK: Duration = Duration::from_millis(5);
/// Stack of the working thread, as large as a program's main thread's.
const STACK: usize = 8 << 20;

pyo3::create_exception!(
    snapsnap,
    InputError,
    PyValueError,
    "An input that cannot be used. The message names the file or the argument."
);

/// What ends the work after Ctrl-C.
struct Stopped;

/// Runs `work` on a thread of its own, without the interpreter's lock. Ctrl-C and other signals raise their exceptions
/// at once; the work then ends where it next calls its argument.
///
/// # Errors
/// The work's, or a signal handler's.
pub fn run<T: Send + 'static>(
    py: Python<'_>,
    work: impl FnOnce(&dyn Fn()) -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    let stop = Arc::new(AtomicBool::new(false));
    let (is_over, caller) = (Arc::clone(&stop), thread::current());
    let worker = move || {
        let made = work(&|| {
            if is_over.load(Ordering::Relaxed) {
                resume_unwind(Box::new(Stopped));
            }
        });
        caller.unpark();
        made
    };
    let worker = thread::Builder::new().stack_size(STACK).spawn(worker)?;
    while !worker.is_finished() {
        py.detach(|| thread::park_timeout(TICK));
        py.check_signals().inspect_err(|_| stop.store(true, Ordering::Relaxed))?;
    }
    match worker.join() {
        Ok(made) => made.map_err(exception),
        // The panic itself is on stderr.
        Err(_) => {
            Err(PyRuntimeError::new_err("a fault of this package: please report what is printed above"))
        }
    }
}

/// The exception of a failure.
pub fn exception(failure: Failure) -> PyErr {
    let text = failure.to_string();
    // Arguments of Python have no dashes.
    let text = text.strip_prefix("--").unwrap_or(&text).to_owned();
    match failure {
        Failure::Input(_) => InputError::new_err(text),
        Failure::Write(_) => PyOSError::new_err(text),
        Failure::Internal(_) => PyRuntimeError::new_err(text),
    }
}

/// The error for an unsuitable argument.
pub fn unsuitable(argument: &str, message: &str) -> Failure {
    Failure::file(Path::new(argument), message)
}
