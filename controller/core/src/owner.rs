//! Whether a reference in `metadata.ownerReferences` counts.
//!
//! A reference is written by whoever writes the object that it stands in, and uids can be read by many: it must not reach
//! beyond the object's own namespace. As in Kubernetes, an owner is in the same namespace or in none, and kind, name and uid
//! are all its own.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{ObjectMeta, OwnerReference};

/// An object that may own others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Owner<'a> {
    /// As `muster.dev/v1alpha1`.
    pub api_version: &'a str,
    /// As `TaskSet`.
    pub kind: &'a str,
    /// None: it is in no namespace.
    pub namespace: Option<&'a str>,
    /// Its name.
    pub name: &'a str,
    /// Its uid.
    pub uid: &'a str,
}

impl Owner<'_> {
    /// Whether a reference in an object of that namespace is to this owner.
    #[must_use]
    pub fn is_named_by(&self, reference: &OwnerReference, namespace: Option<&str>) -> bool {
        reference.uid == self.uid
            && reference.name == self.name
            && reference.kind == self.kind
            && reference.api_version == self.api_version
            && (self.namespace.is_none() || self.namespace == namespace)
    }

    /// Whether it controls the object.
    #[must_use]
    pub fn controls(&self, object: &ObjectMeta) -> bool {
        controller(object)
            .is_some_and(|reference| self.is_named_by(reference, object.namespace.as_deref()))
    }
}

/// Who is said to control an object.
#[must_use]
pub fn controller(object: &ObjectMeta) -> Option<&OwnerReference> {
    object.owner_references.iter().flatten().find(|owner| owner.controller == Some(true))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_owner_is_of_the_same_namespace_and_all_of_its_identity_is_named() {
        let set = Owner {
            api_version: "muster.dev/v1alpha1",
            kind: "TaskSet",
            namespace: Some("lab"),
            name: "watch",
            uid: "u",
        };
        let reference = OwnerReference {
            api_version: set.api_version.to_owned(),
            kind: "TaskSet".to_owned(),
            name: "watch".to_owned(),
            uid: "u".to_owned(),
            controller: Some(true),
            block_owner_deletion: None,
        };
        assert!(set.is_named_by(&reference, Some("lab")));
        assert!(!set.is_named_by(&reference, Some("other")));
        assert!(!set.is_named_by(&reference, None), "what is in no namespace has no owner in one");
        for wrong in [
            OwnerReference { kind: "Task".to_owned(), ..reference.clone() },
            OwnerReference { api_version: "v1".to_owned(), ..reference.clone() },
            OwnerReference { name: "other".to_owned(), ..reference.clone() },
            OwnerReference { uid: "other".to_owned(), ..reference.clone() },
        ] {
            assert!(!set.is_named_by(&wrong, Some("lab")), "{wrong:?}");
        }
        let node = Owner { namespace: None, ..set };
        assert!(node.is_named_by(&reference, Some("other")));
        let object = |namespace: &str, controller| ObjectMeta {
            namespace: Some(namespace.to_owned()),
            owner_references: Some(vec![OwnerReference { controller, ..reference.clone() }]),
            ..ObjectMeta::default()
        };
        assert!(set.controls(&object("lab", Some(true))));
        assert!(!set.controls(&object("lab", None)));
        assert!(!set.controls(&object("other", Some(true))));
    }
}
