//! The processes of a training. With the feature `mpi`, under `mpirun` or `srun`, each is a rank of MPI. Otherwise
//! there is one process. All ranks make the same calls in the same order.

use std::ops::Range;

use serde::Serialize;
use serde::de::DeserializeOwned;
use snapsnap_data::sample::share;

use crate::{Result, TrainError};

/// Environment variables that MPI launchers set: Open MPI, PMIx, and MPICH or Slurm's PMI-2.
const LAUNCHERS: [&str; 3] = ["OMPI_COMM_WORLD_SIZE", "PMIX_RANK", "PMI_RANK"];
/// Environment variables with the number of processes. `srun` sets the last one.
const SIZES: [&str; 3] = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS"];

/// The place of this process among the processes of its training.
pub struct Ranks {
    /// This process among all: 0 is the first.
    pub rank: usize,
    /// Number of processes.
    pub size: usize,
    /// Number of lower ranks on the same machine.
    pub local: usize,
    /// Name of the machine.
    pub host: String,
    /// Ends MPI when it is dropped.
    #[cfg(feature = "mpi")]
    _universe: Option<mpi::environment::Universe>,
}

impl Default for Ranks {
    /// A process alone.
    fn default() -> Self {
        Self {
            rank: 0,
            size: 1,
            local: 0,
            host: String::new(),
            #[cfg(feature = "mpi")]
            _universe: None,
        }
    }
}

impl Ranks {
    /// Joins the ranks of a launcher, or stays alone without one. MPI ends when all ranks have dropped the result.
    ///
    /// # Errors
    /// A message if several processes were started, and this one cannot join the others.
    pub fn join() -> Result<Self, String> {
        let launched = SIZES.iter().find_map(|name| std::env::var(name).ok()?.parse::<usize>().ok());
        let launcher = LAUNCHERS.into_iter().find(|name| std::env::var_os(name).is_some());
        let joined = match launcher {
            Some(launcher) if launched != Some(1) => Self::join_launched(launcher)?,
            _ => Self::default(),
        };
        match launched {
            Some(count) if count > 1 && joined.size == 1 => Err(format!(
                "{count} processes were started, but MPI does not connect them: with srun, add --mpi=pmix or --mpi=pmi2"
            )),
            _ => Ok(joined),
        }
    }

    #[cfg(not(feature = "mpi"))]
    fn join_launched(launcher: &str) -> Result<Self, String> {
        Err(format!(
            "{launcher} is set, so MPI started this program, which was built without it: build with --features mpi"
        ))
    }

    /// Whether this process writes the training's files and messages.
    pub fn is_first(&self) -> bool {
        self.rank == 0
    }

    /// This rank's share of `count` things. The shares of all ranks differ by one at most.
    pub fn share(&self, count: usize) -> Range<usize> {
        share([self.rank, self.size], count)
    }

    /// The values of all ranks, in the order of the ranks.
    ///
    /// # Panics
    /// If a value does not have the same type on all ranks.
    pub fn gather<T: Clone + Serialize + DeserializeOwned>(&self, value: &T) -> Vec<T> {
        if self.size == 1 {
            return vec![value.clone()];
        }
        // MessagePack has infinite numbers and NaN, JSON does not.
        let bytes = rmp_serde::to_vec(value).expect("plain data");
        let read = |bytes: &Vec<u8>| rmp_serde::from_slice(bytes).expect("all ranks send the same type");
        self.exchange(&bytes).iter().map(read).collect()
    }

    /// Returns an error on all ranks if any rank failed: its own error on a failed rank, a report of it on the others.
    ///
    /// # Errors
    /// [`TrainError`] if any rank failed.
    pub fn agree(&self, failed: Option<TrainError>) -> Result<()> {
        let own = failed.as_ref().map(|e| (e.to_string(), self.host.clone()));
        let first =
            self.gather(&own).into_iter().enumerate().find_map(|(rank, failure)| Some((rank, failure?)));
        match (failed, first) {
            (Some(own), _) => Err(own),
            (None, Some((rank, (why, host)))) => {
                Err(TrainError::Elsewhere(format!("rank {rank} on {host}: {why}")))
            }
            (None, None) => Ok(()),
        }
    }

    /// Replaces `values` by their sums over all ranks, in the order of the ranks. All ranks get the same bytes.
    pub fn sum(&self, values: &mut [f32]) {
        if self.size > 1 {
            self.sum_all(values);
        }
    }

    #[cfg(not(feature = "mpi"))]
    fn exchange(&self, _bytes: &[u8]) -> Vec<Vec<u8>> {
        unreachable!("one rank")
    }

