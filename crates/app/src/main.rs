//! The program `snapsnap`.

use std::process::ExitCode;

fn main() -> ExitCode {
    snapsnap::set_up();
    let program: Vec<_> = std::env::current_exe().map(Into::into).into_iter().collect();
    ExitCode::from(snapsnap::main(&program, std::env::args_os().skip(1).collect()))
}
