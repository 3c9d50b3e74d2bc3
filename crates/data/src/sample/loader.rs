//! A data loader with bounded memory, whose order does not depend on the number of workers. (Burn's loader keeps up to
//! 100 batches per iterator and mixes the orders of its workers.)

use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::{Builder, JoinHandle};

use burn::data::dataset::{Dataset, DatasetError};
use rand::seq::SliceRandom;

use snapsnap_base::random::stream;

/// Loads batches of items of type `I`.
pub struct Loader<I> {
    /// The items.
    pub dataset: Arc<dyn Dataset<I>>,
    /// Items of a batch; the last one may be smaller.
    pub batch: usize,
    /// Threads.
    pub workers: usize,
    /// At most `workers + prefetch` batches are loaded before they are taken.
    pub prefetch: usize,
    /// Seed of the order, if it is random. Every pass has its own order.
    pub shuffle: Option<u64>,
    /// The part of every batch that is loaded, and the number of parts.
    pub part: [usize; 2],
}

/// The rows of part `part`, if `parts` parts share `count` rows evenly.
pub fn share([part, parts]: [usize; 2], count: usize) -> Range<usize> {
    part * count / parts..(part + 1) * count / parts
}

type Loaded<I> = Result<Vec<I>, DatasetError>;

/// Batches of one pass, in their order.
pub struct Batches<I> {
    /// The channel of each worker. Workers load batches in turn.
    loaded: Vec<Receiver<Loaded<I>>>,
    workers: Vec<JoinHandle<()>>,
    /// Numbers of the batches that were not taken.
    left: Range<usize>,
}

impl<I: Send + Sync + 'static> Loader<I> {
    /// A pass without its first `skipped` batches.
    pub fn batches(&self, pass: u64, skipped: usize) -> Batches<I> {
        let mut order: Vec<usize> = (0..self.dataset.len()).collect();
        if let Some(seed) = self.shuffle {
            order.shuffle(&mut stream(&format!("order/{seed}/{pass}")));
        }
        order.drain(..(skipped * self.batch).min(order.len()));
        let order = Arc::new(order);
        let (batch, count, part) = (self.batch, self.workers, self.part);
        let start = |worker: usize| {
            let (dataset, order) = (self.dataset.clone(), order.clone());
            // The prefetched batches are divided among the workers. Each worker holds one more, which it loads.
            let (sender, loaded) = sync_channel((self.prefetch + count - 1 - worker) / count);
            let work = move || {
                for rows in order.chunks(batch).skip(worker).step_by(count) {
                    let rows = &rows[share(part, rows.len())];
                    let panicked = |_| {
                        let message = format!("a loader's worker panicked, at samples {rows:?}");
                        Err(DatasetError::new(std::io::Error::other(message)))
                    };
                    let get = AssertUnwindSafe(|| dataset.get_many(rows.to_vec()));
                    if sender.send(catch_unwind(get).unwrap_or_else(panicked)).is_err() {
                        return;
                    }
                }
            };
            (loaded, Builder::new().name(format!("loader-{worker}")).spawn(work).expect("a thread starts"))
        };
        let (loaded, workers) = (0..count).map(start).unzip();
        Batches { loaded, workers, left: 0..order.len().div_ceil(batch) }
    }
}

impl<I> Iterator for Batches<I> {
    type Item = Loaded<I>;

    fn next(&mut self) -> Option<Loaded<I>> {
        let number = self.left.next()?;
        self.loaded[number % self.loaded.len()].recv().ok()
    }
}

