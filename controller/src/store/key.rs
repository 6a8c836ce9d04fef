//! Names of stored objects.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

/// The plural name of a kind, as in a URL: `tasks`. Cheap to copy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Resource(&'static str);

impl Resource {
    /// A resource that the program knows by name.
    #[must_use]
    pub const fn new(plural: &'static str) -> Self {
        Self(plural)
    }

    /// A resource read back from storage. Each distinct name is kept for the life of the process; there are as
    /// many as there are kinds.
    pub(super) fn intern(plural: &str) -> Self {
        static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
        let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = names.get(plural) {
            return Self(known);
        }
        let name: &'static str = Box::leak(plural.to_owned().into_boxed_str());
        names.insert(name);
        Self(name)
    }

    /// The plural name.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        self.0
    }
}

impl fmt::Display for Resource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0)
    }
}

/// Where an object lives. Ordered by resource, namespace, name, which is the order of lists.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key {
    /// The kind's plural name.
    pub resource: Resource,
    /// `None` for cluster-scoped kinds.
    pub namespace: Option<Arc<str>>,
    /// Unique within resource and namespace.
    pub name: Arc<str>,
}

impl Key {
    /// The key of a cluster-scoped object.
    pub fn cluster(resource: Resource, name: impl Into<Arc<str>>) -> Self {
        Self { resource, namespace: None, name: name.into() }
    }

    /// The key of an object in a namespace.
    pub fn namespaced(
        resource: Resource,
        namespace: impl Into<Arc<str>>,
        name: impl Into<Arc<str>>,
    ) -> Self {
        Self { resource, namespace: Some(namespace.into()), name: name.into() }
    }

    /// The namespace, if the kind has one.
    #[must_use]
    pub fn namespace(&self) -> Option<&str> {
        self.namespace.as_deref()
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.namespace {
            Some(namespace) => write!(f, "{}/{namespace}/{}", self.resource, self.name),
            None => write!(f, "{}/{}", self.resource, self.name),
        }
    }
}
