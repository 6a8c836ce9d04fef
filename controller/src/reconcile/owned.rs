//! What an object controls: tasks and the like that are made with its name on them, in the transaction that writes its own
//! status; and when it is looked at again.

use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{ObjectMeta, OwnerReference};
use muster_controller_core::owner;
use serde::Deserialize;

use crate::context::Context;
use crate::objects;
use crate::quota::Pass;
use crate::rest::create::{pass, prepare_object};
use crate::rest::failure::Failure;
use crate::store::{Key, Op, Precondition, Stored};

/// When an object that controls others is looked at again.
#[derive(Debug)]
pub(super) enum Next {
    /// When something changes.
    Nothing,
    /// Then, too.
    At(Timestamp),
    /// At once: what it relied on changed.
    Again,
}

/// Until one is due; at once while one is to be looked at again.
pub(super) async fn sleep_until(context: &Context, is_dirty: bool, when: Option<Timestamp>) {
    if is_dirty {
        // What made the last look fail arrives as an event; it should come first.
        return tokio::task::yield_now().await;
    }
    match when {
        Some(when) => {
            let left = when.duration_since(context.clock.now());
            tokio::time::sleep(Duration::try_from(left).unwrap_or_default()).await;
        }
        None => std::future::pending().await,
    }
}

/// The part of an object that says whose it is.
#[derive(Debug, Deserialize)]
pub(super) struct Whose {
    pub(super) metadata: ObjectMeta,
}

impl Whose {
    /// Who is said to control it.
    pub(super) fn controller(&self) -> Option<&OwnerReference> {
        owner::controller(&self.metadata)
    }
}

/// A stored object of the group muster.dev as an owner of others.
pub(crate) fn as_owner<'a>(key: &'a Key, uid: &'a str, kind: &'a str) -> owner::Owner<'a> {
    let (namespace, name) = (key.namespace(), &*key.name);
    owner::Owner { api_version: muster_api::API_VERSION, kind, namespace, name, uid }
}

/// An object that controls others.
#[derive(Debug, Clone, Copy)]
pub(super) struct Owner<'a> {
    pub(super) context: &'a Context,
    pub(super) stored: &'a Stored,
    /// Of the group muster.dev.
    pub(super) kind: &'static str,
}

impl Owner<'_> {
    pub(super) fn namespace(&self) -> &str {
        self.stored.key.namespace().unwrap_or_default()
    }

    fn reference(&self) -> OwnerReference {
        OwnerReference {
            api_version: muster_api::API_VERSION.to_owned(),
            kind: self.kind.to_owned(),
            name: self.stored.key.name.to_string(),
            uid: self.stored.uid.to_string(),
            controller: Some(true),
            block_owner_deletion: Some(true),
        }
    }

    /// Whether it controls an object now. Names pass from one object to another: what a plan says of a name is done to
    /// what the plan was made of.
    pub(super) fn controls(&self, metadata: &ObjectMeta) -> bool {
        as_owner(&self.stored.key, &self.stored.uid, self.kind).controls(metadata)
    }

    /// Nobody controls the object, and it is in the owner's namespace.
    pub(super) fn may_adopt(&self, metadata: &ObjectMeta) -> bool {
        owner::controller(metadata).is_none()
            && metadata.namespace.as_deref() == self.stored.key.namespace()
    }

    pub(super) fn own(&self, metadata: &mut ObjectMeta) {
        metadata.owner_references.get_or_insert_default().push(self.reference());
    }

    pub(super) fn disown(&self, metadata: &mut ObjectMeta) {
        let owners = metadata.owner_references.get_or_insert_default();
        owners.retain(|o| *o.uid != *self.stored.uid);
    }

    /// A new object, and whether its namespace's quota lets it in.
    ///
    /// # Errors
    ///
    /// What a client would be told that created it.
    pub(super) fn create<T: serde::Serialize>(
        &self,
        key: Key,
        object: &T,
    ) -> Result<(Op, Result<Option<Pass>, Failure>), Failure> {
        let object = prepare_object(self.context, key.resource, objects::to_value(object))?;
        let pass = pass(self.context, key.resource, &object);
        Ok((Op::Put { key, value: object, precondition: Precondition::Absent }, pass))
    }
}
