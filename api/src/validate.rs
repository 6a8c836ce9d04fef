//! What is wrong with an object: all violations at once, each with its field path, the reason and
//! what would be right.
//!
//! Two passes find them. [`walk_schema`] holds the JSON against the schema that a kind's Rust types
//! generate (unknown fields, missing fields, types, enums, formats) and goes on after each finding.
//! A kind's own rules follow on the typed value, when the first pass found nothing.

use std::fmt;

use serde_json::Value;

use crate::duration::Span;
use crate::name::FunctionName;
use crate::portion::Portion;
use crate::quantity::{BitRate, Bytes, MilliCpu};

/// The class of a violation; the reason word of a `metav1.StatusCause`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ViolationKind {
    /// A field that must be there is not.
    Required,
    /// The value cannot be right.
    Invalid,
    /// The value is none of those allowed, or the field does not exist.
    NotSupported,
    /// The same thing is given twice.
    Duplicate,
    /// The value may not be given here or may not change.
    Forbidden,
}

impl ViolationKind {
    /// The word Kubernetes uses in `details.causes[].reason`.
    #[must_use]
    pub fn cause_reason(self) -> &'static str {
        match self {
            ViolationKind::Required => "FieldValueRequired",
            ViolationKind::Invalid => "FieldValueInvalid",
            ViolationKind::NotSupported => "FieldValueNotSupported",
            ViolationKind::Duplicate => "FieldValueDuplicate",
            ViolationKind::Forbidden => "FieldValueForbidden",
        }
    }
}

/// One thing that is wrong.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// Where: `spec.run.process.command[0]`. Empty: the whole object.
    pub path: String,
    /// Which class.
    pub kind: ViolationKind,
    /// What is wrong, a clause whose subject is the field.
    pub reason: String,
    /// What would be right.
    pub suggestion: Option<String>,
}

impl Violation {
    /// Adds what would be right.
    pub fn suggest(&mut self, suggestion: impl Into<String>) {
        self.suggestion = Some(suggestion.into());
    }

    /// Reason and suggestion without the path, as `details.causes[].message` wants them.
    #[must_use]
    pub fn message(&self) -> String {
        match &self.suggestion {
            Some(suggestion) => format!("{}; {suggestion}", self.reason),
            None => self.reason.clone(),
        }
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.path.is_empty() {
            write!(f, "{}: ", self.path)?;
        }
        f.write_str(&self.message())
    }
}

/// As many findings as are told. Who has more than this wrong starts with these; an object may hold a million.
pub const MOST: usize = 100;
/// The longest name, bytes, for which one is looked up that was meant.
const LONGEST: usize = 64;

/// What was found wrong with one object, in the order of finding; [`MOST`] at most.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Violations {
    /// The one after the last stands for all that were found later, and is told nobody.
    found: Vec<Violation>,
}

impl Violations {
    /// None yet.
    #[must_use]
    pub fn new() -> Self {
        Violations::default()
    }

    fn push(&mut self, path: String, kind: ViolationKind, reason: String) -> &mut Violation {
        self.found.truncate(MOST);
        let index = self.found.len();
        self.found.push(Violation { path, kind, reason, suggestion: None });
        &mut self.found[index]
    }

    /// More is wrong than is told; nobody need look further.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.found.len() > MOST
    }

    fn told(&self) -> &[Violation] {
        &self.found[..self.found.len().min(MOST)]
    }

    /// A field that must be there is not.
    pub fn required(&mut self, path: impl Into<String>) -> &mut Violation {
        self.push(path.into(), ViolationKind::Required, "is required".to_owned())
    }

    /// A value that cannot be right.
    pub fn invalid(
        &mut self,
        path: impl Into<String>,
        reason: impl Into<String>,
    ) -> &mut Violation {
        self.push(path.into(), ViolationKind::Invalid, reason.into())
    }

    /// A value or a field that does not exist.
    pub fn not_supported(
        &mut self,
        path: impl Into<String>,
        reason: impl Into<String>,
    ) -> &mut Violation {
        self.push(path.into(), ViolationKind::NotSupported, reason.into())
    }

    /// Something given twice.
    pub fn duplicate(
        &mut self,
        path: impl Into<String>,
        reason: impl Into<String>,
    ) -> &mut Violation {
        self.push(path.into(), ViolationKind::Duplicate, reason.into())
    }

    /// Something that may not be given or changed.
    pub fn forbidden(
        &mut self,
        path: impl Into<String>,
        reason: impl Into<String>,
    ) -> &mut Violation {
        self.push(path.into(), ViolationKind::Forbidden, reason.into())
    }

    /// Nothing is wrong.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// The findings.
    pub fn iter(&self) -> std::slice::Iter<'_, Violation> {
        self.told().iter()
    }

    /// `Ok(value)` when nothing is wrong.
    ///
    /// # Errors
    ///
    /// The findings, when there are any.
    pub fn into_result<T>(self, value: T) -> Result<T, Violations> {
        if self.is_empty() { Ok(value) } else { Err(self) }
    }

    /// The same findings in an object that lies deeper: paths that begin with `from` begin with `to`.
    #[must_use]
    pub fn below(mut self, from: &str, to: &str) -> Self {
        for violation in &mut self.found {
            if let Some(rest) = violation.path.strip_prefix(from) {
                violation.path = format!("{to}{rest}");
            }
        }
        self
    }

    /// Adds what was found elsewhere, and that it was more than is told.
    pub fn append(&mut self, more: Violations) {
        self.found.extend(more.found);
        self.found.truncate(MOST + 1);
    }

    /// Keeps the findings for which `keep` holds.
    pub fn retain(&mut self, keep: impl FnMut(&Violation) -> bool) {
        self.found.retain(keep);
    }
}

