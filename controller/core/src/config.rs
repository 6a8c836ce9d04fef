//! From what a task names to what it gets: variables and files with their values, by Kubernetes' precedence.
//!
//! `env` goes before `envFrom`, and a later entry of `envFrom` before an earlier one. What is missing and not optional
//! is a [`Hold`]; all of them are found at once.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use muster_api::kind::task::TaskSpec;
use muster_api::kind::task::config::{EnvFrom, Files, KeyRef, Source, Wanted};

use crate::hold::Hold;

/// Most bytes of names and values that one task gets: less than what a session's message takes.
pub const MAX_BYTES: usize = 3 << 20;

/// The values of one object by key.
pub type Values = Arc<BTreeMap<String, Vec<u8>>>;

/// A variable. Its value is not shown.
#[derive(Clone, PartialEq, Eq)]
pub struct Variable {
    /// Name.
    pub name: String,
    /// Value.
    pub value: String,
}

impl fmt::Debug for Variable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Variable").field("name", &self.name).finish_non_exhaustive()
    }
}

/// A file. Its bytes are not shown.
#[derive(Clone, PartialEq, Eq)]
pub struct File {
    /// `mountPath`.
    pub directory: String,
    /// Relative to it.
    pub path: String,
    /// What is in it.
    pub data: Vec<u8>,
    /// Permissions.
    pub mode: u32,
    /// It is a Secret's.
    pub secret: bool,
}

impl fmt::Debug for File {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("File")
            .field("directory", &self.directory)
            .field("path", &self.path)
            .field("bytes", &self.data.len())
            .finish_non_exhaustive()
    }
}

/// What a task gets.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Resolved {
    /// Each name once; none that a plain variable of the spec replaces.
    pub variables: Vec<Variable>,
    /// In the order of the spec.
    pub files: Vec<File>,
}

/// Looks everything up. `find` gives the values of an object of the task's namespace.
///
/// # Errors
///
/// Everything that is missing, each once.
pub fn resolve(
    spec: &TaskSpec,
    find: impl Fn(Source, &str) -> Option<Values>,
) -> Result<Resolved, Vec<Hold>> {
    let Wanted { env, env_from, files } = spec.run.wanted();
    let mut look = Look { find, holds: Vec::new() };
    let mut variables: BTreeMap<String, String> = BTreeMap::new();
    for from in env_from {
        look.whole(from, &mut variables);
    }
    for variable in env {
        let from = variable.value_from.as_ref();
        let map = from.and_then(|f| f.config_map_key_ref.as_ref()).map(|r| (Source::ConfigMap, r));
        let secret = from.and_then(|f| f.secret_key_ref.as_ref()).map(|r| (Source::Secret, r));
        match map.or(secret) {
            // Written in the spec itself: the agent knows it.
            None => drop(variables.remove(&variable.name)),
            Some((source, key)) => {
                if let Some(value) = look.one(source, key) {
                    variables.insert(variable.name.clone(), value);
                }
            }
        }
    }
    let mut resolved = Resolved::default();
    for from in files {
        look.files(from, &mut resolved.files);
    }
    resolved.variables =
        variables.into_iter().map(|(name, value)| Variable { name, value }).collect();
    let mut holds = look.holds;
    let bytes = size(&resolved);
    if bytes > MAX_BYTES {
        holds.push(Hold::TooLarge { bytes, most: MAX_BYTES });
    }
    if holds.is_empty() { Ok(resolved) } else { Err(holds) }
}

fn size(resolved: &Resolved) -> usize {
    let variables = resolved.variables.iter().map(|v| v.name.len() + v.value.len());
    let files = resolved.files.iter().map(|f| f.directory.len() + f.path.len() + f.data.len());
    variables.chain(files).sum()
}

struct Look<F> {
    find: F,
    holds: Vec<Hold>,
}

impl<F: Fn(Source, &str) -> Option<Values>> Look<F> {
    fn hold(&mut self, hold: Hold) {
        if !self.holds.contains(&hold) {
            self.holds.push(hold);
        }
    }

    fn object(&mut self, source: Source, name: &str, optional: bool) -> Option<Values> {
        let found = (self.find)(source, name);
        if found.is_none() && !optional {
            self.hold(Hold::ObjectNotFound { source, name: name.to_owned() });
        }
        found
    }

