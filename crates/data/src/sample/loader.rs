//! A data loader with bounded memory, whose order does not depend on the number of workers. (Burn's loader keeps up to
//! 100 batches per iterator and mixes the orders of its workers.)

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, JoinHandle};

use burn::data::dataset::{Dataset, DatasetError};
use rand::seq::SliceRandom;

use snapsnap_base::random::stream;

/// Loads batches of items of type `I`.
pub struct Loader<I> {
    dataset: Arc<dyn Dataset<I>>,
    batch: usize,
    workers: usize,
    prefetch: usize,
    /// Seed of the order, if it is random. Every pass has its own order.
    shuffle: Option<u64>,
}

impl<I: 'static> Loader<I> {
    /// Batches of `batch` items, loaded by `workers` threads. At most `workers + prefetch` batches are loaded before
    /// they are taken. The last batch may be smaller.
    ///
    /// # Panics
    /// If `batch` or `workers` is 0.
    pub fn new(dataset: impl Dataset<I> + 'static, batch: usize, workers: usize, prefetch: usize) -> Self {
        assert!(batch > 0 && workers > 0, "{batch} items by {workers} workers");
        Self { dataset: Arc::new(dataset), batch, workers, prefetch, shuffle: None }
    }

    /// The loader with a random order, a new one in every pass.
    pub fn shuffled(mut self, seed: u64) -> Self {
        self.shuffle = Some(seed);
        self
    }
}

/// State that the workers and the consumer share.
#[derive(Default)]
struct Turn {
    /// The batch for the next free worker.
    next: usize,
    /// Number of taken batches.
    taken: usize,
    stop: bool,
}

#[derive(Default)]
struct Turns {
    turn: Mutex<Turn>,
    moved: Condvar,
}

impl Turns {
    fn lock(&self) -> MutexGuard<'_, Turn> {
        self.turn.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until a worker may load another batch, and returns its number; `None` at the end.
    fn claim(&self, total: usize, ahead: usize) -> Option<usize> {
        let mut turn = self.lock();
        while !turn.stop && turn.next < total && turn.next >= turn.taken + ahead {
            turn = self.moved.wait(turn).unwrap_or_else(PoisonError::into_inner);
        }
        let claimed = turn.next;
        (!turn.stop && claimed < total).then(|| {
            turn.next += 1;
            claimed
        })
    }
}

type Loaded<I> = Result<Vec<I>, DatasetError>;

/// Batches of one pass, in their order.
pub struct Batches<I> {
    turns: Arc<Turns>,
    loaded: Receiver<(usize, Loaded<I>)>,
    /// Batches that were loaded before their turn.
    early: BTreeMap<usize, Loaded<I>>,
    workers: Vec<JoinHandle<()>>,
    batch: usize,
    items: usize,
    taken: usize,
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
        let turns = Arc::new(Turns::default());
        let (sender, loaded) = channel();
        let (batch, ahead) = (self.batch, self.workers + self.prefetch);
        let workers = (0..self.workers)
            .map(|worker| {
                let (turns, order, sender) = (turns.clone(), order.clone(), sender.clone());
                let dataset = self.dataset.clone();
                let work = move || work(&turns, &order, batch, ahead, &*dataset, &sender);
                Builder::new().name(format!("loader-{worker}")).spawn(work).expect("a thread starts")
            })
            .collect();
        let items = order.len();
        Batches { turns, loaded, early: BTreeMap::new(), workers, batch, items, taken: 0 }
    }
}

fn work<I>(
    turns: &Turns,
    order: &[usize],
    batch: usize,
    ahead: usize,
    dataset: &dyn Dataset<I>,
    sender: &Sender<(usize, Loaded<I>)>,
) {
    while let Some(claimed) = turns.claim(order.len().div_ceil(batch), ahead) {
        let rows: Vec<usize> = order[claimed * batch..].iter().take(batch).copied().collect();
        let named = format!("a loader's worker panicked, at samples {rows:?}");
        // Without its answer the consumer would wait for ever.
        let loaded = catch_unwind(AssertUnwindSafe(|| dataset.get_many(rows)))
            .unwrap_or_else(|_| Err(DatasetError::new(std::io::Error::other(named))));
        if sender.send((claimed, loaded)).is_err() {
            return;
        }
    }
}

impl<I> Iterator for Batches<I> {
    type Item = Loaded<I>;

    fn next(&mut self) -> Option<Loaded<I>> {
        if self.taken * self.batch >= self.items {
            return None;
        }
        let loaded = loop {
            if let Some(loaded) = self.early.remove(&self.taken) {
                break loaded;
            }
            let (place, loaded) = self.loaded.recv().ok()?;
            self.early.insert(place, loaded);
        };
        self.taken += 1;
        self.turns.lock().taken = self.taken;
        self.turns.moved.notify_all();
        Some(loaded)
    }
}

impl<I> Drop for Batches<I> {
    fn drop(&mut self) {
        self.turns.lock().stop = true;
        self.turns.moved.notify_all();
        for worker in self.workers.drain(..) {
            // Panics of its items were caught.
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
        (Loader::new(numbers, 4, workers, 2), most)
    }

    fn order(batches: Batches<Held>) -> Vec<usize> {
        batches.flat_map(|batch| batch.expect("whole")).map(|held| held.0).collect()
    }

    #[test]
    fn the_order_of_batches_does_not_depend_on_the_workers() {
        for workers in [1, 2, 5] {
            let (loader, _) = loader(103, workers, None);
            assert_eq!(order(loader.batches(0, 0)), (0..103).collect::<Vec<_>>());
        }
        let shuffled = |workers: usize| {
            let loader = loader(50, workers, None).0.shuffled(7);
            [0, 1].map(|pass| order(loader.batches(pass, 0)))
        };
        let [first, second] = shuffled(1);
        let rest = loader(50, 3, None).0.shuffled(7).batches(1, 5);
        assert_eq!(order(rest), second[20..]);
        assert_eq!(loader(50, 2, None).0.batches(0, 13).count(), 0);
        assert_eq!([first.clone(), second.clone()], shuffled(3));
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
