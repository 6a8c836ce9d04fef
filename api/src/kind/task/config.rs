//! What a task gets of ConfigMaps and Secrets: variables of its environment, and files.
//!
//! The task names them; the controller looks them up and sends the values to the task's node. An attempt keeps the
//! values that it was started with; a change reaches the next one.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{EnvVar, Run, TaskSpec};
use crate::kind::keyed::check_key;
use crate::name::check_name;
use crate::validate::{Violations, element_path};

/// Where the value of a variable comes from: exactly one of the two.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct EnvSource {
    /// A key of a ConfigMap.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub config_map_key_ref: Option<KeyRef>,
    /// A key of a Secret.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub secret_key_ref: Option<KeyRef>,
}

/// A key of an object of the task's namespace.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct KeyRef {
    /// The object.
    pub name: String,
    /// The key in it. Its value must be text.
    pub key: String,
    /// Without it the variable is not set; else the task waits until it is there.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optional: bool,
}

/// All keys of an object as variables: exactly one of the two. A later entry goes before an earlier one, and `env`
/// before all of them.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct EnvFrom {
    /// Put in front of each key.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub prefix: String,
    /// A ConfigMap.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub config_map_ref: Option<ObjectRef>,
    /// A Secret.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub secret_ref: Option<ObjectRef>,
}

/// An object of the task's namespace.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ObjectRef {
    /// The object.
    pub name: String,
    /// Without it nothing is set; else the task waits until it is there.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optional: bool,
}

/// Keys of an object as files that the task reads: of exactly one of the two.
///
/// Each attempt has its own files, in memory (tmpfs) when any of them is a Secret's. A container sees them read-only at
/// `mountPath`, which is absolute. A process finds them below the directory that `MUSTER_FILES_DIR` names, and there
/// under `mountPath`, which is relative; a process without a `workingDir` of its own also finds the first part of
/// `mountPath` in its working directory, as a link to them.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub struct Files {
    /// Name of a ConfigMap.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub config_map: Option<String>,
    /// Name of a Secret.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub secret: Option<String>,
    /// Which keys, and as which files; empty: every key, as a file of its name.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub items: Vec<KeyToPath>,
    /// The directory of the files.
    pub mount_path: String,
    /// Permissions, octal and in quotes: `"0440"`. None: 0400 for a Secret's, 0444 for others. A process's files are
    /// its user's; a container's are those of the image's user when the image names one by number, else root's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mode: Option<String>,
    /// What is not there is left out; else the task waits until it is there.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub optional: bool,
}

/// One key as a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct KeyToPath {
    /// The key.
    pub key: String,
    /// The file, relative to `mountPath`.
    pub path: String,
}

impl Files {
    /// The permissions that are meant; none: they are not octal.
    #[must_use]
    pub fn mode(&self) -> Option<u32> {
        match &self.mode {
            Some(text) => u32::from_str_radix(text, 8).ok().filter(|mode| *mode <= 0o777),
            None if self.secret.is_some() => Some(0o400),
            None => Some(0o444),
        }
    }
}

/// What of a task's program names ConfigMaps and Secrets.
#[derive(Debug, Clone, Copy, Default)]
pub struct Wanted<'a> {
    /// Variables.
    pub env: &'a [EnvVar],
    /// Whole objects as variables.
    pub env_from: &'a [EnvFrom],
    /// Files.
    pub files: &'a [Files],
}

impl Run {
    /// What the program wants of ConfigMaps and Secrets.
    #[must_use]
    pub fn wanted(&self) -> Wanted<'_> {
        match (&self.container, &self.process) {
            (Some(run), _) => Wanted { env: &run.env, env_from: &run.env_from, files: &run.files },
            (None, Some(run)) => {
                Wanted { env: &run.env, env_from: &run.env_from, files: &run.files }
            }
            (None, None) => Wanted::default(),
        }
    }
}

/// Which of the two kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Source {
    /// ConfigMap.
    ConfigMap,
    /// Secret.
    Secret,
}

impl TaskSpec {
    /// Every object that the program names, optional ones too; some may come twice.
    #[must_use]
    pub fn references(&self) -> Vec<(Source, &str)> {
        let Wanted { env, env_from, files } = self.run.wanted();
        let mut all = Vec::new();
        for from in env.iter().filter_map(|variable| variable.value_from.as_ref()) {
            all.extend(from.config_map_key_ref.as_ref().map(|r| (Source::ConfigMap, &*r.name)));
            all.extend(from.secret_key_ref.as_ref().map(|r| (Source::Secret, &*r.name)));
        }
        for from in env_from {
            all.extend(from.config_map_ref.as_ref().map(|r| (Source::ConfigMap, &*r.name)));
            all.extend(from.secret_ref.as_ref().map(|r| (Source::Secret, &*r.name)));
        }
        for from in files {
            all.extend(from.config_map.as_deref().map(|name| (Source::ConfigMap, name)));
            all.extend(from.secret.as_deref().map(|name| (Source::Secret, name)));
        }
        all
    }
}

