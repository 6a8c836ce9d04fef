//! Selectors: which objects are meant, by label or by field.
//!
//! The text grammar is Kubernetes': `app=cam,tier!=test,zone in (a,b),!legacy,gpu`.

use std::collections::BTreeMap;
use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::name::check_name;
use crate::validate::{Violations, member_path};

/// The labels of an object.
pub type Labels = BTreeMap<String, String>;

/// A selector as manifests write it; all parts must hold.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct LabelSelector {
    /// Labels that must be there with these values.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub match_labels: Labels,
    /// Requirements on single labels.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub match_expressions: Vec<LabelRequirement>,
}

/// A requirement on one label.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct LabelRequirement {
    /// The label.
    pub key: String,
    /// How its value is compared.
    pub operator: LabelOperator,
    /// What it is compared with; none for Exists and DoesNotExist.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub values: Vec<String>,
}

/// How a label's value is compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum LabelOperator {
    /// The label is there with one of the values.
    In,
    /// The label is not there, or has none of the values.
    NotIn,
    /// The label is there.
    Exists,
    /// The label is not there.
    DoesNotExist,
}

impl LabelRequirement {
    /// Whether `labels` meet the requirement.
    #[must_use]
    pub fn matches(&self, labels: &Labels) -> bool {
        let value = labels.get(&self.key);
        match self.operator {
            LabelOperator::In => value.is_some_and(|v| self.values.contains(v)),
            LabelOperator::NotIn => value.is_none_or(|v| !self.values.contains(v)),
            LabelOperator::Exists => value.is_some(),
            LabelOperator::DoesNotExist => value.is_none(),
        }
    }
}

impl LabelSelector {
    /// Whether every part holds; the empty selector matches everything.
    #[must_use]
    pub fn matches(&self, labels: &Labels) -> bool {
        self.match_labels.iter().all(|(k, v)| labels.get(k) == Some(v))
            && self.match_expressions.iter().all(|r| r.matches(labels))
    }

    /// Nothing is required.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.match_labels.is_empty() && self.match_expressions.is_empty()
    }

    /// Reads the text grammar.
    ///
    /// # Errors
    ///
    /// Names the part that cannot be read.
    pub fn parse(text: &str) -> Result<Self, SelectorError> {
        let mut selector = LabelSelector::default();
        if text.trim().is_empty() {
            return Ok(selector);
        }
        // An empty part is a mistake: `app=$APP,$MORE` without a MORE would select more than was meant.
        for part in split_outside_parentheses(text) {
            selector.match_expressions.push(parse_requirement(part.trim())?);
        }
        Ok(selector)
    }

    /// Adds what is wrong with this selector below `path`.
    pub fn validate(&self, path: &str, violations: &mut Violations) {
        check_labels(&self.match_labels, &format!("{path}.matchLabels"), violations);
        for (i, requirement) in self.match_expressions.iter().enumerate() {
            if !is_label_key(&requirement.key) {
                let path = format!("{path}.matchExpressions[{i}].key");
                violations.invalid(path, not_a_key(&requirement.key));
            }
            for (n, value) in requirement.values.iter().enumerate() {
                if !is_label_value(value) {
                    let path = format!("{path}.matchExpressions[{i}].values[{n}]");
                    violations.invalid(path, not_a_value(value));
                }
            }
            let needs_values =
                matches!(requirement.operator, LabelOperator::In | LabelOperator::NotIn);
            if needs_values == requirement.values.is_empty() {
                let (reason, suggestion) = if needs_values {
                    ("is needed with the operators In and NotIn", "give at least one value")
                } else {
                    (
                        "is not allowed with the operators Exists and DoesNotExist",
                        "leave `values` out",
                    )
                };
                violations
                    .invalid(format!("{path}.matchExpressions[{i}].values"), reason)
                    .suggest(suggestion);
            }
        }
    }
}

/// A part of a selector's text that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{part:?} is not a {what} requirement; {suggestion}")]
pub struct SelectorError {
    part: String,
    what: &'static str,
    suggestion: &'static str,
}

fn label_error(part: &str) -> SelectorError {
    SelectorError {
        part: part.to_owned(),
        what: "label",
        suggestion: "write key=value, key!=value, key in (a,b), key notin (a,b), key or !key",
    }
}

