//! How far a run has come.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::precision::LossScale;

/// How far a run has come.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Which stage is trained, 1 or 2.
    pub stage: u32,
    /// Steps so far, those that were skipped included.
    pub step: u64,
    /// Steps that were skipped because a loss or gradient was not finite, or a sample could not be read.
    pub skipped: u64,
    /// Those of them that came one after another up to here.
    pub skipped_in_a_row: u64,
    /// Step of the best validation, and the bits of its score, which decimals might change.
    pub best: Option<(u64, u64)>,
    /// The step at which the run ended with a validation and a preview, 0 while it has not.
    #[serde(default)]
    pub shown: u64,
    /// What the loss is scaled by, in f16.
    pub loss_scale: Option<LossScale>,
    /// AdamW's steps so far by parameter.
    pub times: BTreeMap<String, u64>,
}