    fn text(&mut self, source: Source, name: &str, key: &str, value: &[u8]) -> Option<String> {
        let text = std::str::from_utf8(value).ok().filter(|text| !text.contains('\0'));
        if text.is_none() {
            let (name, key) = (name.to_owned(), key.to_owned());
            self.hold(Hold::NotText { source, name, key });
        }
        text.map(str::to_owned)
    }

    fn one(&mut self, source: Source, want: &KeyRef) -> Option<String> {
        let values = self.object(source, &want.name, want.optional)?;
        match values.get(&want.key) {
            Some(value) => self.text(source, &want.name, &want.key, value),
            None => {
                if !want.optional {
                    let (name, key) = (want.name.clone(), want.key.clone());
                    self.hold(Hold::KeyNotFound { source, name, key });
                }
                None
            }
        }
    }

    fn whole(&mut self, from: &EnvFrom, variables: &mut BTreeMap<String, String>) {
        let map = from.config_map_ref.as_ref().map(|r| (Source::ConfigMap, r));
        let secret = from.secret_ref.as_ref().map(|r| (Source::Secret, r));
        let Some((source, want)) = map.or(secret) else { return };
        let Some(values) = self.object(source, &want.name, want.optional) else { return };
        for (key, value) in &*values {
            if let Some(text) = self.text(source, &want.name, key, value) {
                variables.insert(format!("{}{key}", from.prefix), text);
            }
        }
    }

