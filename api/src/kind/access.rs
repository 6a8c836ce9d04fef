//! Access: who may do what, where.
//!
//! An object gives one role to some subjects, in some namespaces or in the whole cluster. What a role may is the
//! controller's table (`muster_controller_core::access`); rights add up, and nothing takes them away but the end of the
//! object. Who holds a certificate of the administrators (`O=muster:admins`) needs none.

use std::fmt;

use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{KindInfo, admit_spec, any_change};
use crate::name::check_name;
use crate::validate::{Violations, element_path};

/// Names that begin so are muster's own: certificates of agents and administrators have them.
pub const OWN_PREFIX: &str = "muster:";

/// Names that begin so are Kubernetes' own.
pub const SYSTEM_PREFIX: &str = "system:";

/// The group of everybody who said who they are.
pub const AUTHENTICATED: &str = "system:authenticated";

/// Bytes of a user's or a group's name at most: as long as a common name may be by X.520, and then some.
const LONGEST: usize = 128;

/// Who gets which role, where.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Access",
    plural = "accesses",
    derive = "PartialEq"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct AccessSpec {
    /// What the subjects may.
    pub role: Role,
    /// Where; absent: in the whole cluster, with what belongs to no namespace (nodes, leases, sites).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub namespaces: Option<Vec<String>>,
    /// Their tasks may reach past themselves into the nodes that they run on: processes, directories of a node, a node's
    /// network. Who may do that is root there, if they want to be. Operators and administrators of the whole cluster may
    /// without it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub host_access: bool,
    /// Who.
    pub subjects: Vec<Subject>,
}

/// What somebody may, from the least to the most. A framework's is beside them.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Runs a framework: takes offers, and sees its tasks.
    Framework,
    /// Reads, all but Secrets.
    Viewer,
    /// Runs tasks, and what they need.
    Developer,
    /// Runs robots as well: nodes, leases, sites, emergency stops.
    Operator,
    /// Everything.
    Admin,
}

impl Role {
    /// Every role.
    pub const ALL: [Role; 5] =
        [Role::Framework, Role::Viewer, Role::Developer, Role::Operator, Role::Admin];
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Role::Framework => "framework",
            Role::Viewer => "viewer",
            Role::Developer => "developer",
            Role::Operator => "operator",
            Role::Admin => "admin",
        })
    }
}

/// Somebody, as Kubernetes' RBAC writes it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Subject {
    /// A person or a program, or a group of them.
    #[serde(default)]
    pub kind: SubjectKind,
    /// Of a user: the common name (CN) of the certificate, or the user of the token. Of a group: an organisation (O) of the
    /// certificate, or a group of the token.
    pub name: String,
}

/// What a subject's name is the name of.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum SubjectKind {
    /// One user.
    #[default]
    User,
    /// Everybody in a group.
    Group,
}

/// Whether something can be a user's or a group's name; why not, when it cannot.
///
/// # Errors
///
/// The reason, without the name's place.
pub fn check_subject_name(name: &str) -> Result<(), String> {
    if name.trim() != name || name.is_empty() {
        return Err("a name is not empty, and has no spaces around it".to_owned());
    }
    if name.len() > LONGEST {
        return Err(format!("is longer than {LONGEST} bytes"));
    }
    if name.chars().any(char::is_control) {
        return Err("has control characters".to_owned());
    }
    let own = [OWN_PREFIX, SYSTEM_PREFIX].into_iter().find(|prefix| name.starts_with(prefix));
    match own {
        Some(prefix) => Err(format!("{name:?} begins with {prefix:?}, which is reserved")),
        None => Ok(()),
    }
}

