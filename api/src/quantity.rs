//! Amounts with their units in the type: cpu in millicores, memory and disk rates in bytes, network rates in bits a second.
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

/// What a network carries, in bits a second.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BitRate(pub u64);

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
        let (number, suffix) = split_suffix(text.trim());
        let per_unit = match suffix {
            "" => Some(1000),
            "m" => Some(1),
            _ => None,
        };
        let millis = per_unit.and_then(|unit| amount(number, unit));
        let millis = millis.filter(|millis| *millis <= MOST_MILLIS);
        millis.map(MilliCpu).ok_or_else(|| QuantityError::new(text, WHAT, suggest_cpu(text)))
    }
}

/// More cores than there are; sums of such amounts do not overflow.
const MOST_MILLIS: u64 = 1_000_000_000_000;

impl FromStr for Bytes {
    type Err = QuantityError;

    fn from_str(text: &str) -> Result<Self, QuantityError> {
        const WHAT: &str = "a quantity of bytes";
        let (number, suffix) = split_suffix(text.trim());
        let bytes = byte_unit(suffix).and_then(|unit| amount(number, unit));
        bytes.map(Bytes).ok_or_else(|| QuantityError::new(text, WHAT, suggest_bytes(text)))
    }
}

impl FromStr for BitRate {
    type Err = QuantityError;

    fn from_str(text: &str) -> Result<Self, QuantityError> {
        const WHAT: &str = "a rate in bits a second";
        let (number, suffix) = split_suffix(text.trim());
        let unit = match suffix {
            "" => Some(1),
            "k" => Some(1_000),
            "M" => Some(1_000_000),
            "G" => Some(1_000_000_000),
            "T" => Some(1_000_000_000_000),
            _ => None,
        };
        let bits = unit.and_then(|unit| amount(number, unit));
        bits.map(BitRate).ok_or_else(|| QuantityError::new(text, WHAT, suggest_rate(text)))
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
        "E" => 1_000_000_000_000_000_000,
        "Ki" => 1 << 10,
        "Mi" => 1 << 20,
        "Gi" => 1 << 30,
        "Ti" => 1 << 40,
        "Pi" => 1 << 50,
        "Ei" => 1 << 60,
        _ => return None,
    })
}

/// The number and the letters behind it. An exponent belongs to the number and has no letters behind it: `1E` is an
/// exabyte, `1E3` a thousand.
fn split_suffix(text: &str) -> (&str, &str) {
    let letters = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, suffix) = text.split_at(letters);
    let exponent = suffix.strip_prefix(['e', 'E']).unwrap_or_default();
    if exponent.starts_with(|c: char| c.is_ascii_digit() || c == '+' || c == '-') {
        return (text, "");
    }
    (number, suffix)
}

/// As many digits of a number are looked at, which is more than an amount can have; what follows counts as one more of
/// the last. The product with any unit fits 128 bits.
const DIGITS: usize = 19;

/// A number ≥ 0 without a sign, `12`, `.5`, `1.5e3`, times `unit`. Exact, and rounded up as Kubernetes does: a task never
/// gets less than it asked for. None: not a number, or too much.
fn amount(number: &str, unit: u64) -> Option<u64> {
    let (number, exponent) = match number.split_once(['e', 'E']) {
        Some((number, exponent)) => (number, exponent.parse::<i32>().ok()?),
        None => (number, 0),
    };
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    let digits = format!("{whole}{fraction}");
    if digits.is_empty() || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let digits = digits.trim_start_matches('0');
    let (looked_at, rest) = digits.split_at(digits.len().min(DIGITS));
    if looked_at.is_empty() {
        return Some(0);
    }
    let more = u128::from(rest.bytes().any(|b| b != b'0'));
    let product = (looked_at.parse::<u128>().ok()? + more) * u128::from(unit);
    let places = i64::try_from(rest.len()).ok()? - i64::try_from(fraction.len()).ok()?;
    let places = i64::from(exponent).checked_add(places)?;
    let power = |places: i64| 10_u128.checked_pow(u32::try_from(places).ok()?);
    let scaled = if places >= 0 {
        product.checked_mul(power(places)?)?
    } else {
        // What is divided by more than 128 bits hold is less than one of the smallest.
        power(-places).map_or(1, |divisor| product.div_ceil(divisor))
    };
    u64::try_from(scaled).ok()
}

fn leading_number(text: &str) -> Option<&str> {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let number = &text[..end];
    amount(number, 1).map(|_| number)
}

fn suggest_cpu(text: &str) -> String {
    match leading_number(text).and_then(|n| Some((n, amount(n, 1000)?))) {
        Some((n, millis)) if millis < 1_000_000_000 => format!("try {n:?} or \"{millis}m\""),
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

/// People write `200kbit`, `6 Mb/s` or `6Mbps`; the letter tells.
fn suggest_rate(text: &str) -> String {
    let Some(number) = leading_number(text) else {
        return "try \"200k\" or \"6M\"".to_owned();
    };
    let rest = text.trim()[number.len()..].trim().to_ascii_lowercase();
    let unit = match rest.chars().next() {
        Some('k') => "k",
        Some('g') => "G",
        _ => "M",
    };
    format!("try \"{number}{unit}\"")
}

impl fmt::Display for BitRate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (unit, suffix) in [(1_000_000_000, "G"), (1_000_000, "M"), (1_000, "k")] {
            if self.0 >= unit && self.0.is_multiple_of(unit) {
                return write!(f, "{}{suffix}", self.0 / unit);
            }
        }
        write!(f, "{}", self.0)
    }
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
quantity_impls!(BitRate, "bit-rate", "a rate in bits a second: 9600, 200k, 6M, 1G");

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
            // In binary floating point a little more than 16 100, which would be rounded up.
            ("16.1", 16_100),
            ("0.10000000000000000000000001", 101),
            ("1e-400", 1),
            ("0e400", 0),
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
            ("1E3", 1000),
            ("1E", 1_000_000_000_000_000_000),
            ("9007199254740993", 9_007_199_254_740_993),
        ] {
            assert_eq!(text.parse(), Ok(Bytes(bytes)), "{text}");
        }
    }

    #[test]
    fn rates_read_decimal_units_of_bits() {
        for (text, bits) in
            [("9600", 9_600), ("200k", 200_000), ("6M", 6_000_000), ("1.5G", 1_500_000_000)]
        {
            assert_eq!(text.parse(), Ok(BitRate(bits)), "{text}");
            assert_eq!(BitRate(bits).to_string().parse(), Ok(BitRate(bits)), "{text}");
        }
        for (text, suggestion) in [
            ("200Kb/s", "try \"200k\""),
            ("6Mbps", "try \"6M\""),
            ("fast", "try \"200k\" or \"6M\""),
        ] {
            let error = text.parse::<BitRate>().expect_err(text);
            assert_eq!(error.suggestion(), suggestion, "{text}");
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
        for text in [
            "inf",
            "nan",
            "1e400",
            "99999999999P",
            "1 2",
            "+1",
            "1e3m",
            "1e3Ki",
            "1e",
            ".",
            "1.2.3",
        ] {
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