    fn files(&mut self, from: &Files, files: &mut Vec<File>) {
        let map = from.config_map.as_deref().map(|name| (Source::ConfigMap, name));
        let secret = from.secret.as_deref().map(|name| (Source::Secret, name));
        let Some((source, name)) = map.or(secret) else { return };
        let Some(values) = self.object(source, name, from.optional) else { return };
        let file = |path: &str, data: &[u8]| File {
            directory: from.mount_path.clone(),
            path: path.to_owned(),
            data: data.to_vec(),
            mode: from.mode().unwrap_or(0o400),
            secret: source == Source::Secret,
        };
        if from.items.is_empty() {
            files.extend(values.iter().map(|(key, data)| file(key, data)));
        }
        for item in &from.items {
            match values.get(&item.key) {
                Some(data) => files.push(file(&item.path, data)),
                None if from.optional => {}
                None => {
                    let (name, key) = (name.to_owned(), item.key.clone());
                    self.hold(Hold::KeyNotFound { source, name, key });
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::{Value, json};

    use super::*;

    fn spec(program: Value) -> TaskSpec {
        let mut run = json!({"command": ["x"]});
        run.as_object_mut().unwrap().extend(program.as_object().unwrap().clone());
        serde_json::from_value(json!({"run": {"process": run}})).expect("a spec")
    }

    fn values(of: &[(&str, &[u8])]) -> Values {
        Arc::new(of.iter().map(|(k, v)| ((*k).to_owned(), v.to_vec())).collect())
    }

    fn find(source: Source, name: &str) -> Option<Values> {
        match (source, name) {
            (Source::ConfigMap, "one") => Some(values(&[("A", b"1"), ("B", b"1"), ("C", b"1")])),
            (Source::ConfigMap, "two") => Some(values(&[("B", b"2"), ("C", b"2")])),
            (Source::Secret, "key") => Some(values(&[("token", b"t"), ("raw", &[0xff])])),
            _ => None,
        }
    }

    fn env(resolved: &Resolved) -> Vec<(&str, &str)> {
        resolved.variables.iter().map(|v| (&*v.name, &*v.value)).collect()
    }

    #[test]
    fn env_goes_before_env_from_and_later_before_earlier() {
        let spec = spec(json!({
            "env": [
                {"name": "C", "value": "plain"},
                {"name": "T", "valueFrom": {"secretKeyRef": {"name": "key", "key": "token"}}},
                {"name": "P_A", "valueFrom": {"configMapKeyRef": {"name": "two", "key": "B"}}},
            ],
            "envFrom": [
                {"configMapRef": {"name": "one"}}, {"configMapRef": {"name": "two"}},
                {"prefix": "P_", "configMapRef": {"name": "one"}},
            ],
        }));
        let resolved = resolve(&spec, find).expect("all is there");
        let expected =
            [("A", "1"), ("B", "2"), ("P_A", "2"), ("P_B", "1"), ("P_C", "1"), ("T", "t")];
        assert_eq!(env(&resolved), expected);
        assert!(!format!("{resolved:?}").contains("\"t\""));
    }

    #[test]
    fn everything_that_is_missing_is_found_once() {
        let spec = spec(json!({
            "env": [
                {"name": "A", "valueFrom": {"configMapKeyRef": {"name": "none", "key": "a"}}},
                {"name": "B", "valueFrom": {"secretKeyRef": {"name": "key", "key": "b"}}},
                {"name": "C", "valueFrom": {"secretKeyRef": {"name": "key", "key": "raw"}}},
            ],
            "envFrom": [{"configMapRef": {"name": "none"}}, {"secretRef": {"name": "gone"}}],
            "files": [{"secret": "key", "mountPath": "f", "items": [{"key": "x", "path": "y"}]}],
        }));
        let holds = resolve(&spec, find).expect_err("much is missing");
        let mut reasons: Vec<&str> = holds.iter().map(Hold::reason).collect();
        reasons.sort_unstable();
        let expected = [
            "ConfigMapNotFound",
            "SecretKeyNotFound",
            "SecretKeyNotFound",
            "SecretNotFound",
            "SecretValueNotText",
        ];
        assert_eq!(reasons, expected);
        assert!(holds.iter().all(|hold| hold.refusal().node.is_empty()));
    }

    #[test]
    fn what_is_optional_is_left_out() {
        let spec = spec(json!({
            "env": [
                {"name": "A", "valueFrom": {"configMapKeyRef": {"name": "none", "key": "a", "optional": true}}},
                {"name": "B", "valueFrom": {"secretKeyRef": {"name": "key", "key": "b", "optional": true}}},
            ],
            "envFrom": [{"secretRef": {"name": "gone", "optional": true}}],
            "files": [
                {"configMap": "none", "mountPath": "f", "optional": true},
                {"secret": "key", "mountPath": "g", "optional": true, "items": [{"key": "x", "path": "y"}]},
            ],
        }));
        assert_eq!(resolve(&spec, find), Ok(Resolved::default()));
    }

    #[test]
    fn files_have_names_and_permissions() {
        let spec = spec(json!({"files": [
            {"configMap": "two", "mountPath": "c"},
            {"secret": "key", "mountPath": "s", "items": [{"key": "raw", "path": "d/raw"}]},
            {"secret": "key", "mountPath": "t", "mode": "0440", "items": [{"key": "token", "path": "t"}]},
        ]}));
        let resolved = resolve(&spec, find).expect("all is there");
        let shown: Vec<(String, u32, bool, usize)> = resolved
            .files
            .iter()
            .map(|f| (format!("{}/{}", f.directory, f.path), f.mode, f.secret, f.data.len()))
            .collect();
        let file = |path: &str, mode, secret| (path.to_owned(), mode, secret, 1);
        let expected = [
            file("c/B", 0o444, false),
            file("c/C", 0o444, false),
            file("s/d/raw", 0o400, true),
            file("t/t", 0o440, true),
        ];
        assert_eq!(shown, expected);
    }

    proptest! {
        /// Whatever is there of what is wanted: a value, or the one hold that says why not, never both.
        #[test]
        fn a_task_gets_all_or_is_held(there in proptest::collection::vec(any::<bool>(), 4), optional in any::<bool>()) {
            let names = ["a", "b", "c", "d"];
            let env: Vec<Value> = names.iter().map(|name| json!({
                "name": name, "valueFrom": {"configMapKeyRef": {"name": name, "key": "k", "optional": optional}},
            })).collect();
            let has = |name: &str| names.iter().zip(&there).any(|(n, there)| *n == name && *there);
            let find = |_: Source, name: &str| has(name).then(|| values(&[("k", b"v")]));
            let missing = there.iter().filter(|there| !**there).count();
            match resolve(&spec(json!({"env": env})), find) {
                Ok(resolved) => {
                    prop_assert!(optional || missing == 0);
                    prop_assert_eq!(resolved.variables.len(), 4 - missing);
                }
                Err(holds) => prop_assert!(!optional && holds.len() == missing),
            }
        }
    }
}