impl Extend<Violation> for Violations {
    fn extend<I: IntoIterator<Item = Violation>>(&mut self, more: I) {
        for violation in more {
            if self.is_full() {
                return;
            }
            self.found.push(violation);
        }
    }
}

impl IntoIterator for Violations {
    type Item = Violation;
    type IntoIter = std::vec::IntoIter<Violation>;

    fn into_iter(mut self) -> Self::IntoIter {
        self.found.truncate(MOST);
        self.found.into_iter()
    }
}

impl fmt::Display for Violations {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let texts: Vec<String> = self.iter().map(Violation::to_string).collect();
        f.write_str(&texts.join("\n"))?;
        if self.is_full() { write!(f, "\nand more") } else { Ok(()) }
    }
}

impl std::error::Error for Violations {}

/// Path of the member `key` of the object at `path`; a key with other characters than a
/// field name's is put in brackets.
#[must_use]
pub fn member_path(path: &str, key: &str) -> String {
    let plain =
        !key.is_empty() && key.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    match (plain, path.is_empty()) {
        (true, true) => key.to_owned(),
        (true, false) => format!("{path}.{key}"),
        (false, _) => format!("{path}[{key:?}]"),
    }
}

/// Path of the element `index` of the list at `path`.
#[must_use]
pub fn element_path(path: &str, index: usize) -> String {
    format!("{path}[{index}]")
}

/// `; did you mean "cpu"?`, when one of `known` is near to `given`; none for what is longer than any name.
#[must_use]
pub fn did_you_mean<'a>(given: &str, known: impl IntoIterator<Item = &'a str>) -> Option<String> {
    if given.len() > LONGEST {
        return None;
    }
    let lower = given.to_ascii_lowercase();
    known
        .into_iter()
        .map(|k| (strsim::damerau_levenshtein(&lower, &k.to_ascii_lowercase()), k))
        .min_by_key(|(distance, _)| *distance)
        .filter(|(distance, k)| *distance <= 2.max(k.len() / 3))
        .map(|(_, k)| format!("did you mean {k:?}?"))
}

/// Holds `value` against a JSON schema made by schemars with inlined sub-schemas, and adds what
/// does not fit. Null means absent, as in Kubernetes.
pub fn walk_schema(schema: &Value, value: &Value, path: &str, violations: &mut Violations) {
    if violations.is_full() {
        return;
    }
    let schema = without_null(schema);
    if let Some(allowed) = allowed_texts(schema) {
        walk_enum(&allowed, value, path, violations);
    } else if let Some(check) = schema.get("format").and_then(Value::as_str).and_then(format_check)
    {
        if let Err(problem) = check(value) {
            let violation = violations.invalid(path, problem.reason);
            violation.suggestion = problem.suggestion;
        }
    } else {
        match schema_type(schema) {
            Some("object") => walk_object(schema, value, path, violations),
            Some("array") => walk_array(schema, value, path, violations),
            Some(scalar) => walk_scalar(scalar, schema, value, path, violations),
            None => {}
        }
    }
}

