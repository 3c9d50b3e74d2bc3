//! Several data sets as one.

use burn::data::dataset::{Dataset, DatasetError};

/// The items of all data sets, one set after another.
pub struct Joined<I>(Vec<Box<dyn Dataset<I>>>);

impl<I> Joined<I> {
    /// Joins data sets.
    pub fn new(sets: Vec<Box<dyn Dataset<I>>>) -> Self {
        Self(sets)
    }
}

impl<I: Send + Sync + 'static> Dataset<I> for Joined<I> {
    fn get(&self, index: usize) -> Result<I, DatasetError> {
        let mut rest = index;
        for set in &self.0 {
            if rest < set.len() {
                return set.get(rest);
            }
            rest -= set.len();
        }
        panic!("sample {index} of {}", self.len());
    }

    fn len(&self) -> usize {
        self.0.iter().map(|set| set.len()).sum()
    }
}
