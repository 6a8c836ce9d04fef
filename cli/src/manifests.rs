//! Files → checked objects. Everything is checked before anything is sent, and every problem is
//! found at once, each with file, line and column.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use muster_api::kind::task::depend::{self, Graph};
use muster_api::kind::{self, KindInfo};
use muster_api::manifest::{self, Diagnostic, Document, Location};
use muster_api::validate::{Violation, Violations, element_path};
use serde_json::Value;

use crate::error::{CliError, Refusal};
use crate::sites;

/// What `-f -` is called in messages.
const STDIN: &str = "<stdin>";

/// One object of a file: a document, or an item of a List.
#[derive(Debug, Clone)]
struct Part {
    document: Rc<Document>,
    /// Path of the object in its document, `items[2]`; empty for the document itself.
    prefix: String,
    object: Value,
}

/// An object that passed every check that can be made without the controller.
#[derive(Debug, Clone)]
pub(crate) struct Manifest {
    part: Part,
    pub(crate) info: &'static KindInfo,
    pub(crate) namespace: Option<String>,
    pub(crate) name: String,
    /// As it was written, with the namespace filled in.
    pub(crate) written: Value,
    /// As the controller would store it, with defaults.
    pub(crate) admitted: Value,
}

impl Part {
    fn locate(&self, path: &str) -> Location {
        let whole = match (self.prefix.is_empty(), path.is_empty()) {
            (true, _) => path.to_owned(),
            (false, true) => self.prefix.clone(),
            (false, false) if path.starts_with('[') => format!("{}{path}", self.prefix),
            (false, false) => format!("{}.{path}", self.prefix),
        };
        self.document.locate(&whole)
    }

    fn at(&self, violation: Violation) -> Diagnostic {
        let location = self.locate(&violation.path);
        Diagnostic { source: self.document.source.clone(), location, violation }
    }

    fn place(&self) -> String {
        let Location { line, column } = self.locate("");
        format!("{}:{line}:{column}", self.document.source)
    }
}

impl Manifest {
    /// `task/x`.
    pub(crate) fn title(&self) -> String {
        format!("{}/{}", self.info.singular, self.name)
    }

    /// Puts what the controller found wrong at its place in the file; other errors are as they were.
    pub(crate) fn blame(&self, error: CliError) -> Vec<Result<Diagnostic, CliError>> {
        let causes = match &error {
            CliError::Refused(refusal) if !refusal.causes.is_empty() => refusal.causes.clone(),
            _ => return vec![Err(error)],
        };
        if !matches!(&error, CliError::Refused(r) if is_about_fields(r)) {
            return vec![Err(error)];
        }
        let diagnostic = |field: &str, message: &str| {
            let mut violations = Violations::new();
            violations.invalid(field, message);
            violations.into_iter().next().map(|v| self.part.at(v))
        };
        causes.iter().filter_map(|c| diagnostic(&c.field, &c.message)).map(Ok).collect()
    }
}

fn is_about_fields(refusal: &Refusal) -> bool {
    matches!(refusal.reason.as_str(), "Invalid" | "BadRequest")
        && refusal.causes.iter().any(|c| !c.field.is_empty())
}

/// Reads and checks everything that `-f` names. `namespace` is that of objects that name none; when
/// it was `given` with `-n`, none may name another.
pub(crate) fn load(
    paths: &[PathBuf],
    namespace: &str,
    given: bool,
) -> Result<Vec<Manifest>, CliError> {
    load_from(paths, &mut std::io::stdin().lock(), namespace, given)
}

