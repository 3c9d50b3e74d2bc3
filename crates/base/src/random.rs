//! Random streams that are the same on every machine. Each purpose has its own stream, identified by a name.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// The stream called `name`. Different names give unrelated streams.
pub fn stream(name: &str) -> ChaCha8Rng {
    // FNV-1a over four lanes fills ChaCha's key of 256 bits.
    let mut key = [0; 32];
    for (lane, out) in (0_u64..).zip(key.chunks_exact_mut(8)) {
        let start = 0xcbf2_9ce4_8422_2325 ^ lane.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let hash =
            name.bytes().fold(start, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
        out.copy_from_slice(&hash.to_le_bytes());
    }
    ChaCha8Rng::from_seed(key)
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;

    #[test]
    fn streams_are_fixed_by_their_names() {
        let first = |name: &str| stream(name).random::<u64>();
        // The same number on every machine.
        assert_eq!(first("train/1/0"), 6_893_838_934_489_721_906);
        let names = (0..1000).map(|i| format!("train/1/{i}"));
        let values: std::collections::HashSet<u64> = names.map(|name| first(&name)).collect();
        assert_eq!(values.len(), 1000);
    }
}
