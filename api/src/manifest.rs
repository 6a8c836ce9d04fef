//! Manifests: YAML or JSON text → objects, with the place of every field.
//!
//! The values are read by serde-saphyr; the places come from a second walk over the same parser's
//! events, so that a violation found anywhere later can still say `file:line:column`.

use std::collections::HashMap;
use std::fmt;

use granit_parser::{Event, Parser, Span};
use serde_json::Value;

use crate::kind;
use crate::validate::{Violation, Violations, element_path, member_path};

/// A place in a text; both count from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Location {
    /// Line.
    pub line: usize,
    /// Column, in characters.
    pub column: usize,
}

/// One object of a manifest and where each of its fields stands.
#[derive(Debug, Clone)]
pub struct Document {
    /// What the text is called in messages, usually its path.
    pub source: String,
    /// The object as written.
    pub object: Value,
    places: HashMap<String, Location>,
}

/// Something wrong at a place of a manifest; prints as `file:line:column: path: reason; suggestion`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// What the text is called.
    pub source: String,
    /// Where in it.
    pub location: Location,
    /// What is wrong there.
    pub violation: Violation,
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Location { line, column } = self.location;
        write!(f, "{}:{line}:{column}: {}", self.source, self.violation)
    }
}

/// Everything wrong with a manifest, in the order of places.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ManifestError(pub Vec<Diagnostic>);

impl fmt::Display for ManifestError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lines: Vec<String> = self.0.iter().map(Diagnostic::to_string).collect();
        f.write_str(&lines.join("\n"))
    }
}

impl std::error::Error for ManifestError {}

impl Document {
    /// Where the field at `path` stands, or the nearest field around it that does.
    #[must_use]
    pub fn locate(&self, path: &str) -> Location {
        let mut path = path;
        loop {
            if let Some(place) = self.places.get(path) {
                return *place;
            }
            if path.is_empty() {
                return Location { line: 1, column: 1 };
            }
            path = parent_path(path);
        }
    }

    /// `apiVersion`, `kind` and the name, as far as they are there; for messages.
    #[must_use]
    pub fn title(&self) -> String {
        let text = |path: &str| {
            self.object.pointer(path).and_then(Value::as_str).unwrap_or("?").to_owned()
        };
        format!("{} {}", text("/kind"), text("/metadata/name"))
    }

    /// Puts violations at their places.
    #[must_use]
    pub fn diagnose(&self, violations: Violations) -> ManifestError {
        let mut all: Vec<Diagnostic> = violations
            .into_iter()
            .map(|violation| Diagnostic {
                source: self.source.clone(),
                location: self.locate(&violation.path),
                violation,
            })
            .collect();
        all.sort_by_key(|d| d.location);
        ManifestError(all)
    }

    /// Checks the object as the server will, and gives it back with the defaults filled in.
    ///
    /// # Errors
    ///
    /// Everything that is wrong with it, each at its place.
    pub fn admit(&self) -> Result<Value, ManifestError> {
        kind::admit(&self.object).map_err(|violations| self.diagnose(violations))
    }
}

fn parent_path(path: &str) -> &str {
    let cut = if path.ends_with(']') {
        path.rfind('[')
    } else {
        path.rfind(['.', ']']).map(|i| if path[i..].starts_with(']') { i + 1 } else { i })
    };
    &path[..cut.unwrap_or(0)]
}

/// Reads every object of a text; documents that hold nothing are left out.
///
/// # Errors
///
/// The first place at which the text is not YAML, or a document that is not an object.
pub fn parse(source: &str, text: &str) -> Result<Vec<Document>, ManifestError> {
    let fail = |location, reason: &str| {
        let mut violations = Violations::new();
        violations.invalid("", reason);
        let violation = violations.into_iter().next().expect("one was pushed just now");
        ManifestError(vec![Diagnostic { source: source.to_owned(), location, violation }])
    };
    let objects: Vec<Value> = serde_saphyr::from_multiple(text).map_err(|error| {
        let location = error.location().map_or(Location { line: 1, column: 1 }, |l| Location {
            line: l.line() as usize,
            column: l.column() as usize,
        });
        fail(location, &reason_of(&error))
    })?;
    let places = index(text).map_err(|error| {
        let marker = error.marker();
        fail(Location { line: marker.line(), column: marker.col() + 1 }, &error.info())
    })?;
    let objects: Vec<Value> = objects.into_iter().filter(|o| !o.is_null()).collect();
    let mut documents = Vec::with_capacity(objects.len());
    for (object, places) in objects.into_iter().zip(places) {
        let document = Document { source: source.to_owned(), object, places };
        if !document.object.is_object() {
            return Err(fail(
                document.locate(""),
                "is not an object: it needs apiVersion, kind and metadata",
            ));
        }
        documents.push(document);
    }
    Ok(documents)
}

