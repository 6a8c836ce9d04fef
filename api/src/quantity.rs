//! Amounts with their units in the type: cpu in millicores, memory and rates in bytes.
//!
//! The text forms are Kubernetes' (`500m`, `1.5`, `256Mi`, `2G`), except that bytes cannot have
//! the suffix `m`: nobody means a thousandth of a byte.

use std::borrow::Cow;
use std::fmt;
use std::iter::Sum;
use std::ops::{Add, AddAssign};
use std::str::FromStr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

/// Why a text is not a quantity, with what would be one.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not {what}")]
pub struct QuantityError {
    text: String,
    what: &'static str,
    suggestion: String,
}

impl QuantityError {
    fn new(text: &str, what: &'static str, suggestion: impl Into<String>) -> Self {
        QuantityError { text: text.to_owned(), what, suggestion: suggestion.into() }
    }

    /// What would be right, `try "2" or "2000m"`.
    #[must_use]
    pub fn suggestion(&self) -> &str {
        &self.suggestion
    }
}

/// Cpu time in thousandths of one core.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MilliCpu(pub u64);

/// An amount of memory or storage, in bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Bytes(pub u64);

impl MilliCpu {
    /// What is left after `other` is taken away; none when more is taken than there is.
    #[must_use]
    pub fn saturating_sub(self, other: MilliCpu) -> MilliCpu {
        MilliCpu(self.0.saturating_sub(other.0))
    }

    /// The amount in cores.
    #[must_use]
    pub fn cores(self) -> f64 {
        self.0 as f64 / 1000.0
    }
}

impl Bytes {
    /// What is left after `other` is taken away; none when more is taken than there is.
    #[must_use]
    pub fn saturating_sub(self, other: Bytes) -> Bytes {
        Bytes(self.0.saturating_sub(other.0))
    }
}

impl FromStr for MilliCpu {
    type Err = QuantityError;

    fn from_str(text: &str) -> Result<Self, QuantityError> {
        const WHAT: &str = "a quantity of cpu";
        let bad = || QuantityError::new(text, WHAT, suggest_cpu(text));
        let trimmed = text.trim();
        let (digits, per_core) = match trimmed.strip_suffix('m') {
            Some(millis) => (millis, 1),
            None => (trimmed, 1000),
        };
        let value = decimal(digits).ok_or_else(bad)?;
        // Rounded up as Kubernetes does: a task never gets less than it asked for.
        let millis = (value * f64::from(per_core)).ceil();
        if millis <= 1e12 { Ok(MilliCpu(millis as u64)) } else { Err(bad()) }
    }
}

impl FromStr for Bytes {
    type Err = QuantityError;

    fn from_str(text: &str) -> Result<Self, QuantityError> {
        const WHAT: &str = "a quantity of bytes";
        let bad = || QuantityError::new(text, WHAT, suggest_bytes(text));
        let trimmed = text.trim();
        let split =
            trimmed.find(|c: char| c.is_ascii_alphabetic() && c != 'e').unwrap_or(trimmed.len());
        let (digits, suffix) = trimmed.split_at(split);
        let unit = byte_unit(suffix).ok_or_else(bad)?;
        let unsigned = digits.starts_with(|c: char| c.is_ascii_digit());
        if let Some(whole) = unsigned.then(|| digits.parse::<u64>().ok()).flatten() {
            return whole.checked_mul(unit).map(Bytes).ok_or_else(bad);
        }
        let bytes = (decimal(digits).ok_or_else(bad)? * unit as f64).ceil();
        if bytes < 9.2e18 { Ok(Bytes(bytes as u64)) } else { Err(bad()) }
    }
}

fn byte_unit(suffix: &str) -> Option<u64> {
    Some(match suffix {
        "" => 1,
        "k" => 1_000,
        "M" => 1_000_000,
        "G" => 1_000_000_000,
        "T" => 1_000_000_000_000,
        "P" => 1_000_000_000_000_000,
        "Ki" => 1 << 10,
        "Mi" => 1 << 20,
        "Gi" => 1 << 30,
        "Ti" => 1 << 40,
        "Pi" => 1 << 50,
        _ => return None,
    })
}

/// A finite number ≥ 0 in plain or exponent notation. No sign, no `inf`, no `nan`.
fn decimal(text: &str) -> Option<f64> {
    let plain = !text.is_empty()
        && text.starts_with(|c: char| c.is_ascii_digit() || c == '.')
        && text.chars().all(|c| c.is_ascii_digit() || matches!(c, '.' | 'e' | '+' | '-'));
    let value: f64 = plain.then(|| text.parse().ok())??;
    value.is_finite().then_some(value)
}

fn leading_number(text: &str) -> Option<&str> {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let number = &text[..end];
    decimal(number).map(|_| number)
}

fn suggest_cpu(text: &str) -> String {
    match leading_number(text).and_then(|n| n.parse::<f64>().ok().map(|v| (n, v))) {
        Some((n, v)) if v < 1e6 => format!("try {n:?} or \"{}m\"", (v * 1000.0).ceil() as u64),
        _ => "try \"2\" or \"500m\"".to_owned(),
    }
}

