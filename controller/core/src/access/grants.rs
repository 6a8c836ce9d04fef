//! What Access objects give, by who they are for.

use std::collections::HashMap;
use std::fmt;

use muster_api::kind::access::{AUTHENTICATED, AccessSpec, Role, SubjectKind};

/// A role, and where.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Grant {
    /// What.
    pub role: Role,
    /// None: in the whole cluster.
    pub namespace: Option<String>,
    /// Whether tasks may reach into their nodes ([`super::host`]).
    pub host_access: bool,
}

impl fmt::Display for Grant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.namespace {
            Some(namespace) => write!(f, "{} in the namespace {namespace:?}", self.role)?,
            None => write!(f, "{} of the whole cluster", self.role)?,
        }
        f.write_str(if self.host_access { " with access to hosts" } else { "" })
    }
}

/// All grants.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Grants {
    users: HashMap<String, Vec<Grant>>,
    groups: HashMap<String, Vec<Grant>>,
}

impl Grants {
    /// Those of these objects.
    #[must_use]
    pub fn of<'a>(objects: impl IntoIterator<Item = &'a AccessSpec>) -> Self {
        let mut all = Self::default();
        for spec in objects {
            let (role, host_access) = (spec.role, spec.host_access);
            let of = |namespace: Option<String>| Grant { role, namespace, host_access };
            let given: Vec<Grant> = match &spec.namespaces {
                None => vec![of(None)],
                Some(namespaces) => namespaces.iter().cloned().map(Some).map(of).collect(),
            };
            for subject in &spec.subjects {
                let whose = match subject.kind {
                    SubjectKind::User => &mut all.users,
                    SubjectKind::Group => &mut all.groups,
                };
                whose.entry(subject.name.clone()).or_default().extend(given.iter().cloned());
            }
        }
        all
    }

    /// What a user of these groups holds, each once, the greatest first.
    #[must_use]
    pub fn held_by(&self, user: &str, groups: &[String]) -> Vec<Grant> {
        let groups = groups.iter().map(String::as_str).chain([AUTHENTICATED]);
        let by_group = groups.filter_map(|group| self.groups.get(group));
        let by_name = self.users.get(user);
        let mut held: Vec<Grant> = by_name.into_iter().chain(by_group).flatten().cloned().collect();
        held.sort_by(|a, b| b.role.cmp(&a.role).then_with(|| a.namespace.cmp(&b.namespace)));
        held.dedup();
        held
    }
}