fn load_from(
    paths: &[PathBuf],
    stdin: &mut dyn Read,
    namespace: &str,
    given: bool,
) -> Result<Vec<Manifest>, CliError> {
    let mut problems = Vec::new();
    let mut parts = Vec::new();
    for (source, text) in texts(paths, stdin)? {
        match manifest::parse(&source, &text) {
            Ok(documents) => parts.extend(documents.into_iter().flat_map(split)),
            Err(error) => problems.extend(error.0),
        }
    }
    let mut manifests = Vec::new();
    for part in parts {
        match check(part, namespace, given) {
            Ok(manifest) => manifests.push(manifest),
            Err(found) => problems.extend(found),
        }
    }
    problems.extend(duplicates(&manifests));
    problems.extend(rings(&manifests));
    if !problems.is_empty() {
        return Err(CliError::Manifests(problems));
    }
    if manifests.is_empty() {
        let named: Vec<String> = paths.iter().map(|p| p.display().to_string()).collect();
        return Err(CliError::usage(format!("there are no objects in {}", named.join(", "))));
    }
    Ok(manifests)
}

/// The texts that are named, with the names they have in messages.
fn texts(paths: &[PathBuf], stdin: &mut dyn Read) -> Result<Vec<(String, String)>, CliError> {
    let mut texts = Vec::new();
    for path in paths {
        let failed = |source| CliError::Read { path: path.clone(), source };
        if path.as_os_str() == "-" {
            let mut text = String::new();
            stdin.read_to_string(&mut text).map_err(failed)?;
            texts.push((STDIN.to_owned(), text));
            continue;
        }
        let metadata = std::fs::metadata(path).map_err(failed)?;
        let mut files = vec![path.clone()];
        if metadata.is_dir() {
            files.clear();
            walk(path, &mut files)?;
        }
        for file in files {
            let text = std::fs::read_to_string(&file)
                .map_err(|source| CliError::Read { path: file.clone(), source })?;
            texts.push((file.display().to_string(), text));
        }
    }
    Ok(texts)
}

/// The manifests below a directory, in the order of their names, so that a run is like the last one.
fn walk(dir: &Path, files: &mut Vec<PathBuf>) -> Result<(), CliError> {
    let failed = |source| CliError::Read { path: dir.to_owned(), source };
    let mut entries: Vec<PathBuf> = std::fs::read_dir(dir)
        .and_then(|entries| entries.map(|entry| entry.map(|e| e.path())).collect())
        .map_err(failed)?;
    entries.sort();
    for path in entries {
        let is_manifest =
            path.extension().is_some_and(|e| e == "yaml" || e == "yml" || e == "json");
        if path.is_dir() {
            walk(&path, files)?;
        } else if is_manifest {
            files.push(path);
        }
    }
    Ok(())
}

/// The objects of a document: itself, or the items of a List.
fn split(document: Document) -> Vec<Part> {
    let document = Rc::new(document);
    let object = &document.object;
    let is_list = object["apiVersion"] == "v1" && object["kind"] == "List";
    match object["items"].as_array().filter(|_| is_list) {
        Some(items) => items
            .iter()
            .enumerate()
            .map(|(i, item)| Part {
                document: Rc::clone(&document),
                prefix: element_path("items", i),
                object: item.clone(),
            })
            .collect(),
        None => {
            let object = object.clone();
            vec![Part { document, prefix: String::new(), object }]
        }
    }
}

/// What only the controller writes; a manifest made with `get -o yaml` carries it, and it means nothing.
const OWNED: [&str; 5] =
    ["uid", "creationTimestamp", "generation", "managedFields", "deletionTimestamp"];

