//! Failures of commands: bad input or an output that cannot be written (exit code 2), or other errors (exit code 1).

use std::fmt;
use std::path::Path;

use snapsnap_base::FileError;
use snapsnap_base::config::ConfigError;
use snapsnap_eval::EvalError;
use snapsnap_mesh::fuse::FuseError;
use snapsnap_net::weights::WeightsError;
use snapsnap_photo::NoPerson;
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

/// Turns errors into failures with the same message: as their patterns say, else into [`Failure::Input`].
macro_rules! from_errors {
    ($($error:ident { $($pattern:pat => $failure:expr,)* })+) => {
        $(impl From<$error> for Failure {
            fn from(e: $error) -> Self {
                match e {
                    $($pattern => $failure,)*
                    e => Self::Input(e.to_string()),
                }
            }
        })+
    };
}

from_errors! {
    ConfigError {}
    WeightsError {}
    NoPerson {}
    FileError {
        e @ FileError::Write { .. } => Self::Write(e.to_string()),
    }
    SplatError {
        SplatError::File(e) => e.into(),
        e @ (SplatError::Shape { .. } | SplatError::NotFinite { .. }) => Self::Internal(e.to_string()),
    }
    FuseError {
        FuseError::Splat(e) => e.into(),
        e @ FuseError::Reduce(_) => Self::Internal(e.to_string()),
        e @ FuseError::Long(_) => Self::Input(format!("{e}; add --force to make it anyway")),
    }
    RigError {
        RigError::Fuse(e) => e.into(),
        RigError::Splat(e) => e.into(),
    }
    EvalError {
        EvalError::Splat(e) => e.into(),
    }
    TrainError {
        TrainError::Splat(e) => e.into(),
        TrainError::File(e) | TrainError::Weights(WeightsError::File(e)) => e.into(),
        e @ TrainError::Stuck { .. } => Self::Internal(e.to_string()),
    }
}
