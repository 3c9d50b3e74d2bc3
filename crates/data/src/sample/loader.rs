//! A data loader with workers whose memory is bounded, and whose batches come in the same order however many workers there
//! are. (Burn's own keeps up to 100 batches per iterator and mixes the workers' orders.)

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, JoinHandle};

use burn::data::dataloader::batcher::Batcher;
use burn::data::dataloader::{DataLoader, DataLoaderIterator, Progress};
use burn::data::dataset::{Dataset, DatasetError};
use burn::tensor::Device;
use rand::seq::SliceRandom;

use snapsnap_base::random::stream;

/// Loads batches of items of type `I` as `O`.
pub struct Loader<I, O> {
    dataset: Arc<dyn Dataset<I>>,
    batcher: Arc<dyn Batcher<I, O>>,
    batch: usize,
    workers: usize,
    prefetch: usize,
    /// Seed of the order, if it is random; every pass has another.
    shuffle: Option<u64>,
    device: Device,
    /// Items that are loaded.
    range: std::ops::Range<usize>,
    passes: AtomicU64,
}

impl<I: 'static, O: 'static> Loader<I, O> {
    /// Batches of `batch` items on `device`, made by `workers` threads; ready or in the making are at most
    /// `workers + prefetch`. The last batch may be smaller.
    ///
    /// # Panics
    /// If `batch` or `workers` is 0.
    pub fn new(
        dataset: impl Dataset<I> + 'static,
        batcher: impl Batcher<I, O> + 'static,
        batch: usize,
        workers: usize,
        prefetch: usize,
        device: &Device,
    ) -> Self {
        assert!(batch > 0 && workers > 0, "{batch} items by {workers} workers");
        let range = 0..dataset.len();
        Self {
            dataset: Arc::new(dataset),
            batcher: Arc::new(batcher),
            batch,
            workers,
            prefetch,
            shuffle: None,
            device: device.clone(),
            range,
            passes: AtomicU64::new(0),
        }
    }

    /// In random order, another in every pass.
    pub fn shuffled(mut self, seed: u64) -> Self {
        self.shuffle = Some(seed);
        self
    }

    /// Begins with the order of this pass, as a training that goes on does.
    pub fn from_pass(self, pass: u64) -> Self {
        self.passes.store(pass, Ordering::Relaxed);
        self
    }

    fn with(&self, device: &Device, range: std::ops::Range<usize>) -> Self {
        Self {
            dataset: self.dataset.clone(),
            batcher: self.batcher.clone(),
            device: device.clone(),
            range,
            passes: AtomicU64::new(self.passes.load(Ordering::Relaxed)),
            ..*self
        }
    }
}

/// What workers and the consumer share.
#[derive(Default)]
struct Turn {
    /// Batch that the next free worker makes.
    next: usize,
    /// Batches that were taken.
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

    /// The batch that a worker is to make, once it may.
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

type Made<O> = Result<O, DatasetError>;

/// Batches of one pass, in their order.
pub struct Batches<O> {
    turns: Arc<Turns>,
    made: Receiver<(usize, Made<O>)>,
    /// Made before their turn.
    early: BTreeMap<usize, Made<O>>,
    workers: Vec<JoinHandle<()>>,
    batch: usize,
    items: usize,
    taken: usize,
}

impl<I: Send + Sync + 'static, O: Send + 'static> Loader<I, O> {
    /// The next pass without its first `skipped` batches, as a training that goes on needs it.
    pub fn batches(&self, skipped: usize) -> Batches<O> {
        let mut order: Vec<usize> = self.range.clone().collect();
        if let Some(seed) = self.shuffle {
            let pass = self.passes.fetch_add(1, Ordering::Relaxed);
            order.shuffle(&mut stream(&format!("order/{seed}/{pass}")));
        }
        order.drain(..(skipped * self.batch).min(order.len()));
        let order = Arc::new(order);
        let turns = Arc::new(Turns::default());
        let (sender, made) = channel();
        let ahead = self.workers + self.prefetch;
        let workers = (0..self.workers)
            .map(|worker| {
                let (turns, order, sender) = (turns.clone(), order.clone(), sender.clone());
                let (dataset, batcher) = (self.dataset.clone(), self.batcher.clone());
                let (batch, device) = (self.batch, self.device.clone());
                let work = move || work(&turns, &order, batch, ahead, &*dataset, &*batcher, &device, &sender);
                Builder::new().name(format!("loader-{worker}")).spawn(work).expect("a thread starts")
            })
            .collect();
        let items = order.len();
        Batches { turns, made, early: BTreeMap::new(), workers, batch: self.batch, items, taken: 0 }
    }
}

#[allow(clippy::too_many_arguments, reason = "a thread's whole world")]
fn work<I, O>(
    turns: &Turns,
    order: &[usize],
    batch: usize,
    ahead: usize,
    dataset: &dyn Dataset<I>,
    batcher: &dyn Batcher<I, O>,
    device: &Device,
    sender: &Sender<(usize, Made<O>)>,
) {
    while let Some(claimed) = turns.claim(order.len().div_ceil(batch), ahead) {
        let rows: Vec<usize> = order[claimed * batch..].iter().take(batch).copied().collect();
        let named = format!("a loader's worker panicked, at samples {rows:?}");
        let make = || dataset.get_many(rows).map(|items| batcher.batch(items, device));
        // A worker that dies would leave the consumer waiting for ever.
        let made = catch_unwind(AssertUnwindSafe(make))
            .unwrap_or_else(|_| Err(DatasetError::new(std::io::Error::other(named))));
        if sender.send((claimed, made)).is_err() {
            return;
        }
    }
}

impl<O> Iterator for Batches<O> {
    type Item = Made<O>;

