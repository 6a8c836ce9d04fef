//! Names: the DNS labels that objects are called by, and the `Sensor:Function` pairs of a robot.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

/// Longest name of an object (RFC 1123 label), in bytes.
///
/// A label and not a subdomain: names end up in host names, cgroup directories and container names.
pub const MAX_NAME_LEN: usize = 63;

/// Why a text is not a name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// Nothing there.
    #[error("is empty")]
    Empty,
    /// Longer than [`MAX_NAME_LEN`].
    #[error("is {0} bytes long, at most {MAX_NAME_LEN} are allowed")]
    TooLong(usize),
    /// A character outside `[a-z0-9-]`, or `-` at an end.
    #[error(
        "{text:?} is not a name: lower-case letters, digits and '-' only, beginning and ending with a letter or digit"
    )]
    BadCharacter {
        /// What was given.
        text: String,
        /// The nearest valid name, when there is one.
        suggestion: Option<String>,
    },
}

impl NameError {
    /// The nearest valid name, when there is one.
    #[must_use]
    pub fn suggestion(&self) -> Option<&str> {
        match self {
            NameError::BadCharacter { suggestion, .. } => suggestion.as_deref(),
            NameError::Empty | NameError::TooLong(_) => None,
        }
    }
}

/// Checks that `text` is a name (RFC 1123 label).
///
/// # Errors
///
/// Says what is wrong, with the nearest valid name where there is one.
pub fn check_name(text: &str) -> Result<(), NameError> {
    if text.is_empty() {
        return Err(NameError::Empty);
    }
    if text.len() > MAX_NAME_LEN {
        return Err(NameError::TooLong(text.len()));
    }
    let inner = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit();
    let ends_well = text.starts_with(inner) && text.ends_with(inner);
    if ends_well && text.chars().all(|c| inner(c) || c == '-') {
        return Ok(());
    }
    Err(NameError::BadCharacter { text: text.to_owned(), suggestion: nearest_name(text) })
}

fn nearest_name(text: &str) -> Option<String> {
    let mapped: String = text
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' })
        .collect();
    let trimmed = mapped.trim_matches('-');
    (!trimmed.is_empty()).then(|| trimmed.to_owned())
}

/// The name of a node, a valid RFC 1123 label. Identity only: which life of its agent is meant is
/// said by [`crate::id::Incarnation`].
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeName(String);

impl NodeName {
    /// Checks and wraps a name.
    ///
    /// # Errors
    ///
    /// When `text` is not an RFC 1123 label.
    pub fn new(text: impl Into<String>) -> Result<Self, NameError> {
        let text = text.into();
        check_name(&text)?;
        Ok(NodeName(text))
    }

    /// The name as text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for NodeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for NodeName {
    type Err = NameError;

    fn from_str(text: &str) -> Result<Self, NameError> {
        NodeName::new(text)
    }
}

impl std::borrow::Borrow<str> for NodeName {
    fn borrow(&self) -> &str {
        &self.0
    }
}

/// Namespace and name of a namespaced object; prints as `namespace/name`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NamespacedName {
    /// The namespace.
    pub namespace: String,
    /// The name inside the namespace.
    pub name: String,
}

impl fmt::Display for NamespacedName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.namespace, self.name)
    }
}

/// One function of one device of a robot, `device:Function`: `kinect:ImageGen`, `base:Drive`
/// (Avalon, IV-A2). Sensors and actuators share the form.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FunctionName {
    device: String,
    function: String,
}

/// Why a text is not a [`FunctionName`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{text:?} is not a function of a device: write DEVICE:FUNCTION with letters, digits, '_', '-', '.' or '/'"
)]
pub struct FunctionNameError {
    text: String,
}

impl FunctionName {
    /// Checks the two parts.
    ///
    /// # Errors
    ///
    /// When a part is empty, longer than 63 bytes or holds other characters than `[A-Za-z0-9_./-]`.
    pub fn new(device: &str, function: &str) -> Result<Self, FunctionNameError> {
        let part = |p: &str| {
            !p.is_empty()
                && p.len() <= MAX_NAME_LEN
                && p.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c))
                && p != "."
                && !p.contains("..")
        };
        if part(device) && part(function) {
            Ok(FunctionName { device: device.to_owned(), function: function.to_owned() })
        } else {
            Err(FunctionNameError { text: format!("{device}:{function}") })
        }
    }

    /// Where a task finds it among files: `kinect/ImageGen`. Slashes of a name are underscores there, so that two names may have
    /// one path.
    #[must_use]
    pub fn path(&self) -> String {
        format!("{}/{}", self.device.replace('/', "_"), self.function.replace('/', "_"))
    }

    /// The device, `kinect`.
    #[must_use]
    pub fn device(&self) -> &str {
        &self.device
    }

    /// The function, `ImageGen`.
    #[must_use]
    pub fn function(&self) -> &str {
        &self.function
    }
}

impl fmt::Display for FunctionName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.device, self.function)
    }
}

impl FromStr for FunctionName {
    type Err = FunctionNameError;

    fn from_str(text: &str) -> Result<Self, FunctionNameError> {
        match text.trim().split_once(':') {
            Some((device, function)) => FunctionName::new(device.trim(), function.trim()),
            None => Err(FunctionNameError { text: text.to_owned() }),
        }
    }
}

impl Serialize for FunctionName {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for FunctionName {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        String::deserialize(d)?.parse().map_err(de::Error::custom)
    }
}

impl JsonSchema for FunctionName {
    fn schema_name() -> Cow<'static, str> {
        "FunctionName".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": "string",
            "format": "device-function",
            "description": "One function of one device, DEVICE:FUNCTION, as in kinect:ImageGen.",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_rfc_1123_labels() {
        for good in ["a", "robot-1", "0x", &"a".repeat(63)] {
            assert_eq!(check_name(good), Ok(()), "{good}");
        }
        for bad in ["", "-a", "a-", "A", "a_b", "a.b", "ä", &"a".repeat(64)] {
            assert!(check_name(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_bad_name_comes_with_the_nearest_good_one() {
        let error = check_name("Robot_1!").expect_err("capital letters");
        assert_eq!(error.suggestion(), Some("robot-1"));
        assert_eq!(check_name("___").expect_err("no letter").suggestion(), None);
    }

    #[test]
    fn function_names_print_as_they_parse() {
        let f: FunctionName = " kinect : ImageGen ".parse().expect("spaces are trimmed");
        assert_eq!(f.to_string(), "kinect:ImageGen");
        for bad in ["kinect", ":x", "x:", "a:b:c", "a:..", "../a:b", "a b:c"] {
            assert!(bad.parse::<FunctionName>().is_err(), "{bad}");
        }
    }
}