fn check(mut part: Part, namespace: &str, given: bool) -> Result<Manifest, Vec<Diagnostic>> {
    if let Some(metadata) = part.object.get_mut("metadata").and_then(Value::as_object_mut) {
        metadata.retain(|key, _| !OWNED.contains(&key.as_str()));
    }
    let maps = sites::read_map(&mut part.object, &part.document.source);
    let diagnose = |violations: Violations| -> Vec<Diagnostic> {
        let mut all: Vec<Diagnostic> = violations.into_iter().map(|v| part.at(v)).collect();
        all.sort_by_key(|d| d.location);
        all
    };
    maps.map_err(diagnose)?;
    let mut admitted = kind::admit(&part.object).map_err(diagnose)?;
    let mut violations = Violations::new();
    let text =
        |field: &str| part.object.pointer(field).and_then(Value::as_str).filter(|t| !t.is_empty());
    let info =
        kind::find(text("/apiVersion").unwrap_or_default(), text("/kind").unwrap_or_default())
            .expect("admission knows no other kinds");
    let Some(name) = text("/metadata/name").map(str::to_owned) else {
        violations
            .required("metadata.name")
            .suggest("an object without a fixed name cannot be applied twice");
        return Err(diagnose(violations));
    };
    let own = text("/metadata/namespace");
    if let Some(own) = own.filter(|own| given && *own != namespace) {
        violations
            .invalid(
                "metadata.namespace",
                format!("{own:?} is not the namespace given with -n, {namespace:?}"),
            )
            .suggest("leave out one of the two");
        return Err(diagnose(violations));
    }
    let namespace = info.namespaced.then(|| own.unwrap_or(namespace).to_owned());
    let mut written = part.object.clone();
    if info.kind == "Secret" {
        // Compared and patched as it is stored.
        muster_api::kind::secret::merge_string_data(&mut written);
    }
    for object in [&mut written, &mut admitted] {
        if let Some(namespace) = &namespace {
            object["metadata"]["namespace"] = namespace.as_str().into();
        }
        if info.has_status
            && let Some(members) = object.as_object_mut()
        {
            members.remove("status");
        }
    }
    Ok(Manifest { part, info, namespace, name, written, admitted })
}

fn duplicates(manifests: &[Manifest]) -> Vec<Diagnostic> {
    let mut first = BTreeMap::new();
    let mut problems = Vec::new();
    for manifest in manifests {
        let key = (manifest.info.kind, &manifest.namespace, &manifest.name);
        if let Some(before) = first.get(&key) {
            let mut violations = Violations::new();
            violations.duplicate(
                "metadata.name",
                format!("{} is there twice, first at {before}", manifest.title()),
            );
            problems.extend(violations.into_iter().map(|v| manifest.part.at(v)));
        } else {
            first.insert(key, manifest.part.place());
        }
    }
    problems
}

/// Tasks that wait for each other, said at the first of each ring.
fn rings(manifests: &[Manifest]) -> Vec<Diagnostic> {
    let mut graphs: BTreeMap<&Option<String>, Graph> = BTreeMap::new();
    let tasks = || manifests.iter().filter(|m| m.info.kind == "Task");
    for task in tasks() {
        let named = depend::named(&task.admitted);
        graphs.entry(&task.namespace).or_default().insert(task.name.clone(), named);
    }
    let mut told: BTreeSet<(&Option<String>, String)> = BTreeSet::new();
    let mut problems = Vec::new();
    for task in tasks() {
        if told.contains(&(&task.namespace, task.name.clone())) {
            continue;
        }
        let Some(ring) = depend::cycle(&graphs[&task.namespace], &task.name) else { continue };
        told.extend(ring.iter().map(|name| (&task.namespace, name.clone())));
        let violations = depend::ring_refusal(&task.admitted, &ring, &format!("{} ", task.title()));
        problems.extend(violations.into_iter().map(|v| task.part.at(v)));
    }
    problems
}

#[cfg(test)]
mod tests {
    use super::*;

    const TASK: &str = "apiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata: {name: a}\nspec:\n  run: {process: {command: [x]}}\n";

    fn from_stdin(text: &str, given: bool) -> Result<Vec<Manifest>, CliError> {
        load_from(&[PathBuf::from("-")], &mut text.as_bytes(), "lab", given)
    }

    fn problems(text: &str) -> Vec<String> {
        match from_stdin(text, true) {
            Err(CliError::Manifests(all)) => all.iter().map(ToString::to_string).collect(),
            other => panic!("not refused for its content: {other:?}"),
        }
    }