    #[cfg(not(feature = "mpi"))]
    fn sum_all(&self, _values: &mut [f32]) {
        unreachable!("one rank")
    }

    /// Ends all ranks with this exit code. Does nothing in a process alone.
    #[cfg(not(feature = "mpi"))]
    pub fn abort(&self, _code: u8) {}
}

#[cfg(feature = "mpi")]
mod over_mpi {
    use mpi::Threading;
    use mpi::datatype::PartitionMut;
    use mpi::environment::processor_name;
    use mpi::topology::SimpleCommunicator;
    use mpi::traits::*;

    use super::Ranks;

    impl Ranks {
        pub(super) fn join_launched(launcher: &str) -> Result<Self, String> {
            let cannot = |why: &str| format!("{launcher} is set, but MPI cannot be started: {why}");
            // The training's thread is not always the one that starts MPI.
            let joined = mpi::initialize_with_threading(Threading::Serialized);
            let (universe, threading) = joined.ok_or_else(|| cannot("it was started before"))?;
            if threading < Threading::Serialized {
                return Err(cannot("it does not support threads"));
            }
            let world = SimpleCommunicator::world();
            let [rank, size] = [world.rank(), world.size()].map(|number| number as usize);
            let local = world.split_shared(world.rank()).rank() as usize;
            let host = processor_name().unwrap_or_default();
            Ok(Self { rank, size, local, host, _universe: Some(universe) })
        }

        pub(super) fn exchange(&self, bytes: &[u8]) -> Vec<Vec<u8>> {
            let mut counts = vec![0_i32; self.size];
            let own = i32::try_from(bytes.len()).expect("short texts");
            let world = SimpleCommunicator::world();
            world.all_gather_into(&own, &mut counts[..]);
            let starts: Vec<i32> = (0..self.size).map(|rank| counts[..rank].iter().sum()).collect();
            let mut all = vec![0_u8; counts.iter().sum::<i32>() as usize];
            let mut parts = PartitionMut::new(&mut all[..], counts.as_slice(), starts.as_slice());
            world.all_gather_varcount_into(bytes, &mut parts);
            let part = |(start, count): (&i32, &i32)| all[*start as usize..(start + count) as usize].to_vec();
            starts.iter().zip(&counts).map(part).collect()
        }

        /// Each rank sums one part of the values and sends the sum to all ranks. Each value is sent twice.
        pub(super) fn sum_all(&self, values: &mut [f32]) {
            let part = values.len().div_ceil(self.size);
            if part == 0 {
                return;
            }
            let mut sent = values.to_vec();
            sent.resize(part * self.size, 0.0);
            let mut received = vec![0.0_f32; part * self.size];
            let world = SimpleCommunicator::world();
            world.all_to_all_into(&sent[..], &mut received[..]);
            let (sum, others) = received.split_at_mut(part);
            for other in others.chunks_exact(part) {
                sum.iter_mut().zip(other).for_each(|(sum, value)| *sum += value);
            }
            world.all_gather_into(&*sum, &mut sent[..]);
            values.copy_from_slice(&sent[..values.len()]);
        }

        /// Ends all ranks with this exit code. Does nothing in a process alone.
        pub fn abort(&self, code: u8) {
            if self.size > 1 {
                SimpleCommunicator::world().abort(code.into());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_alone_has_everything() {
        let alone = Ranks::default();
        assert!(alone.is_first() && alone.size == 1 && alone.share(7) == (0..7));
        assert_eq!(alone.gather(&vec![(1, "a".to_owned())]), [vec![(1, "a".to_owned())]]);
        let message = rmp_serde::to_vec(&(f64::INFINITY, f64::NAN)).expect("plain data");
        let (infinite, nan): (f64, f64) = rmp_serde::from_slice(&message).expect("what was sent");
        assert!(infinite == f64::INFINITY && nan.is_nan());
        assert!(alone.agree(None).is_ok());
        let failed = alone.agree(Some(TrainError::Unsuitable("x".into())));
        assert!(matches!(failed, Err(TrainError::Unsuitable(_))));
        let mut values = [1.0, f32::NAN];
        alone.sum(&mut values);
        assert!(values[0] == 1.0 && values[1].is_nan());
    }

    #[test]
    fn shares_are_even_and_whole() {
        for (count, size) in [(4, 4), (5, 4), (3, 4), (0, 2), (17, 5)] {
            let shares: Vec<_> = (0..size).map(|rank| share([rank, size], count)).collect();
            assert!(shares.iter().cloned().flatten().eq(0..count), "{shares:?}");
            let lengths = || shares.iter().map(ExactSizeIterator::len);
            assert!(lengths().max() <= lengths().min().map(|least| least + 1), "{shares:?}");
        }
    }
}