/// Adds the fields of `value` that its schema does not have, where it is a schema of Kubernetes' types: they say which fields
/// there are, and not that there are no others.
pub fn walk_fields(schema: &Value, value: &Value, path: &str, violations: &mut Violations) {
    let schema = without_null(schema);
    let schema = match schema.get("allOf").and_then(Value::as_array).map(Vec::as_slice) {
        Some([only]) => only,
        _ => schema,
    };
    match value {
        Value::Array(elements) => {
            let Some(items) = schema.get("items") else { return };
            for (i, element) in elements.iter().enumerate() {
                walk_fields(items, element, &element_path(path, i), violations);
            }
        }
        Value::Object(members) => {
            let Some(known) = schema.get("properties").and_then(Value::as_object) else { return };
            for (key, member) in members.iter().filter(|(_, member)| !member.is_null()) {
                if violations.is_full() {
                    return;
                }
                let path = member_path(path, key);
                match known.get(key) {
                    Some(schema) => walk_fields(schema, member, &path, violations),
                    None => {
                        violations.not_supported(path, "is not a field").suggestion =
                            did_you_mean(key, known.keys().map(String::as_str));
                    }
                }
            }
        }
        _ => {}
    }
}

/// The schema of an optional field without its "or null" branch.
fn without_null(schema: &Value) -> &Value {
    let Some(branches) = schema.get("anyOf").and_then(Value::as_array) else {
        return schema;
    };
    let is_null = |s: &Value| s.get("type").and_then(Value::as_str) == Some("null");
    match branches.iter().filter(|s| !is_null(s)).collect::<Vec<_>>()[..] {
        [only] => without_null(only),
        _ => schema,
    }
}

fn schema_type(schema: &Value) -> Option<&str> {
    match schema.get("type")? {
        Value::String(one) => Some(one),
        Value::Array(several) => several.iter().filter_map(Value::as_str).find(|t| *t != "null"),
        _ => None,
    }
}

/// The values of an enum of units, in both forms that schemars gives it.
fn allowed_texts(schema: &Value) -> Option<Vec<&str>> {
    if let Some(list) = schema.get("enum").and_then(Value::as_array) {
        return Some(list.iter().filter_map(Value::as_str).collect());
    }
    let branches = schema.get("oneOf").and_then(Value::as_array)?;
    let mut texts = Vec::new();
    for branch in branches {
        match (branch.get("const").and_then(Value::as_str), allowed_texts(branch)) {
            (Some(text), _) => texts.push(text),
            (None, Some(more)) => texts.extend(more),
            (None, None) => return None,
        }
    }
    Some(texts)
}

fn walk_enum(allowed: &[&str], value: &Value, path: &str, violations: &mut Violations) {
    let given = match value {
        Value::String(text) if allowed.contains(&text.as_str()) => return,
        Value::String(text) => format!("{text:?}"),
        other => describe(other),
    };
    let quoted: Vec<String> = allowed.iter().map(|a| format!("{a:?}")).collect();
    let near = value.as_str().and_then(|text| did_you_mean(text, allowed.iter().copied()));
    let violation =
        violations.not_supported(path, format!("{given} is none of {}", quoted.join(", ")));
    violation.suggestion = near;
}

fn walk_object(schema: &Value, value: &Value, path: &str, violations: &mut Violations) {
    let Value::Object(members) = value else {
        violations.invalid(path, format!("{} where fields are expected", describe(value)));
        return;
    };
    let empty = serde_json::Map::new();
    let properties = schema.get("properties").and_then(Value::as_object).unwrap_or(&empty);
    let additional = schema.get("additionalProperties");
    for (key, member) in members.iter().filter(|(_, m)| !m.is_null()) {
        if violations.is_full() {
            return;
        }
        let path = member_path(path, key);
        match (properties.get(key), additional) {
            (Some(schema), _) => walk_schema(schema, member, &path, violations),
            (None, Some(Value::Bool(false))) => {
                let violation = violations.not_supported(path, "is not a field");
                violation.suggestion = did_you_mean(key, properties.keys().map(String::as_str))
                    .or_else(|| {
                        let known: Vec<&str> = properties.keys().map(String::as_str).collect();
                        (!known.is_empty())
                            .then(|| format!("the fields here are {}", known.join(", ")))
                    });
            }
            (None, Some(schema @ Value::Object(_))) => {
                walk_schema(schema, member, &path, violations)
            }
            (None, _) => {}
        }
    }
    let required = schema.get("required").and_then(Value::as_array).into_iter().flatten();
    for key in required.filter_map(Value::as_str) {
        if members.get(key).is_none_or(Value::is_null) {
            violations.required(member_path(path, key));
        }
    }
}

