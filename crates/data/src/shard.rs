//! Shards of the work.

use std::str::FromStr;

/// One of several machines that share the work: `i/n`, with i from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    index: usize,
    count: usize,
}

impl Shard {
    /// The shard in file names, such as `0-of-4`.
    pub fn name(self) -> String {
        format!("{}-of-{}", self.index, self.count)
    }

    /// Whether the subject with this index belongs to this shard.
    pub fn has(self, place: usize) -> bool {
        place % self.count == self.index
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((index, count)) if index < count => Ok(Self { index, count }),
            _ => Err(format!("`{text}` is no shard: expected i/n, with i from 0 to n − 1")),
        }
    }
}
