//! Paths to fields, and sets of them as `FieldsV1` writes them.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde_json::{Map, Value};

/// One step into a value.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Step {
    /// A field of a structure or a key of a map.
    Field(String),
    /// The element of a list whose key fields have these values, as JSON.
    Key(BTreeMap<String, String>),
    /// The element of a set with this value, as JSON.
    Element(String),
}

impl Step {
    /// The element of a list with these key fields.
    #[must_use]
    pub fn key<'a>(fields: impl IntoIterator<Item = (&'a str, &'a Value)>) -> Self {
        let text = |(name, value): (&str, &Value)| (name.to_owned(), value.to_string());
        Self::Key(fields.into_iter().map(text).collect())
    }

    fn write(&self) -> String {
        match self {
            Self::Field(name) => format!("f:{name}"),
            Self::Element(value) => format!("v:{value}"),
            Self::Key(fields) => {
                let fields: Vec<String> = fields
                    .iter()
                    .map(|(name, value)| format!("{}:{value}", Value::from(name.as_str())))
                    .collect();
                format!("k:{{{}}}", fields.join(","))
            }
        }
    }

    fn read(text: &str) -> Option<Self> {
        let (kind, rest) = text.split_once(':')?;
        match kind {
            "f" => Some(Self::Field(rest.to_owned())),
            "v" => {
                let value: Value = serde_json::from_str(rest).ok()?;
                Some(Self::Element(value.to_string()))
            }
            "k" => {
                let fields: Map<String, Value> = serde_json::from_str(rest).ok()?;
                Some(Self::key(fields.iter().map(|(name, value)| (name.as_str(), value))))
            }
            // Positions in lists are never owned: lists without keys are replaced whole.
            _ => None,
        }
    }
}

/// A path to a field or an element.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Path(Vec<Step>);

impl Path {
    /// The path one step further.
    #[must_use]
    pub fn then(&self, step: Step) -> Self {
        let mut steps = self.0.clone();
        steps.push(step);
        Self(steps)
    }

    /// The steps from the object on.
    #[must_use]
    pub fn steps(&self) -> &[Step] {
        &self.0
    }

    /// Whether it is `other` or leads into it.
    #[must_use]
    pub fn starts_with(&self, other: &Self) -> bool {
        self.0.starts_with(&other.0)
    }
}

/// Whether `path`, or one that it leads into, is among these, which are those from `path` on in order: what it leads into
/// follows it at once.
pub(super) fn leads_into<'a>(path: &Path, mut from: impl Iterator<Item = &'a Path>) -> bool {
    from.next().is_some_and(|next| next.starts_with(path))
}

/// As Kubernetes writes it in conflicts: `.spec.env[name="A"].value`.
impl fmt::Display for Path {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for step in &self.0 {
            match step {
                Step::Field(name) => write!(f, ".{name}")?,
                Step::Element(value) => write!(f, "[={value}]")?,
                Step::Key(fields) => {
                    let fields: Vec<String> =
                        fields.iter().map(|(name, value)| format!("{name}={value}")).collect();
                    write!(f, "[{}]", fields.join(","))?;
                }
            }
        }
        Ok(())
    }
}

/// A set of fields.
pub type Fields = BTreeSet<Path>;

/// The set as `FieldsV1`: a tree of steps, with `.` where a step that has others below it is itself a member.
#[must_use]
pub fn write(fields: &Fields) -> Value {
    let mut root = Map::new();
    for path in fields {
        let mut place = &mut root;
        for (index, step) in path.0.iter().enumerate() {
            // Paths are in order: one that leads into another comes after it.
            let entry = place.entry(step.write()).or_insert_with(|| Value::Object(Map::new()));
            let Some(below) = entry.as_object_mut() else { break };
            if index + 1 < path.0.len() && fields.contains(&Path(path.0[..=index].to_vec())) {
                below.entry(".").or_insert_with(|| Value::Object(Map::new()));
            }
            place = below;
        }
    }
    Value::Object(root)
}

/// Reads `FieldsV1`; steps that are not understood are left out.
#[must_use]
pub fn read(tree: &Value) -> Fields {
    fn walk(tree: &Value, at: &Path, fields: &mut Fields) {
        let Some(members) = tree.as_object() else { return };
        if members.is_empty() || members.contains_key(".") {
            fields.insert(at.clone());
        }
        for (step, below) in members {
            if let Some(step) = Step::read(step) {
                walk(below, &at.then(step), fields);
            }
        }
    }
    let mut fields = Fields::new();
    walk(tree, &Path::default(), &mut fields);
    fields.remove(&Path::default());
    fields
}