fn suggest_bytes(text: &str) -> String {
    let Some(number) = leading_number(text) else {
        return "try \"256Mi\" or \"1Gi\"".to_owned();
    };
    let rest = text.trim()[number.len()..].trim().to_ascii_lowercase();
    let unit = match rest.chars().next() {
        Some('k') => "Ki",
        Some('g') => "Gi",
        Some('t') => "Ti",
        _ => "Mi",
    };
    format!("try \"{number}{unit}\"")
}

impl fmt::Display for MilliCpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_multiple_of(1000) {
            write!(f, "{}", self.0 / 1000)
        } else {
            write!(f, "{}m", self.0)
        }
    }
}

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (shift, suffix) in [(50, "Pi"), (40, "Ti"), (30, "Gi"), (20, "Mi"), (10, "Ki")] {
            let unit = 1_u64 << shift;
            if self.0 >= unit && self.0.is_multiple_of(unit) {
                return write!(f, "{}{suffix}", self.0 / unit);
            }
        }
        write!(f, "{}", self.0)
    }
}

macro_rules! quantity_impls {
    ($name:ident, $format:literal, $what:literal) => {
        impl Add for $name {
            type Output = $name;

            fn add(self, other: $name) -> $name {
                $name(self.0.saturating_add(other.0))
            }
        }

        impl AddAssign for $name {
            fn add_assign(&mut self, other: $name) {
                *self = *self + other;
            }
        }

        impl Sum for $name {
            fn sum<I: Iterator<Item = $name>>(items: I) -> $name {
                items.fold($name(0), |a, b| a + b)
            }
        }

        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
                s.collect_str(self)
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
                struct Text;
                impl de::Visitor<'_> for Text {
                    type Value = $name;

                    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                        f.write_str($what)
                    }

                    fn visit_str<E: de::Error>(self, v: &str) -> Result<$name, E> {
                        v.parse().map_err(E::custom)
                    }

                    fn visit_u64<E: de::Error>(self, v: u64) -> Result<$name, E> {
                        self.visit_str(&v.to_string())
                    }

                    fn visit_i64<E: de::Error>(self, v: i64) -> Result<$name, E> {
                        self.visit_str(&v.to_string())
                    }

                    fn visit_f64<E: de::Error>(self, v: f64) -> Result<$name, E> {
                        self.visit_str(&v.to_string())
                    }
                }
                d.deserialize_any(Text)
            }
        }

        impl JsonSchema for $name {
            fn schema_name() -> Cow<'static, str> {
                stringify!($name).into()
            }

            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({
                    "x-kubernetes-int-or-string": true,
                    "format": $format,
                    "description": $what,
                })
            }
        }
    };
}

quantity_impls!(MilliCpu, "cpu-quantity", "a quantity of cpu: cores (2, 0.5) or millicores (500m)");
quantity_impls!(Bytes, "byte-quantity", "a quantity of bytes: 512, 64Ki, 256Mi, 4Gi, 10M");

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn cpu_reads_cores_and_millicores() {
        for (text, millis) in [
            ("2", 2000),
            ("500m", 500),
            ("0.5", 500),
            (".25", 250),
            ("0.0001", 1),
            ("1e1", 10_000),
            ("0", 0),
        ] {
            assert_eq!(text.parse(), Ok(MilliCpu(millis)), "{text}");
        }
    }

    #[test]
    fn bytes_read_binary_and_decimal_units() {
        for (text, bytes) in [
            ("512", 512),
            ("64Ki", 65_536),
            ("256Mi", 268_435_456),
            ("1.5Gi", 1_610_612_736),
            ("10M", 10_000_000),
            ("1e3", 1000),
        ] {
            assert_eq!(text.parse(), Ok(Bytes(bytes)), "{text}");
        }
    }

    #[test]
    fn what_is_not_a_quantity_is_refused_with_a_suggestion() {
        let cases = [
            ("2core", "try \"2\" or \"2000m\""),
            ("lots", "try \"2\" or \"500m\""),
            ("-1", "try \"2\" or \"500m\""),
        ];
        for (text, suggestion) in cases {
            let error = text.parse::<MilliCpu>().expect_err(text);
            assert_eq!(error.suggestion(), suggestion, "{text}");
        }
        let cases =
            [("128m", "try \"128Mi\""), ("4GB", "try \"4Gi\""), ("", "try \"256Mi\" or \"1Gi\"")];
        for (text, suggestion) in cases {
            let error = text.parse::<Bytes>().expect_err(text);
            assert_eq!(error.suggestion(), suggestion, "{text}");
        }
        for text in ["inf", "nan", "1e400", "99999999999P", "1 2", "+1"] {
            assert!(text.parse::<MilliCpu>().is_err() && text.parse::<Bytes>().is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn printed_quantities_read_back_the_same(cpu in 0..1_000_000_000_u64, bytes in 0..u64::MAX / 2) {
            prop_assert_eq!(MilliCpu(cpu).to_string().parse(), Ok(MilliCpu(cpu)));
            prop_assert_eq!(Bytes(bytes).to_string().parse(), Ok(Bytes(bytes)));
        }

        #[test]
        fn no_text_makes_a_parser_panic(text in "\\PC{0,12}") {
            let _ = text.parse::<MilliCpu>();
            let _ = text.parse::<Bytes>();
        }
    }
}
