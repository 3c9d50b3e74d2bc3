//! Means over people with confidence intervals; quantiles.

use std::time::Duration;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Resamples of a bootstrap.
const RESAMPLES: usize = 2000;
/// Seed of a bootstrap: equal data have equal intervals.
const SEED: u64 = 1;
/// Share of the resampled means between the bounds.
const CONFIDENCE: f64 = 0.95;

/// A mean and its bounds with 95 % confidence.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    /// Mean over people.
    #[serde(with = "crate::statistics::number")]
    pub mean: f64,
    /// Lower bound.
    #[serde(with = "crate::statistics::number")]
    pub low: f64,
    /// Upper bound.
    #[serde(with = "crate::statistics::number")]
    pub high: f64,
}

/// The mean; `None` without figures.
pub fn mean(figures: &[f64]) -> Option<f64> {
    (!figures.is_empty()).then(|| figures.iter().sum::<f64>() / figures.len() as f64)
}

/// Mean of one figure per person, with the percentile bootstrap interval over people; `None` without people. Of paired
/// differences, it is the paired interval. An infinite figure (the PSNR of equal pictures) makes the mean infinite.
pub fn interval(figures: &[f64]) -> Option<Interval> {
    let (n, mean) = (figures.len(), mean(figures)?);
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let resampled = |_| (0..n).map(|_| figures[random.random_range(0..n)]).sum::<f64>() / n as f64;
    let mut means: Vec<f64> = (0..RESAMPLES).map(resampled).collect();
    means.sort_by(f64::total_cmp);
    let tail = (1.0 - CONFIDENCE) / 2.0;
    Some(Interval { mean, low: quantile(&means, tail), high: quantile(&means, 1.0 - tail) })
}

/// Difference of two figures: 0 for equal ones, even if both are infinite.
pub fn difference(a: f64, b: f64) -> f64 {
    if a == b { 0.0 } else { a - b }
}

/// A quantile of sorted values, with linear interpolation.
///
/// # Panics
/// If there is no value.
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    let at = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    if below == above { below } else { below + (above - below) * at.fract() }
}

/// A quantile of times in seconds, with linear interpolation.
///
/// # Panics
/// If there is no time.
pub fn quantile_of_times(times: &[Duration], share: f64) -> f64 {
    let mut seconds: Vec<f64> = times.iter().map(Duration::as_secs_f64).collect();
    seconds.sort_by(f64::total_cmp);
    quantile(&seconds, share)
}

/// Numbers in JSON. JSON has no infinities: they are written as `"inf"`.
pub mod number {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use serde_json::Value;

    /// Writes a number, or text if it is not finite.
    ///
    /// # Errors
    /// Errors of the serializer.
    pub fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        if value.is_finite() { value.serialize(serializer) } else { value.to_string().serialize(serializer) }
    }

    /// Reads a number or its text.
    ///
    /// # Errors
    /// Errors of the deserializer, and text that is no number.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        let written = Value::deserialize(deserializer)?;
        let number = written.as_f64().or_else(|| written.as_str()?.parse().ok());
        number.ok_or_else(|| D::Error::custom(format!("{written} is no number")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_linear_between_values() {
        let values = [1.0, 2.0, 4.0, 8.0];
        assert_eq!([0.0, 0.5, 1.0, 1.0 / 6.0].map(|share| quantile(&values, share)), [1.0, 3.0, 8.0, 1.5]);
    }

    /// The bounds of many normal figures are 1.96 standard errors from the mean.
    #[test]
    fn intervals_of_normal_figures_are_those_of_the_normal_approximation() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let normal = |random: &mut ChaCha8Rng| (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
        let figures: Vec<f64> = (0..400).map(|_| 20.0 + 2.0 * normal(&mut random)).collect();
        let Interval { mean, low, high } = interval(&figures).expect("people");
        let deviation = figures.iter().map(|f| (f - mean).powi(2)).sum::<f64>() / 399.0;
        let error = 1.96 * (deviation / 400.0).sqrt();
        for bound in [mean - low, high - mean] {
            assert!((bound / error - 1.0).abs() < 0.1, "{low} {mean} {high}, expected ±{error}");
        }
        assert_eq!(interval(&figures), interval(&figures));
    }

    #[test]
    fn one_person_has_no_spread() {
        assert_eq!(interval(&[3.0]), Some(Interval { mean: 3.0, low: 3.0, high: 3.0 }));
        assert_eq!(interval(&[]), None);
    }
}
