//! A number of things, or a percentage of how many there are: `3`, `"25%"`.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{self, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A number, or a part of a whole that is known later.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Portion {
    /// That many.
    Count(u32),
    /// Of a hundred.
    Percent(u8),
}

/// Why a text is not a [`Portion`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not a number or a percentage")]
pub struct PortionError {
    text: String,
}

impl PortionError {
    /// What would be right.
    #[must_use]
    pub fn suggestion(&self) -> &'static str {
        "try 1 or \"25%\""
    }
}

impl Portion {
    /// How many of `whole` are meant; percentages are rounded down, as Kubernetes does for what may be missing.
    #[must_use]
    pub fn of(self, whole: usize) -> usize {
        match self {
            Portion::Count(n) => usize::try_from(n).unwrap_or(usize::MAX),
            Portion::Percent(p) => whole.saturating_mul(usize::from(p)) / 100,
        }
    }

    /// Nothing is meant, whatever the whole is.
    #[must_use]
    pub fn is_zero(self) -> bool {
        matches!(self, Portion::Count(0) | Portion::Percent(0))
    }
}

impl FromStr for Portion {
    type Err = PortionError;

    fn from_str(text: &str) -> Result<Self, PortionError> {
        let bad = || PortionError { text: text.to_owned() };
        match text.trim().strip_suffix('%') {
            Some(percent) => {
                let percent = percent.parse::<u8>().map_err(|_| bad())?;
                (percent <= 100).then_some(Portion::Percent(percent)).ok_or_else(bad)
            }
            None => text.trim().parse().map(Portion::Count).map_err(|_| bad()),
        }
    }
}

impl fmt::Display for Portion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Portion::Count(n) => write!(f, "{n}"),
            Portion::Percent(p) => write!(f, "{p}%"),
        }
    }
}

impl Serialize for Portion {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        match self {
            Portion::Count(n) => s.serialize_u32(*n),
            Portion::Percent(_) => s.collect_str(self),
        }
    }
}

struct NumberOrText;

impl Visitor<'_> for NumberOrText {
    type Value = Portion;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number or a percentage")
    }

    fn visit_u64<E: de::Error>(self, n: u64) -> Result<Portion, E> {
        let count = u32::try_from(n).map_err(|_| E::invalid_value(Unexpected::Unsigned(n), &self));
        count.map(Portion::Count)
    }

    fn visit_i64<E: de::Error>(self, n: i64) -> Result<Portion, E> {
        let count = u32::try_from(n).map_err(|_| E::invalid_value(Unexpected::Signed(n), &self));
        count.map(Portion::Count)
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<Portion, E> {
        text.parse().map_err(E::custom)
    }
}

impl<'de> Deserialize<'de> for Portion {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        d.deserialize_any(NumberOrText)
    }
}

impl JsonSchema for Portion {
    fn schema_name() -> Cow<'static, str> {
        "Portion".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "x-kubernetes-int-or-string": true,
            "format": "portion",
            "description": "A number, or a percentage: 3, \"25%\".",
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn numbers_and_percentages_read_back_the_same() {
        for (value, portion) in
            [(json!(3), Portion::Count(3)), (json!("25%"), Portion::Percent(25))]
        {
            assert_eq!(serde_json::from_value::<Portion>(value.clone()).ok(), Some(portion));
            assert_eq!(serde_json::to_value(portion).ok(), Some(value));
        }
        assert_eq!("7".parse(), Ok(Portion::Count(7)));
        for bad in [json!(-1), json!("101%"), json!("a"), json!(1.5), json!("")] {
            serde_json::from_value::<Portion>(bad).expect_err("no portion");
        }
    }

    #[test]
    fn a_percentage_is_rounded_down() {
        assert_eq!(Portion::Percent(25).of(7), 1);
        assert_eq!(Portion::Percent(25).of(3), 0);
        assert_eq!(Portion::Count(9).of(3), 9);
    }
}
