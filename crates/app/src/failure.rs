//! Failures of commands: bad input or an output that cannot be written (exit code 2), or other errors (exit code 1).

use std::fmt;
use std::io;
use std::path::Path;

use snapsnap_base::FileError;
use snapsnap_base::config::ConfigError;
use snapsnap_eval::EvalError;
use snapsnap_mesh::fuse::FuseError;
use snapsnap_net::weights::WeightsError;
use snapsnap_rig::RigError;
use snapsnap_splat::SplatError;
use snapsnap_train::TrainError;

/// A failed command.
#[derive(Debug)]
pub enum Failure {
    /// An error that the user can correct: a path, a file's content, a config, a device.
    Input(String),
    /// An output that cannot be written.
    Write(String),
    /// Any other error.
    Internal(String),
}

/// Returns [`Failure::Input`] with a formatted message.
macro_rules! bail {
    ($($argument:tt)*) => {
        return Err($crate::failure::Failure::Input(format!($($argument)*)))
    };
}
pub(crate) use bail;

impl Failure {
    /// A user's error about this file or folder.
    pub fn file(path: &Path, message: impl fmt::Display) -> Self {
        Self::Input(format!("{}: {message}", path.display()))
    }

    /// The operating system refused to write this file.
    pub fn cannot_write(path: &Path, e: &io::Error) -> Self {
        Self::Write(format!("{}: cannot write: {e}", path.display()))
    }

    /// The same message after the name of a file.
    pub fn about(self, path: &Path) -> Self {
        match self {
            Self::Input(message) => Self::file(path, message),
            Self::Write(message) => Self::Write(format!("{}: {message}", path.display())),
            Self::Internal(message) => Self::Internal(format!("{}: {message}", path.display())),
        }
    }

    /// The program's exit code.
    pub fn code(&self) -> u8 {
        match self {
            Self::Input(_) | Self::Write(_) => 2,
            Self::Internal(_) => 1,
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Input(message) | Self::Write(message) | Self::Internal(message) => f.write_str(message),
        }
    }
}

macro_rules! input_error {
    ($($error:ty),+) => {
        $(impl From<$error> for Failure {
            fn from(e: $error) -> Self {
                Self::Input(e.to_string())
            }
        })+
    };
}

input_error!(ConfigError, WeightsError);

impl From<FileError> for Failure {
    fn from(e: FileError) -> Self {
        if matches!(e, FileError::Write { .. }) {
            Self::Write(e.to_string())
        } else {
            Self::Input(e.to_string())
        }
    }
}

impl From<SplatError> for Failure {
    fn from(e: SplatError) -> Self {
        match e {
            SplatError::File(e) => e.into(),
            SplatError::Shape { .. } | SplatError::NotFinite { .. } => Self::Internal(e.to_string()),
            _ => Self::Input(e.to_string()),
        }
    }
}

impl From<FuseError> for Failure {
    fn from(e: FuseError) -> Self {
        match e {
            FuseError::Splat(e) => e.into(),
            FuseError::Reduce(_) => Self::Internal(e.to_string()),
            FuseError::Long(_) => Self::Input(format!("{e}; add --force to make it anyway")),
            _ => Self::Input(e.to_string()),
        }
    }
}

impl From<RigError> for Failure {
    fn from(e: RigError) -> Self {
        match e {
            RigError::Fuse(e) => e.into(),
            RigError::Splat(e) => e.into(),
            _ => Self::Input(e.to_string()),
        }
    }
}

impl From<EvalError> for Failure {
    fn from(e: EvalError) -> Self {
        match e {
            EvalError::Splat(e) => e.into(),
            _ => Self::Input(e.to_string()),
        }
    }
}

impl From<TrainError> for Failure {
    fn from(e: TrainError) -> Self {
        match e {
            TrainError::Splat(e) => e.into(),
            TrainError::File(e) | TrainError::Weights(WeightsError::File(e)) => e.into(),
            TrainError::Stuck { .. } => Self::Internal(e.to_string()),
            _ => Self::Input(e.to_string()),
        }
    }
}
