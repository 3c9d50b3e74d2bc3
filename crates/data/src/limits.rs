//! Limits of the values in configs.

use std::fmt::Display;
use std::ops::RangeInclusive;

/// The first key whose value is outside its range, and the message about it.
pub fn outside<T: PartialOrd + Display>(
    values: impl IntoIterator<Item = (&'static str, T, RangeInclusive<T>)>,
) -> Option<(&'static str, String)> {
    let (key, value, range) = values.into_iter().find(|(_, value, range)| !range.contains(value))?;
    Some((key, format!("is {value}, must be {} to {}", range.start(), range.end())))
}