fn rules(spec: &AccessSpec, violations: &mut Violations) {
    if spec.subjects.is_empty() {
        violations
            .invalid("spec.subjects", "names nobody")
            .suggest("for example [{kind: User, name: ada}]");
    }
    for (i, subject) in spec.subjects.iter().enumerate() {
        let everybody = subject.kind == SubjectKind::Group && subject.name == AUTHENTICATED;
        if let Some(why) = check_subject_name(&subject.name).err().filter(|_| !everybody) {
            let path = format!("{}.name", element_path("spec.subjects", i));
            let violation = violations.invalid(path, why);
            if subject.name.starts_with(OWN_PREFIX) {
                violation.suggest("agents and administrators have their rights by certificate");
            } else if subject.name.starts_with(SYSTEM_PREFIX) {
                violation.suggest(format!(
                    "of Kubernetes' groups there is {AUTHENTICATED:?}: everybody who said who they are"
                ));
            }
        }
    }
    if spec.host_access && spec.role == Role::Viewer {
        violations
            .invalid("spec.hostAccess", "is of no use to a viewer, who runs nothing")
            .suggest("leave it out, or give another role");
    }
    let Some(namespaces) = &spec.namespaces else { return };
    if namespaces.is_empty() {
        violations
            .invalid("spec.namespaces", "names no namespace")
            .suggest("leave it out for the whole cluster");
    }
    for (i, namespace) in namespaces.iter().enumerate() {
        if let Err(error) = check_name(namespace) {
            let near = error.suggestion().map(|name| format!("try {name:?}"));
            let path = element_path("spec.namespaces", i);
            let violation = violations.invalid(path, error.to_string());
            violation.suggestion = match namespace.as_str() {
                "*" => Some("leave `namespaces` out for the whole cluster".to_owned()),
                _ => near,
            };
        }
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Access",
    plural: "accesses",
    singular: "access",
    short_names: &[],
    namespaced: false,
    has_status: false,
    selectable: &["spec.role"],
    schema: |g| g.subschema_for::<Access>(),
    admit_body: |object: &mut Value, violations| {
        admit_spec::<AccessSpec>(object, violations, rules);
    },
    admit_change: any_change,
};

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn problems(spec: Value) -> Vec<String> {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Access", "metadata": {"name": "lab"}, "spec": spec
        });
        match super::super::admit(&object) {
            Ok(_) => Vec::new(),
            Err(violations) => violations.iter().map(ToString::to_string).collect(),
        }
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_its_place() {
        let ada = json!([{"kind": "User", "name": "ada"}, {"name": "bob"}]);
        assert_eq!(problems(json!({"role": "viewer", "subjects": ada})), [""; 0]);
        let everybody = json!([{"kind": "Group", "name": "system:authenticated"}]);
        assert_eq!(
            problems(json!({"role": "viewer", "namespaces": ["lab"], "subjects": everybody})),
            [""; 0]
        );
        assert_eq!(
            problems(json!({"role": "viewer", "subjects": [], "namespaces": []})),
            [
                "spec.subjects: names nobody; for example [{kind: User, name: ada}]",
                "spec.namespaces: names no namespace; leave it out for the whole cluster",
            ]
        );
        assert_eq!(
            problems(json!({"role": "operator", "namespaces": ["*", "My_Lab"], "subjects": [
                {"kind": "Group", "name": "muster:admins"}, {"kind": "Group", "name": "system:masters"}, {"name": " ada"}
            ]})),
            [
                "spec.subjects[0].name: \"muster:admins\" begins with \"muster:\", which is reserved; agents and administrators have their rights by certificate",
                "spec.subjects[1].name: \"system:masters\" begins with \"system:\", which is reserved; of Kubernetes' groups there is \"system:authenticated\": everybody who said who they are",
                "spec.subjects[2].name: a name is not empty, and has no spaces around it",
                "spec.namespaces[0]: \"*\" is not a name: lower-case letters, digits and '-' only, beginning and ending with a letter or digit; leave `namespaces` out for the whole cluster",
                "spec.namespaces[1]: \"My_Lab\" is not a name: lower-case letters, digits and '-' only, beginning and ending with a letter or digit; try \"my-lab\"",
            ]
        );
    }

    #[test]
    fn access_to_hosts_is_for_who_runs_something() {
        let spec = |role| json!({"role": role, "hostAccess": true, "subjects": [{"name": "ada"}]});
        assert_eq!(problems(spec("developer")), [""; 0]);
        assert_eq!(problems(spec("framework")), [""; 0]);
        assert_eq!(
            problems(spec("viewer")),
            [
                "spec.hostAccess: is of no use to a viewer, who runs nothing; leave it out, or give another role"
            ]
        );
    }

    #[test]
    fn a_role_that_there_is_not_is_told_the_nearest() {
        let told = problems(json!({"role": "develper", "subjects": [{"name": "ada"}]}));
        assert_eq!(told.len(), 1, "{told:?}");
        assert!(told[0].starts_with("spec.role: ") && told[0].contains("developer"), "{told:?}");
    }

    #[test]
    fn roles_are_written_as_they_are_said() {
        for role in Role::ALL {
            assert_eq!(serde_json::to_value(role).expect("a text"), role.to_string());
        }
    }
}