impl<I> Drop for Batches<I> {
    fn drop(&mut self) {
        // A worker ends when its channel has no receiver.
        self.loaded.clear();
        for worker in self.workers.drain(..) {
            // Panics while an item was loaded were caught.
            let _ = worker.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    use super::*;

    /// Numbers, one of which may be broken.
    struct Numbers {
        count: usize,
        broken: Option<usize>,
        alive: Arc<AtomicUsize>,
        most: Arc<AtomicUsize>,
    }

    #[derive(Debug)]
    struct Held(usize, Arc<AtomicUsize>);

    impl Drop for Held {
        fn drop(&mut self) {
            self.1.fetch_sub(1, Ordering::SeqCst);
        }
    }

    impl Dataset<Held> for Numbers {
        fn get(&self, index: usize) -> Result<Held, DatasetError> {
            std::thread::sleep(Duration::from_micros((index * 7919 % 13) as u64 * 50));
            if self.broken == Some(index) {
                return Err(DatasetError::new(std::io::Error::other(format!("item {index} is broken"))));
            }
            assert!(self.broken != Some(index + 1000), "deliberate");
            let alive = self.alive.fetch_add(1, Ordering::SeqCst) + 1;
            self.most.fetch_max(alive, Ordering::SeqCst);
            Ok(Held(index, self.alive.clone()))
        }

        fn len(&self) -> usize {
            self.count
        }
    }

    fn loader(count: usize, workers: usize, broken: Option<usize>) -> (Loader<Held>, Arc<AtomicUsize>) {
        let most = Arc::new(AtomicUsize::new(0));
        let numbers = Numbers { count, broken, alive: Arc::default(), most: most.clone() };
        let dataset = Arc::new(numbers);
        (Loader { dataset, batch: 4, workers, prefetch: 2, shuffle: None, part: [0, 1] }, most)
    }

    fn shuffled(workers: usize, part: [usize; 2]) -> Loader<Held> {
        Loader { shuffle: Some(7), part, ..loader(50, workers, None).0 }
    }

    fn order(batches: Batches<Held>) -> Vec<usize> {
        batches.flat_map(order_of).collect()
    }

    fn order_of(batch: Loaded<Held>) -> Vec<usize> {
        batch.expect("whole").iter().map(|held| held.0).collect()
    }

    #[test]
    fn the_order_of_batches_does_not_depend_on_the_workers() {
        for workers in [1, 2, 5] {
            let (loader, _) = loader(103, workers, None);
            assert_eq!(order(loader.batches(0, 0)), (0..103).collect::<Vec<_>>());
        }
        let passes = |workers: usize| [0, 1].map(|pass| order(shuffled(workers, [0, 1]).batches(pass, 0)));
        let [first, second] = passes(1);
        assert_eq!(order(shuffled(3, [0, 1]).batches(1, 5)), second[20..]);
        assert_eq!(loader(50, 2, None).0.batches(0, 13).count(), 0);
        assert_eq!([first.clone(), second.clone()], passes(3));
        // Parts of batches of 4, the last of which has 2.
        let batches = |part: usize| shuffled(2, [part, 3]).batches(0, 0);
        let mut parts = [0, 1, 2].map(|part| batches(part).map(order_of).collect::<Vec<_>>());
        let joined: Vec<usize> = (0..13)
            .flat_map(|batch| parts.each_mut().map(|part| std::mem::take(&mut part[batch])).concat())
            .collect();
        assert_eq!(joined, first);
        assert_ne!(first, second);
        let mut sorted = first;
        sorted.sort_unstable();
        assert_eq!(sorted, (0..50).collect::<Vec<_>>());
    }

    #[test]
    fn the_number_of_loaded_items_is_bounded() {
        let (loader, most) = loader(400, 3, None);
        for batch in loader.batches(0, 0) {
            std::thread::sleep(Duration::from_millis(1));
            drop(batch);
        }
        // Batches of 4: three that are being loaded, two loaded, one taken.
        let most = most.load(Ordering::SeqCst);
        assert!(most <= 4 * 6, "{most}");
    }

    #[test]
    fn errors_and_panics_reach_the_consumer_and_the_rest_goes_on() {
        let (loader, _) = loader(40, 2, Some(9));
        let results: Vec<_> = loader.batches(0, 0).collect();
        assert_eq!(results.len(), 10);
        assert_eq!(results[2].as_ref().expect_err("broken").to_string(), "item 9 is broken");
        assert_eq!(results.iter().filter(|r| r.is_err()).count(), 1);
        let (loader, _) = self::loader(40, 2, Some(1009));
        let results: Vec<_> = loader.batches(0, 0).collect();
        assert!(results[2].as_ref().expect_err("panicked").to_string().contains("panicked"));
        // Workers of a dropped iterator end as well.
        drop(loader.batches(0, 0).next());
    }
}