fn split_outside_parentheses(text: &str) -> Vec<&str> {
    let (mut parts, mut depth, mut start) = (Vec::new(), 0_i32, 0);
    for (i, c) in text.char_indices() {
        match c {
            '(' => depth += 1,
            ')' => depth -= 1,
            ',' if depth <= 0 => {
                parts.push(&text[start..i]);
                start = i + 1;
            }
            _ => {}
        }
    }
    parts.push(&text[start..]);
    parts
}

/// Adds what is wrong with the labels of an object at `path` (Kubernetes' rules).
pub fn check_labels(labels: &Labels, path: &str, violations: &mut Violations) {
    for (key, value) in labels {
        if !is_label_key(key) {
            violations.invalid(member_path(path, key), not_a_key(key));
        }
        if !is_label_value(value) {
            violations.invalid(member_path(path, key), not_a_value(value));
        }
    }
}

const NAME: &str =
    "at most 63 letters, digits, '-', '_' and '.', beginning and ending with a letter or digit";

fn not_a_key(key: &str) -> String {
    format!(
        "{key:?} is not a label's key: {NAME}, perhaps after a domain and a slash, example.dev/name"
    )
}

fn not_a_value(value: &str) -> String {
    format!("{value:?} is not a label's value: {NAME}")
}

/// A name, or a DNS subdomain, `/` and a name.
fn is_label_key(key: &str) -> bool {
    let (prefix, name) = match key.split_once('/') {
        Some((prefix, name)) => (Some(prefix), name),
        None => (None, key),
    };
    let is_subdomain =
        |text: &str| text.len() <= 253 && text.split('.').all(|part| check_name(part).is_ok());
    !name.is_empty() && is_label_value(name) && prefix.is_none_or(is_subdomain)
}

fn is_label_value(value: &str) -> bool {
    let outer = |c: char| c.is_ascii_alphanumeric();
    value.is_empty()
        || (value.len() <= 63
            && value.starts_with(outer)
            && value.ends_with(outer)
            && value.chars().all(|c| outer(c) || "-_.".contains(c)))
}

fn parse_requirement(part: &str) -> Result<LabelRequirement, SelectorError> {
    let build = |key: &str, operator, values: Vec<String>| {
        let key = key.trim();
        if is_label_key(key) && values.iter().all(|v| is_label_value(v)) {
            Ok(LabelRequirement { key: key.to_owned(), operator, values })
        } else {
            Err(label_error(part))
        }
    };
    if let Some(key) = part.strip_prefix('!') {
        return build(key, LabelOperator::DoesNotExist, Vec::new());
    }
    for (token, operator) in
        [("!=", LabelOperator::NotIn), ("==", LabelOperator::In), ("=", LabelOperator::In)]
    {
        if let Some((key, value)) = part.split_once(token) {
            return build(key, operator, vec![value.trim().to_owned()]);
        }
    }
    let Some(open) = part.find('(') else {
        return build(part, LabelOperator::Exists, Vec::new());
    };
    let list = part[open + 1..].strip_suffix(')').ok_or_else(|| label_error(part))?;
    let mut head = part[..open].split_whitespace();
    let (key, word) = (head.next().unwrap_or(""), head.next().unwrap_or(""));
    let values = list.split(',').map(|v| v.trim().to_owned()).collect();
    match (word, head.next()) {
        ("in", None) => build(key, LabelOperator::In, values),
        ("notin", None) => build(key, LabelOperator::NotIn, values),
        _ => Err(label_error(part)),
    }
}

/// A requirement on one field, `spec.node=turtlebot-1`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FieldRequirement {
    /// Dotted path of the field.
    pub path: String,
    /// True: the field must have the value. False: it must not.
    pub equal: bool,
    /// The value; a field that is not there has the empty one.
    pub value: String,
}

/// Requirements on fields; all must hold.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct FieldSelector(pub Vec<FieldRequirement>);

