//! Values as people read them: ages, amounts, counts, and text from elsewhere made harmless.

use std::time::Duration;

use crate::pose::{DEFAULT_MAP, OperationPosition};
use crate::quantity::{Bytes, MilliCpu};
use jiff::Timestamp;

/// A span of time in its one or two largest units, as kubectl writes it: `45s`, `4m12s`, `3h`, `9d`.
pub fn duration(span: Duration) -> String {
    const MINUTE: u64 = 60;
    const HOUR: u64 = 60 * MINUTE;
    const DAY: u64 = 24 * HOUR;
    let s = span.as_secs();
    let two = |large: u64, large_unit: char, small: u64, small_unit: char| match small {
        0 => format!("{large}{large_unit}"),
        _ => format!("{large}{large_unit}{small}{small_unit}"),
    };
    match s {
        0 if !span.is_zero() => format!("{}ms", span.as_millis().max(1)),
        _ if s < 2 * MINUTE => format!("{s}s"),
        _ if s < 10 * MINUTE => two(s / MINUTE, 'm', s % MINUTE, 's'),
        _ if s < 3 * HOUR => format!("{}m", s / MINUTE),
        _ if s < 8 * HOUR => two(s / HOUR, 'h', s % HOUR / MINUTE, 'm'),
        _ if s < 2 * DAY => format!("{}h", s / HOUR),
        _ if s < 8 * DAY => two(s / DAY, 'd', s % DAY / HOUR, 'h'),
        _ if s < 2 * 365 * DAY => format!("{}d", s / DAY),
        _ => format!("{}y", s / (365 * DAY)),
    }
}

/// What is left of a span that began at `since`; whole seconds.
pub fn left(span: Duration, since: Timestamp, now: Timestamp) -> String {
    let gone = now.as_second().saturating_sub(since.as_second()).max(0);
    duration(span.saturating_sub(Duration::from_secs(gone.unsigned_abs())))
}

/// How long ago `then` was; whole seconds, and never negative: clocks differ.
pub fn age(then: Timestamp, now: Timestamp) -> String {
    let seconds = now.as_second().saturating_sub(then.as_second()).max(0);
    duration(Duration::from_secs(seconds.unsigned_abs()))
}

/// An amount of memory with one digit after the point where that says more: `3.8Gi`, `64Mi`.
pub fn bytes(amount: Bytes) -> String {
    for (shift, unit) in [(40, "Ti"), (30, "Gi"), (20, "Mi"), (10, "Ki")] {
        let one = 1_u64 << shift;
        if amount.0 >= one {
            let tenths = (amount.0 as f64 / one as f64 * 10.0).round() / 10.0;
            return format!("{tenths}{unit}");
        }
    }
    amount.0.to_string()
}

/// An amount of cpu in cores: `0.25`, `1.5`, `2`.
pub fn cores(amount: MilliCpu) -> String {
    format!("{}", amount.cores())
}

/// A place in a cell, as poses are written: metres, and the map where it is not the usual one.
pub fn place(at: &OperationPosition) -> String {
    let z = if at.z == 0.0 { String::new() } else { format!(",{:.2}", at.z) };
    let map = if at.map == DEFAULT_MAP { String::new() } else { format!(" in {}", at.map) };
    format!("{:.2},{:.2}{z}{map}", at.x, at.y)
}

/// `part` of `whole` in percent; `-` of nothing.
pub fn percent(part: u64, whole: u64) -> String {
    if whole == 0 {
        return "-".to_owned();
    }
    format!("{:.0}%", part as f64 / whole as f64 * 100.0)
}

/// `1 task`, `3 tasks`.
pub fn count(n: usize, word: &str) -> String {
    if n == 1 { format!("1 {word}") } else { format!("{n} {word}s") }
}

/// Text from elsewhere on one line: line ends become spaces, other control characters (which could
/// move the cursor of a terminal) become `U+FFFD`.
pub fn plain(text: &str) -> String {
    text.chars()
        .map(|c| match c {
            '\n' | '\r' | '\t' => ' ',
            c if c.is_control() => char::REPLACEMENT_CHARACTER,
            c => c,
        })
        .collect()
}

/// Text from elsewhere with its lines kept, the later ones indented.
pub fn lines(text: &str) -> String {
    text.lines().map(plain).collect::<Vec<_>>().join("\n  ")
}

/// The text, or `-` when there is none.
pub fn or_dash(text: &str) -> String {
    if text.is_empty() { "-".to_owned() } else { plain(text) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_keep_their_largest_units() {
        for (seconds, text) in [
            (0, "0s"),
            (119, "119s"),
            (120, "2m"),
            (252, "4m12s"),
            (3600, "60m"),
            (3 * 3600 + 120, "3h2m"),
            (9 * 3600, "9h"),
            (50 * 3600, "2d2h"),
            (9 * 86_400, "9d"),
            (800 * 86_400, "2y"),
        ] {
            assert_eq!(duration(Duration::from_secs(seconds)), text, "{seconds}");
        }
        assert_eq!(duration(Duration::from_millis(250)), "250ms");
    }

    #[test]
    fn an_age_is_never_negative() {
        let at = |s| Timestamp::from_second(s).expect("in range");
        assert_eq!(age(at(100), at(145)), "45s");
        assert_eq!(age(at(100), at(90)), "0s");
        let minute = Duration::from_secs(60);
        assert_eq!(left(minute, at(100), at(112)), "48s");
        assert_eq!(left(minute, at(100), at(200)), "0s");
    }

    #[test]
    fn amounts_are_short() {
        assert_eq!(bytes(Bytes(4_123_456_789)), "3.8Gi");
        assert_eq!(bytes(Bytes(64 << 20)), "64Mi");
        assert_eq!(bytes(Bytes(12)), "12");
        assert_eq!(cores(MilliCpu(250)), "0.25");
        assert_eq!(cores(MilliCpu(2000)), "2");
        assert_eq!(percent(1, 3), "33%");
        assert_eq!(percent(1, 0), "-");
    }

    #[test]
    fn counts_agree_with_their_words() {
        assert_eq!(count(1, "task"), "1 task");
        assert_eq!(count(0, "task"), "0 tasks");
    }
}
