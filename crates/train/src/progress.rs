//! Progress of a run.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::precision::LossScale;

/// Progress of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Stage of the training, 1 or 2.
    pub stage: u32,
    /// Steps so far, including skipped ones.
    pub step: u64,
    /// Steps that were skipped because a loss or gradient was not finite, or because a sample could not be read.
    pub skipped: u64,
    /// Skipped steps since the last one that was made.
    pub skipped_in_a_row: u64,
    /// Step of the best validation, and the bits of its score, since decimals might round it.
    pub best: Option<(u64, u64)>,
    /// Step after which the final validation and preview were made; 0 before.
    #[serde(default)]
    pub shown: u64,
    /// Scale of the loss, in f16.
    pub loss_scale: Option<LossScale>,
    /// Number of AdamW's steps by parameter.
    pub times: BTreeMap<String, u64>,
}
