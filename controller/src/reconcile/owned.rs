//! What an object controls: tasks and the like that are made with its name on them, in the transaction that writes its own
//! status; and when it is looked at again.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{ObjectMeta, OwnerReference};
use muster_api::name::NodeName;
use muster_controller_core::owner;
use serde::Deserialize;
use tokio::time::Instant;

use crate::context::Context;
use crate::objects;
use crate::quota::Pass;
use crate::rest::create::{pass, prepare_object};
use crate::rest::failure::Failure;
use crate::store::{Key, Op, Precondition, Stored};

/// Whoever waits for longer is looked at once more in between.
const LONGEST: Duration = Duration::from_secs(24 * 3600);

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

/// Objects that are looked at again later, whatever happens to dates meanwhile.
#[derive(Debug, Default)]
pub(super) struct Later(BTreeMap<Key, Instant>);

impl Later {
    /// This one at `when`, by the date that is `now`.
    pub(super) fn insert(&mut self, key: Key, when: Timestamp, now: Timestamp) {
        let wait = Duration::try_from(when.duration_since(now)).unwrap_or_default();
        self.0.insert(key, Instant::now() + wait.min(LONGEST));
    }

    /// This one is looked at now.
    pub(super) fn remove(&mut self, key: &Key) {
        self.0.remove(key);
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &Key> {
        self.0.keys()
    }

    /// Those whose time has come.
    pub(super) fn due(&self) -> impl Iterator<Item = &Key> {
        let now = Instant::now();
        self.0.iter().filter(move |(_, when)| **when <= now).map(|(key, _)| key)
    }

    /// Until one is due; at once while one is to be looked at again. Cancel safe.
    pub(super) fn next(&self, is_dirty: bool) -> impl Future<Output = ()> + use<> {
        let when = self.0.values().min().copied();
        async move {
            match when {
                // What made the last look fail arrives as an event; it should come first.
                _ if is_dirty => tokio::task::yield_now().await,
                Some(when) => tokio::time::sleep_until(when).await,
                None => std::future::pending().await,
            }
        }
    }
}

/// When a silent node was heard last, counted back from `now` by a clock that dates do not move; none: nobody measures it.
pub(super) fn silence(context: &Context, node: &str, now: Timestamp) -> Option<Timestamp> {
    let node = NodeName::new(node).ok()?;
    let silence = context.live()?.sessions.silence_of(&node);
    Some(now.checked_sub(silence).unwrap_or(now))
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
