//! Fuzzing of everything that the program reads from a file.
//!
//! Each [`Format`] says how a small sound sample of it is made and which command reads it. A case is that sample, changed
//! as a seed says, and the command run on it as a user would; `judge` knows what must hold then, for all formats alike.
//! A new format is one more entry in [`formats`], and gets everything else for free.
//!
//! Cases run in processes of their own: a stack that overflows, memory that runs out and a pipe that is waited for show
//! only from outside.

mod bytes;
pub mod campaign;
mod case;
mod child;
mod envelope;
pub mod formats;
mod judge;
mod report;
mod text;
mod tree;

use std::path::Path;

pub use case::Case;

/// Where everything random comes from.
pub type Random = rand_chacha::ChaCha8Rng;

/// Name of the folder of inputs, as commands call it.
pub const INPUTS: &str = "in";

/// Another name of it, that a terminal would obey and that is no UTF-8.
const ODD_INPUTS: &[u8] = b"in \x1b[31m\xff\xc2\x9b32m \xe4\xba\xba";

/// Something that the program reads.
pub struct Format {
    /// By which cases are called.
    pub name: &'static str,
    /// Writes a sound sample into this empty folder, the smaller the better.
    pub sample: fn(&Path),
    /// Endings of the paths of the sample's files that are changed.
    pub changed: &'static [&'static str],
    /// Command line that reads the sample; files of the sample are in the folder [`INPUTS`].
    pub command: &'static str,
    /// The file that the command writes, if it is one: one of that name may be there already.
    pub file: Option<&'static str>,
    /// Whether the command does what it can without the parts that it cannot read, names those, and ends with code 1.
    pub partial: bool,
    /// Files that may be left though the input is refused.
    pub kept: &'static [&'static str],
    /// Whether what a successful command wrote into this folder is whole; else what is wrong.
    pub whole: fn(&Path) -> Result<(), String>,
    /// Cases in a short run, and among those of the other formats in a long one.
    pub share: u64,
}
