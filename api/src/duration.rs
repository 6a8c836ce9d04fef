//! Spans of time as people write them: `500ms`, `30s`, `1m30s`, `2h`.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

/// A span of time with millisecond resolution.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Span(Duration);

/// Why a text is not a [`Span`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not a duration")]
pub struct SpanError {
    text: String,
}

impl SpanError {
    /// What would be right.
    #[must_use]
    pub fn suggestion(&self) -> String {
        match self.text.trim().parse::<u32>() {
            Ok(n) => format!("try \"{n}s\""),
            Err(_) => "try \"500ms\", \"30s\" or \"1m30s\"".to_owned(),
        }
    }
}

impl Span {
    /// A span of whole seconds.
    #[must_use]
    pub const fn from_secs(secs: u64) -> Self {
        Span(Duration::from_secs(secs))
    }

    /// A span of milliseconds.
    #[must_use]
    pub const fn from_millis(millis: u64) -> Self {
        Span(Duration::from_millis(millis))
    }

    /// The span as the standard library's type.
    #[must_use]
    pub const fn as_duration(self) -> Duration {
        self.0
    }
}

impl FromStr for Span {
    type Err = SpanError;

    fn from_str(text: &str) -> Result<Self, SpanError> {
        let bad = || SpanError { text: text.to_owned() };
        let mut rest = text.trim();
        if rest.is_empty() {
            return Err(bad());
        }
        let mut total = 0_f64;
        while !rest.is_empty() {
            let end = rest.find(|c: char| !c.is_ascii_digit() && c != '.').ok_or_else(bad)?;
            let value: f64 = rest[..end].parse().map_err(|_| bad())?;
            rest = &rest[end..];
            let unit_end = rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len());
            let millis = match &rest[..unit_end] {
                "ms" => 1.0,
                "s" => 1e3,
                "m" => 60e3,
                "h" => 3_600e3,
                _ => return Err(bad()),
            };
            total += value * millis;
            rest = &rest[unit_end..];
        }
        // A century: longer is a slip of the pen, and must not overflow a clock.
        if total.is_finite() && total <= 3.2e12 {
            Ok(Span::from_millis(total.round() as u64))
        } else {
            Err(bad())
        }
    }
}

impl fmt::Display for Span {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let millis = self.0.as_millis();
        let (hours, minutes, seconds, ms) =
            (millis / 3_600_000, millis / 60_000 % 60, millis / 1000 % 60, millis % 1000);
        if millis == 0 {
            return f.write_str("0s");
        }
        for (amount, unit) in [(hours, "h"), (minutes, "m"), (seconds, "s"), (ms, "ms")] {
            if amount > 0 {
                write!(f, "{amount}{unit}")?;
            }
        }
        Ok(())
    }
}

impl Serialize for Span {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Span {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        String::deserialize(d)?.parse().map_err(de::Error::custom)
    }
}

impl JsonSchema for Span {
    fn schema_name() -> Cow<'static, str> {
        "Span".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "format": "duration", "description": "A span of time: 500ms, 30s, 1m30s, 2h." })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn units_add_up() {
        assert_eq!("1m30s".parse(), Ok(Span::from_secs(90)));
        assert_eq!("0.5s".parse(), Ok(Span::from_millis(500)));
        for bad in ["", "30", "s", "1x", "-1s", "1 s", "1e9999s"] {
            assert!(bad.parse::<Span>().is_err(), "{bad}");
        }
        assert_eq!("30".parse::<Span>().expect_err("no unit").suggestion(), "try \"30s\"");
    }

    proptest! {
        #[test]
        fn printed_spans_read_back_the_same(millis in 0..3_000_000_000_000_u64) {
            prop_assert_eq!(Span::from_millis(millis).to_string().parse(), Ok(Span::from_millis(millis)));
        }
    }
}