    fn next(&mut self) -> Option<Made<O>> {
        if self.taken * self.batch >= self.items {
            return None;
        }
        let made = loop {
            if let Some(made) = self.early.remove(&self.taken) {
                break made;
            }
            let (place, made) = self.made.recv().ok()?;
            self.early.insert(place, made);
        };
        self.taken += 1;
        self.turns.lock().taken = self.taken;
        self.turns.moved.notify_all();
        Some(made)
    }
}

impl<O> DataLoaderIterator<O> for Batches<O> {
    fn progress(&self) -> Progress {
        Progress::new((self.taken * self.batch).min(self.items), self.items, Some("items".to_owned()))
    }
}

impl<O> Drop for Batches<O> {
    fn drop(&mut self) {
        self.turns.lock().stop = true;
        self.turns.moved.notify_all();
        for worker in self.workers.drain(..) {
            // Its panics were caught.
            let _ = worker.join();
        }
    }
}

impl<I: Send + Sync + 'static, O: Send + 'static> DataLoader<O> for Loader<I, O> {
    fn iter<'a>(&'a self) -> Box<dyn DataLoaderIterator<O> + 'a> {
        Box::new(self.batches(0))
    }

    fn num_items(&self) -> usize {
        self.range.len()
    }

    fn to_device(&self, device: &Device) -> Arc<dyn DataLoader<O>> {
        Arc::new(self.with(device, self.range.clone()))
    }

    fn slice(&self, start: usize, end: usize) -> Arc<dyn DataLoader<O>> {
        let at = |place: usize| (self.range.start + place).min(self.range.end);
        Arc::new(self.with(&self.device, at(start)..at(end)))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;
    use std::time::Duration;

    use super::*;

    /// Numbers; some are broken.
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

    struct Together;

    impl Batcher<Held, Vec<Held>> for Together {
        fn batch(&self, items: Vec<Held>, _device: &Device) -> Vec<Held> {
            items
        }
    }

    fn loader(
        count: usize,
        workers: usize,
        broken: Option<usize>,
    ) -> (Loader<Held, Vec<Held>>, Arc<AtomicUsize>) {
        let most = Arc::new(AtomicUsize::new(0));
        let numbers = Numbers { count, broken, alive: Arc::default(), most: most.clone() };
        (Loader::new(numbers, Together, 4, workers, 2, &Device::flex()), most)
    }

    fn order(loader: &dyn DataLoader<Vec<Held>>) -> Vec<usize> {
        loader.iter().flat_map(|batch| batch.expect("whole")).map(|held| held.0).collect()
    }

    #[test]
    fn batches_come_in_order_whatever_the_workers() {
        for workers in [1, 2, 5] {
            let (loader, _) = loader(103, workers, None);
            assert_eq!(order(&loader), (0..103).collect::<Vec<_>>());
            assert_eq!(order(&*loader.slice(10, 20)), (10..20).collect::<Vec<_>>());
        }
        let shuffled = |workers: usize| {
            let loader = loader(50, workers, None).0.shuffled(7);
            [order(&loader), order(&loader)]
        };
        let [first, second] = shuffled(1);
        let later = loader(50, 2, None).0.shuffled(7).from_pass(1);
        assert_eq!(order(&later), second);
        // In the middle of a pass, too.
        let rest = loader(50, 3, None).0.shuffled(7).from_pass(1).batches(5);
        let rest: Vec<usize> = rest.flat_map(|batch| batch.expect("whole")).map(|held| held.0).collect();
        assert_eq!(rest, second[20..]);
        assert_eq!(loader(50, 2, None).0.batches(13).count(), 0);
        assert_eq!([first.clone(), second.clone()], shuffled(3));
        assert_ne!(first, second);
        let mut sorted = first;
        sorted.sort_unstable();
        assert_eq!(sorted, (0..50).collect::<Vec<_>>());
    }

    #[test]
    fn no_more_items_are_alive_than_was_asked_for() {
        let (loader, most) = loader(400, 3, None);
        for batch in loader.iter() {
            std::thread::sleep(Duration::from_millis(1));
            drop(batch);
        }
        // Batches of 4: three in the making, two ready, one taken.
        let most = most.load(Ordering::SeqCst);
        assert!(most <= 4 * 6, "{most}");
    }

    #[test]
    fn errors_and_panics_reach_the_consumer_and_the_rest_goes_on() {
        let (loader, _) = loader(40, 2, Some(9));
        let results: Vec<_> = loader.iter().collect();
        assert_eq!(results.len(), 10);
        assert_eq!(results[2].as_ref().expect_err("broken").to_string(), "item 9 is broken");
        assert_eq!(results.iter().filter(|r| r.is_err()).count(), 1);
        let (loader, _) = self::loader(40, 2, Some(1009));
        let results: Vec<_> = loader.iter().collect();
        assert!(results[2].as_ref().expect_err("panicked").to_string().contains("panicked"));
        // Left early, the workers end as well.
        drop(loader.iter().next());
    }
}