/// Rules of what one program wants; `path` is the program's, `spec.run.process`.
pub(super) fn rules(run: &Run, path: &str, violations: &mut Violations) {
    let Wanted { env, env_from, files } = run.wanted();
    for (i, variable) in env.iter().enumerate() {
        let path = element_path(&format!("{path}.env"), i);
        let Some(from) = &variable.value_from else { continue };
        if !variable.value.is_empty() {
            violations
                .forbidden(format!("{path}.valueFrom"), "means nothing beside a value")
                .suggest("keep one of them");
        }
        let path = format!("{path}.valueFrom");
        let (map, secret) = (from.config_map_key_ref.as_ref(), from.secret_key_ref.as_ref());
        one_of(
            &path,
            [("configMapKeyRef", map.is_some()), ("secretKeyRef", secret.is_some())],
            violations,
        );
        for (field, key) in [("configMapKeyRef", map), ("secretKeyRef", secret)] {
            let Some(key) = key else { continue };
            name_rule(&format!("{path}.{field}.name"), &key.name, violations);
            key_rule(&format!("{path}.{field}.key"), &key.key, violations);
        }
    }
    for (i, from) in env_from.iter().enumerate() {
        let path = element_path(&format!("{path}.envFrom"), i);
        let (map, secret) = (from.config_map_ref.as_ref(), from.secret_ref.as_ref());
        one_of(
            &path,
            [("configMapRef", map.is_some()), ("secretRef", secret.is_some())],
            violations,
        );
        for (field, object) in [("configMapRef", map), ("secretRef", secret)] {
            let Some(object) = object else { continue };
            name_rule(&format!("{path}.{field}.name"), &object.name, violations);
        }
        if from.prefix.contains(['=', '\0']) {
            violations.invalid(format!("{path}.prefix"), "cannot begin the name of a variable");
        }
    }
    for (i, from) in files.iter().enumerate() {
        let path = element_path(&format!("{path}.files"), i);
        file_rules(from, &path, run.container.is_some(), violations);
        let same = |other: &Files| other.mount_path == from.mount_path;
        if files[..i].iter().any(same) {
            violations.duplicate(
                format!("{path}.mountPath"),
                format!("{:?} is there twice", from.mount_path),
            );
        }
    }
}

fn file_rules(from: &Files, path: &str, container: bool, violations: &mut Violations) {
    let given = [("configMap", from.config_map.is_some()), ("secret", from.secret.is_some())];
    one_of(path, given, violations);
    for (field, name) in [("configMap", &from.config_map), ("secret", &from.secret)] {
        if let Some(name) = name {
            name_rule(&format!("{path}.{field}"), name, violations);
        }
    }
    let place = format!("{path}.mountPath");
    if from.mount_path.is_empty() {
        violations.required(place);
    } else if container && !from.mount_path.starts_with('/') {
        violations
            .invalid(place, format!("{:?} is not an absolute path", from.mount_path))
            .suggest("begin it with '/'");
    } else if !container && from.mount_path.starts_with('/') {
        violations
            .invalid(place, format!("{:?} is an absolute path", from.mount_path))
            .suggest("a process finds its files under $MUSTER_FILES_DIR: leave the first '/' out");
    } else if !stays_below(from.mount_path.trim_start_matches('/')) {
        violations.invalid(
            place,
            format!("{:?} has a part that is empty, \".\" or \"..\"", from.mount_path),
        );
    }
    if from.mode().is_none() {
        violations
            .invalid(format!("{path}.mode"), "is not a file's permissions")
            .suggest("give them octal and in quotes: \"0440\"");
    }
    for (i, item) in from.items.iter().enumerate() {
        let path = element_path(&format!("{path}.items"), i);
        key_rule(&format!("{path}.key"), &item.key, violations);
        if !stays_below(&item.path) {
            violations
                .invalid(format!("{path}.path"), format!("{:?} leads out of mountPath", item.path))
                .suggest("give a relative path without \"..\"");
        }
        if from.items[..i].iter().any(|other| other.path == item.path) {
            violations.duplicate(format!("{path}.path"), format!("{:?} is there twice", item.path));
        }
    }
}

/// A relative path that leads nowhere else. What it goes through cannot lead elsewhere either: the directories are
/// made for it.
fn stays_below(path: &str) -> bool {
    path.len() <= 1024
        && path.split('/').all(|part| {
            !matches!(part, "" | "." | "..") && part.len() <= 255 && !part.contains('\0')
        })
}

fn one_of(path: &str, given: [(&str, bool); 2], violations: &mut Violations) {
    let [(first, has_first), (second, has_second)] = given;
    match (has_first, has_second) {
        (true, true) => {
            violations
                .forbidden(path, format!("has both `{first}` and `{second}`"))
                .suggest("keep one of them");
        }
        (false, false) => {
            violations.required(format!("{path}.{first}")).suggest(format!("or give `{second}`"));
        }
        _ => {}
    }
}

fn name_rule(path: &str, name: &str, violations: &mut Violations) {
    if let Err(error) = check_name(name) {
        violations.invalid(path, error.to_string());
    }
}

fn key_rule(path: &str, key: &str, violations: &mut Violations) {
    if let Err(reason) = check_key(key) {
        violations.invalid(path, reason);
    }
}