/// The reader's reason without the place, which is said in front of it, and without advice for
/// programmers.
fn reason_of(error: &serde_saphyr::Error) -> String {
    let text = error.without_snippet().to_string();
    let line = text.lines().next().unwrap_or_default();
    if let Some(key) = line.strip_prefix("duplicate mapping key: ") {
        let key = key.split(',').next().unwrap_or_default();
        return format!("the field {key:?} is there twice");
    }
    line.rsplit_once(" at line ").map_or(line, |(reason, _)| reason).to_owned()
}

/// What the walk over the events stands in.
enum Level {
    Sequence { path: String, next: usize },
    Mapping { path: String, key: Option<String> },
}

type Places = HashMap<String, Location>;

/// The places of every document that holds something, by field path. A mapping's member stands
/// where its key stands, an element of a list where it begins.
fn index(text: &str) -> Result<Vec<Places>, granit_parser::ScanError> {
    let mut documents = Vec::new();
    let mut places = Places::new();
    let mut levels: Vec<Level> = Vec::new();
    let mut empty = true;
    for next in Parser::new_from_str(text) {
        let (event, span) = next?;
        match event {
            Event::DocumentStart(..) => (places, empty) = (Places::new(), true),
            Event::DocumentEnd if !empty => documents.push(std::mem::take(&mut places)),
            Event::SequenceEnd | Event::MappingEnd => {
                levels.pop();
            }
            Event::Scalar(ref value, ..) => {
                if let Some(Level::Mapping { path, key: key @ None }) = levels.last_mut() {
                    places.entry(member_path(path, value)).or_insert_with(|| begin(&span));
                    *key = Some(value.to_string());
                    continue;
                }
                empty = empty && levels.is_empty() && is_null(value);
                enter(&mut levels, &mut places, &span);
            }
            Event::Alias(..) => {
                enter(&mut levels, &mut places, &span);
            }
            Event::SequenceStart(..) => {
                let path = enter(&mut levels, &mut places, &span);
                levels.push(Level::Sequence { path, next: 0 });
                empty = false;
            }
            Event::MappingStart(..) => {
                let path = enter(&mut levels, &mut places, &span);
                levels.push(Level::Mapping { path, key: None });
                empty = false;
            }
            _ => {}
        }
    }
    Ok(documents)
}

/// Notes where the node that begins now stands, and gives its path.
fn enter(levels: &mut [Level], places: &mut Places, span: &Span) -> String {
    let path = match levels.last_mut() {
        None => String::new(),
        Some(Level::Sequence { path, next }) => {
            *next += 1;
            element_path(path, *next - 1)
        }
        Some(Level::Mapping { path, key }) => member_path(path, &key.take().unwrap_or_default()),
    };
    places.entry(path.clone()).or_insert_with(|| begin(span));
    path
}

fn begin(span: &Span) -> Location {
    Location { line: span.start.line(), column: span.start.col() + 1 }
}

fn is_null(scalar: &str) -> bool {
    matches!(scalar, "" | "~" | "null" | "Null" | "NULL")
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: &str = "# a comment\n---\napiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata:\n  name: one\n  labels: {app.kubernetes.io/x: y}\nspec:\n  list:\n    - a\n    - b: 1\n---\n---\nkind: Other\n";

    #[test]
    fn every_field_knows_its_place() {
        let documents = parse("m.yaml", TWO).expect("good YAML");
        assert_eq!(documents.len(), 2, "the empty document is left out");
        let at = |path| {
            let Location { line, column } = documents[0].locate(path);
            (line, column)
        };
        assert_eq!(at("metadata.name"), (6, 3));
        assert_eq!(at("spec.list[0]"), (10, 7));
        assert_eq!(at("spec.list[1].b"), (11, 7));
        assert_eq!(at("spec.list[1].missing.deeper"), (11, 7), "nearest field around it");
        assert_eq!(at("metadata.labels[\"app.kubernetes.io/x\"]"), (7, 12));
        assert_eq!(at("nothing.like.it"), (3, 1));
        assert_eq!(documents[1].locate("kind"), Location { line: 14, column: 1 });
    }

    #[test]
    fn broken_yaml_says_where() {
        for (text, line) in [("a: [1, 2\nb: 3\n", 2), ("a: 1\na: 2\n", 2), ("a: b: c\n", 1)] {
            let error = parse("m.yaml", text).expect_err(text);
            assert_eq!(error.0[0].location.line, line, "{error}");
            assert!(error.to_string().starts_with("m.yaml:"), "{error}");
        }
    }

    #[test]
    fn a_document_that_is_no_object_is_refused() {
        assert!(
            parse("m.yaml", "- a\n- b\n")
                .expect_err("a list")
                .to_string()
                .contains("is not an object")
        );
    }

    #[test]
    fn json_is_yaml() {
        let documents =
            parse("m.json", "{\"kind\": \"Task\",\n \"spec\": {\"a\": 1}}").expect("good JSON");
        assert_eq!(documents[0].locate("spec.a"), Location { line: 2, column: 11 });
    }
}
