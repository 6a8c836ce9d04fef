//! What readers see: every live object, and a ring of recent events.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Bound;
use std::sync::Arc;

use super::backend::{Compaction, Row};
use super::{Change, Event, Key, Resource, Stored};

/// How much history is kept for watches that fall behind and for continued lists.
#[derive(Debug, Clone, Copy)]
pub(super) struct RingLimits {
    pub(super) events: usize,
    pub(super) bytes: usize,
}

impl RingLimits {
    /// Ten thousand events are two rounds of status of five thousand nodes: a client that lists and then watches
    /// has seconds, not milliseconds, to arrive. The bytes keep large objects from holding the memory budget.
    pub(super) const DEFAULT: Self = Self { events: 10_000, bytes: 16 << 20 };
}

/// The history that was asked for is gone; list again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("revision {asked} is too old: history begins after {compacted}")]
pub struct Expired {
    /// What was asked for.
    pub asked: u64,
    /// Everything at or below this revision is forgotten.
    pub compacted: u64,
}

/// Objects of one resource as they were at one revision, in key order.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// A watch from this revision misses nothing and repeats nothing.
    pub revision: u64,
    /// The objects.
    pub items: Vec<Arc<Stored>>,
}

#[derive(Debug)]
pub(super) struct State {
    live: BTreeMap<Key, Arc<Stored>>,
    ring: VecDeque<Event>,
    ring_bytes: usize,
    limits: RingLimits,
    revision: u64,
    /// What left the ring and is not yet forgotten by the backend.
    evicted: Compaction,
}

impl State {
    pub(super) fn new(limits: RingLimits) -> Self {
        Self {
            live: BTreeMap::new(),
            ring: VecDeque::new(),
            ring_bytes: 0,
            limits,
            revision: 0,
            evicted: Compaction::default(),
        }
    }

    pub(super) fn revision(&self) -> u64 {
        self.revision
    }

    pub(super) fn all(&self) -> impl Iterator<Item = &Arc<Stored>> {
        self.live.values()
    }

    pub(super) fn get(&self, key: &Key) -> Option<&Arc<Stored>> {
        self.live.get(key)
    }

    /// Takes a committed change. Changes arrive in revision order.
    pub(super) fn apply(&mut self, event: Event) {
        self.follow(&event);
        self.ring_bytes += event.object.bytes.len();
        self.ring.push_back(event);
        while self.ring.len() > self.limits.events
            || (self.ring_bytes > self.limits.bytes && self.ring.len() > 1)
        {
            self.evict();
        }
    }

    fn follow(&mut self, event: &Event) {
        self.revision = event.revision();
        match event.change {
            Change::Put => {
                self.live.insert(event.object.key.clone(), Arc::clone(&event.object));
            }
            Change::Delete => {
                self.live.remove(&event.object.key);
            }
        }
    }

    fn evict(&mut self) {
        let Some(event) = self.ring.pop_front() else { return };
        self.ring_bytes -= event.object.bytes.len();
        self.evicted.through = event.revision();
        if let Some(previous) = &event.previous {
            self.evicted.garbage.push(previous.revision);
        }
        if event.change == Change::Delete {
            self.evicted.garbage.push(event.revision());
        }
    }

    /// Takes a row at start. `compacted` is not known until all rows are in, so rows only build the ring, and
    /// [`State::restored`] cuts it.
    pub(super) fn restore(&mut self, row: Row) {
        let namespace = (!row.namespace.is_empty()).then(|| row.namespace.into());
        let key =
            Key { resource: Resource::intern(&row.resource), namespace, name: row.name.into() };
        let previous = self.live.get(&key).map(Arc::clone);
        // One allocation for key parts of an object and its successors.
        let key = previous.as_ref().map_or(key, |previous| previous.key.clone());
        let change = if row.deleted { Change::Delete } else { Change::Put };
        let bytes = row.value.into_bytes().into();
        let object = Arc::new(Stored::new(key, row.revision, row.uid.into(), bytes));
        self.apply(Event { change, object, previous });
    }

    /// Ends the restoration: rows at or below `compacted` were state, not history.
    pub(super) fn restored(&mut self, compacted: u64) {
        while self.ring.front().is_some_and(|event| event.revision() <= compacted) {
            self.evict();
        }
        self.evicted.through = self.evicted.through.max(compacted);
        self.revision = self.revision.max(compacted);
    }

    /// Everything at or below this revision is forgotten.
    pub(super) fn compacted(&self) -> u64 {
        self.evicted.through
    }

    /// How many rows the backend could forget now.
    pub(super) fn garbage(&self) -> usize {
        self.evicted.garbage.len()
    }

    /// Hands over what the backend should forget; give it back with [`State::keep_garbage`] if it did not.
    pub(super) fn take_garbage(&mut self) -> Compaction {
        Compaction {
            through: self.evicted.through,
            garbage: std::mem::take(&mut self.evicted.garbage),
        }
    }

    pub(super) fn keep_garbage(&mut self, compaction: Compaction) {
        self.evicted.garbage.extend(compaction.garbage);
    }

    /// Forgets history through `revision`, whatever the limits.
    pub(super) fn compact(&mut self, revision: u64) {
        while self.ring.front().is_some_and(|event| event.revision() <= revision) {
            self.evict();
        }
    }

    /// The present objects of `resource`, of one namespace or of all, after the key `after`.
    pub(super) fn snapshot(
        &self,
        resource: Resource,
        namespace: Option<&str>,
        after: Option<&Key>,
    ) -> Snapshot {
        let start = match after {
            Some(key) => Bound::Excluded(key.clone()),
            None => Bound::Included(Key {
                resource,
                namespace: namespace.map(Into::into),
                name: "".into(),
            }),
        };
        let items = self
            .live
            .range((start, Bound::Unbounded))
            .take_while(|(key, _)| {
                key.resource == resource
                    && namespace.is_none_or(|wanted| key.namespace() == Some(wanted))
            })
            .map(|(_, stored)| Arc::clone(stored))
            .collect();
        Snapshot { revision: self.revision, items }
    }

    /// The same as it was at `revision`: the events since then are taken back, newest first.
    pub(super) fn snapshot_at(
        &self,
        resource: Resource,
        namespace: Option<&str>,
        after: Option<&Key>,
        revision: u64,
    ) -> Result<Snapshot, Expired> {
        let newer = self.since(revision)?;
        let mut items: BTreeMap<Key, Arc<Stored>> = self
            .snapshot(resource, namespace, after)
            .items
            .into_iter()
            .map(|stored| (stored.key.clone(), stored))
            .collect();
        for event in newer.rev() {
            let key = &event.object.key;
            let wanted = key.resource == resource
                && namespace.is_none_or(|wanted| key.namespace() == Some(wanted))
                && after.is_none_or(|after| key > after);
            if !wanted {
                continue;
            }
            match &event.previous {
                Some(previous) => items.insert(key.clone(), Arc::clone(previous)),
                None => items.remove(key),
            };
        }
        Ok(Snapshot { revision, items: items.into_values().collect() })
    }

    /// Events after `revision`, oldest first. Revisions in the ring are consecutive.
    pub(super) fn since(
        &self,
        revision: u64,
    ) -> Result<impl DoubleEndedIterator<Item = &Event>, Expired> {
        let compacted = self.compacted();
        if revision < compacted {
            return Err(Expired { asked: revision, compacted });
        }
        let skip = usize::try_from(revision - compacted).unwrap_or(usize::MAX);
        Ok(self.ring.range(skip.min(self.ring.len())..))
    }
}