fn walk_array(schema: &Value, value: &Value, path: &str, violations: &mut Violations) {
    let Value::Array(elements) = value else {
        violations
            .invalid(path, format!("{} where a list is expected", describe(value)))
            .suggest("write it as [a, b] or one '- ' a line");
        return;
    };
    if let Some(items) = schema.get("items") {
        for (i, element) in elements.iter().enumerate() {
            if violations.is_full() {
                return;
            }
            walk_schema(items, element, &element_path(path, i), violations);
        }
    }
}

fn walk_scalar(
    scalar: &str,
    schema: &Value,
    value: &Value,
    path: &str,
    violations: &mut Violations,
) {
    let fits = match scalar {
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_i64() || value.is_u64(),
        "number" => value.is_number(),
        _ => true,
    };
    if !fits {
        let expected = match scalar {
            "string" => "a text",
            "boolean" => "true or false",
            "integer" => "a whole number",
            _ => "a number",
        };
        let violation =
            violations.invalid(path, format!("{} where {expected} is expected", describe(value)));
        if scalar == "string" && !value.is_object() && !value.is_array() {
            violation.suggest(format!("put it in quotes: \"{value}\""));
        }
        return;
    }
    let Some(number) = value.as_f64() else { return };
    let limit = |name: &str| schema.get(name).and_then(Value::as_f64);
    if let Some(minimum) = limit("minimum").filter(|m| number < *m) {
        violations.invalid(path, format!("{value} is less than the smallest allowed, {minimum}"));
    }
    if let Some(maximum) = limit("maximum").filter(|m| number > *m) {
        violations.invalid(path, format!("{value} is more than the largest allowed, {maximum}"));
    }
}

fn describe(value: &Value) -> String {
    match value {
        Value::Null => "nothing".to_owned(),
        Value::Bool(_) | Value::Number(_) => format!("is {value}"),
        Value::String(text) => format!("is the text {text:?}"),
        Value::Array(_) => "is a list".to_owned(),
        Value::Object(_) => "has fields".to_owned(),
    }
}

struct FormatProblem {
    reason: String,
    suggestion: Option<String>,
}

type FormatCheck = fn(&Value) -> Result<(), FormatProblem>;

fn format_check(format: &str) -> Option<FormatCheck> {
    Some(match format {
        "cpu-quantity" => |value| {
            scalar_text(value)?.parse::<MilliCpu>().map(drop).map_err(|e| FormatProblem {
                reason: e.to_string(),
                suggestion: Some(e.suggestion().to_owned()),
            })
        },
        "byte-quantity" => |value| {
            scalar_text(value)?.parse::<Bytes>().map(drop).map_err(|e| FormatProblem {
                reason: e.to_string(),
                suggestion: Some(e.suggestion().to_owned()),
            })
        },
        "bit-rate" => |value| {
            scalar_text(value)?.parse::<BitRate>().map(drop).map_err(|e| FormatProblem {
                reason: e.to_string(),
                suggestion: Some(e.suggestion().to_owned()),
            })
        },
        "portion" => |value| {
            let portion = scalar_text(value)?.parse::<Portion>();
            portion.map(drop).map_err(|e| FormatProblem {
                reason: e.to_string(),
                suggestion: Some(e.suggestion().to_owned()),
            })
        },
        "duration" => |value| {
            scalar_text(value)?.parse::<Span>().map_err(|e| FormatProblem {
                reason: e.to_string(),
                suggestion: Some(e.suggestion()),
            })?;
            if value.is_string() {
                Ok(())
            } else {
                Err(FormatProblem {
                    reason: format!("{value} has no unit"),
                    suggestion: Some(format!("try \"{value}s\"")),
                })
            }
        },
        "device-function" => |value| match value {
            Value::String(text) => {
                text.parse::<FunctionName>().map(drop).map_err(|e| FormatProblem {
                    reason: e.to_string(),
                    suggestion: Some("for example \"kinect:ImageGen\"".to_owned()),
                })
            }
            other => Err(FormatProblem {
                reason: format!("{} where DEVICE:FUNCTION is expected", describe(other)),
                suggestion: None,
            }),
        },
        _ => return None,
    })
}

fn scalar_text(value: &Value) -> Result<String, FormatProblem> {
    match value {
        Value::String(text) => Ok(text.clone()),
        Value::Number(number) => Ok(number.to_string()),
        other => Err(FormatProblem {
            reason: format!("{} where a quantity is expected", describe(other)),
            suggestion: None,
        }),
    }
}

#[cfg(test)]
mod tests;