impl FieldSelector {
    /// Reads `a.b=c,d!=e`. Which paths a kind can be selected by is the server's matter.
    ///
    /// # Errors
    ///
    /// Names the part that cannot be read.
    pub fn parse(text: &str) -> Result<Self, SelectorError> {
        let requirement = |part: &str| {
            let (path, equal, value) = match (part.split_once("!="), part.split_once("==")) {
                (Some((path, value)), _) => (path, false, value),
                (None, Some((path, value))) => (path, true, value),
                (None, None) => part
                    .split_once('=')
                    .map(|(path, value)| (path, true, value))
                    .ok_or_else(|| SelectorError {
                        part: part.to_owned(),
                        what: "field",
                        suggestion: "write path=value or path!=value",
                    })?,
            };
            Ok(FieldRequirement {
                path: path.trim().to_owned(),
                equal,
                value: value.trim().to_owned(),
            })
        };
        text.split(',')
            .map(str::trim)
            .filter(|p| !p.is_empty())
            .map(requirement)
            .collect::<Result<_, _>>()
            .map(FieldSelector)
    }

    /// Whether an object's JSON meets every requirement.
    #[must_use]
    pub fn matches(&self, object: &serde_json::Value) -> bool {
        self.0.iter().all(|r| (field_text(object, &r.path) == r.value) == r.equal)
    }
}

/// The value at a path as selectors compare it; a missing one is empty.
#[must_use]
pub fn field_text(object: &serde_json::Value, path: &str) -> String {
    let found = path.split('.').try_fold(object, |value, step| value.get(step));
    match found {
        None | Some(serde_json::Value::Null) => String::new(),
        Some(serde_json::Value::String(text)) => text.clone(),
        Some(other) => other.to_string(),
    }
}

impl fmt::Display for LabelSelector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut separator = "";
        for (key, value) in &self.match_labels {
            write!(f, "{separator}{key}={value}")?;
            separator = ",";
        }
        for r in &self.match_expressions {
            f.write_str(separator)?;
            separator = ",";
            let values = r.values.join(",");
            match (r.operator, r.values.len()) {
                (LabelOperator::In, 1) => write!(f, "{}={values}", r.key)?,
                (LabelOperator::NotIn, 1) => write!(f, "{}!={values}", r.key)?,
                (LabelOperator::In, _) => write!(f, "{} in ({values})", r.key)?,
                (LabelOperator::NotIn, _) => write!(f, "{} notin ({values})", r.key)?,
                (LabelOperator::Exists, _) => f.write_str(&r.key)?,
                (LabelOperator::DoesNotExist, _) => write!(f, "!{}", r.key)?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn labels(pairs: &[(&str, &str)]) -> Labels {
        pairs.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect()
    }

    #[test]
    fn the_text_grammar_is_kubernetes() {
        let cam = labels(&[("app", "cam"), ("zone", "a"), ("gpu", "")]);
        for (text, holds) in [
            ("app=cam", true),
            ("app==cam", true),
            ("app!=cam", false),
            ("other!=cam", true),
            ("zone in (a,b),app=cam", true),
            ("zone notin (a, b)", false),
            ("gpu", true),
            ("!gpu", false),
            ("!legacy", true),
            ("gpu=", true),
            ("", true),
        ] {
            assert_eq!(LabelSelector::parse(text).expect(text).matches(&cam), holds, "{text}");
        }
        for bad in ["=x", "a in b", "a in (b", "a b", "a within (b)", "a=b c", "!"] {
            assert!(LabelSelector::parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_printed_selector_reads_back_the_same() {
        let text = "app=cam,tier!=test,zone in (a,b),x notin (c,d),!legacy,gpu";
        assert_eq!(LabelSelector::parse(text).expect(text).to_string(), text);
    }

    #[test]
    fn fields_compare_as_text_and_a_missing_one_is_empty() {
        let object = json!({"spec": {"node": "r1", "priority": 3}, "status": {"phase": "Running"}});
        for (text, holds) in [
            ("spec.node=r1,status.phase!=Pending", true),
            ("spec.priority=3", true),
            ("spec.none=", true),
            ("spec.node!=r1", false),
        ] {
            assert_eq!(FieldSelector::parse(text).expect(text).matches(&object), holds, "{text}");
        }
        assert!(FieldSelector::parse("node").is_err());
    }
}