    #[test]
    fn the_namespace_is_filled_in_and_defaults_only_into_the_admitted_form() {
        let all = from_stdin(TASK, false).expect("good");
        assert_eq!(all[0].namespace.as_deref(), Some("lab"));
        assert_eq!(all[0].written["metadata"]["namespace"], "lab");
        assert_eq!(all[0].admitted["spec"]["gracePeriodSeconds"], 10);
        assert_eq!(all[0].written["spec"].get("gracePeriodSeconds"), None);
        assert_eq!(all[0].title(), "task/a");
    }

    #[test]
    fn tasks_that_wait_for_each_other_are_refused_at_their_place() {
        let task = |name: &str, on: &str| {
            format!(
                "apiVersion: muster.dev/v1alpha1\nkind: Task\nmetadata: {{name: {name}}}\nspec:\n  run: {{process: {{command: [x]}}}}\n  dependsOn:\n  - task: {on}\n---\n"
            )
        };
        let all = [task("a", "b"), task("b", "c"), task("c", "a"), task("d", "a")].concat();
        assert_eq!(
            problems(&all),
            [
                "<stdin>:7:5: spec.dependsOn[0].task: task/a waits for itself: a → b → c → a; leave out one of them"
            ]
        );
    }

    #[test]
    fn every_problem_of_every_document_is_found_at_once() {
        let text = format!(
            "{TASK}---\n{TASK}---\napiVersion: v1\nkind: Namspace\nmetadata: {{name: b}}\n---\n{}",
            TASK.replace("[x]", "[]")
        );
        assert_eq!(
            problems(&text),
            [
                "<stdin>:14:1: kind: \"Namspace\" is not a kind that muster serves; did you mean \"Namespace\"?",
                "<stdin>:21:19: spec.run.process.command: is required; for example [\"/usr/bin/env\"]",
                "<stdin>:9:12: metadata.name: task/a is there twice, first at <stdin>:1:1",
            ]
        );
    }

    #[test]
    fn a_namespace_beside_dash_n_is_refused() {
        let text = TASK.replace("{name: a}", "{name: a, namespace: hall}");
        assert!(
            problems(&text)[0].starts_with("<stdin>:3:21: metadata.namespace: \"hall\" is not"),
            "{:?}",
            problems(&text)
        );
        from_stdin(&text, false).expect("without -n the manifest decides");
    }

    #[test]
    fn what_get_prints_can_be_applied() {
        let text = format!(
            "apiVersion: v1\nkind: List\nitems:\n- {}",
            TASK.replace("metadata: {name: a}", "metadata: {name: a, uid: u, generation: 3, creationTimestamp: \"2026-01-01T00:00:00Z\"}\nstatus: {phase: Running}")
                .replace('\n', "\n  ")
        );
        let all = from_stdin(&text, false).expect("good");
        assert_eq!(
            all[0].written["metadata"],
            serde_json::json!({"name": "a", "namespace": "lab"})
        );
        assert_eq!(all[0].written.get("status"), None);
        let broken = text.replace("[x]", "[]");
        assert_eq!(
            problems(&broken),
            ["<stdin>:9:21: spec.run.process.command: is required; for example [\"/usr/bin/env\"]"]
        );
    }

    #[test]
    fn directories_are_read_in_the_order_of_their_names() {
        let dir = tempfile::tempdir().expect("a directory");
        std::fs::create_dir(dir.path().join("b")).expect("made");
        for (file, name) in [("c.json", "c"), ("a.yaml", "a"), ("b/x.yml", "b"), ("notes.txt", "n")]
        {
            std::fs::write(
                dir.path().join(file),
                TASK.replace("name: a", &format!("name: {name}")),
            )
            .expect("written");
        }
        let all = load(&[dir.path().to_owned()], "lab", false).expect("good");
        let names: Vec<&str> = all.iter().map(|m| m.name.as_str()).collect();
        assert_eq!(names, ["a", "b", "c"]);
        let missing = load(&[dir.path().join("none")], "lab", false).expect_err("not there");
        assert_eq!(missing.class().exit(), crate::exit::NOT_FOUND);
    }
}
