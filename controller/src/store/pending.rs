//! A batch being gathered: preconditions are checked against what the batch will leave behind.

use std::collections::HashMap;
use std::sync::Arc;

use super::document::Template;
use super::state::State;
use super::{Change, Event, Key, Precondition, Resource, StoreError, Stored};

/// An operation rendered by its caller.
#[derive(Debug)]
pub(super) enum Prepared {
    Put { key: Key, template: Template, precondition: Precondition },
    Delete { key: Key, precondition: Precondition },
    Check { key: Key, precondition: Precondition },
    Still { revision: u64, of: &'static [Resource] },
}

/// What the batch will leave behind, over the committed state.
#[derive(Debug, Default)]
pub(super) struct Pending {
    /// In revision order, from the committed revision + 1.
    pub(super) events: Vec<Event>,
    pub(super) bytes: usize,
    /// Keys that the batch touches; `None` for a removed one.
    overlay: HashMap<Key, Option<Arc<Stored>>>,
}

impl Pending {
    /// Takes a transaction whole, or leaves the batch as it was.
    pub(super) fn admit(
        &mut self,
        committed: &State,
        ops: Vec<Prepared>,
    ) -> Result<Vec<Arc<Stored>>, StoreError> {
        let (first, bytes) = (self.events.len(), self.bytes);
        let mut undo = Vec::with_capacity(ops.len());
        for op in ops {
            match self.next(committed, op) {
                Ok(None) => {}
                Ok(Some(event)) => {
                    let after = (event.change == Change::Put).then(|| Arc::clone(&event.object));
                    let key = event.object.key.clone();
                    undo.push((key.clone(), self.overlay.insert(key, after)));
                    self.bytes += event.object.bytes.len();
                    self.events.push(event);
                }
                Err(error) => {
                    self.events.truncate(first);
                    self.bytes = bytes;
                    for (key, before) in undo.into_iter().rev() {
                        match before {
                            Some(before) => self.overlay.insert(key, before),
                            None => self.overlay.remove(&key),
                        };
                    }
                    return Err(error);
                }
            }
        }
        Ok(self.events[first..].iter().map(|event| Arc::clone(&event.object)).collect())
    }

    fn next(&self, committed: &State, op: Prepared) -> Result<Option<Event>, StoreError> {
        let revision = committed.revision() + self.events.len() as u64 + 1;
        match op {
            Prepared::Put { key, template, precondition } => {
                let present = self.present(committed, &key);
                check(&key, &precondition, present)?;
                // One allocation for the key parts of an object and its successors.
                let key = present.map_or(key, |present| present.key.clone());
                let bytes = template.at(revision);
                let object = Arc::new(Stored::new(key, revision, template.uid, bytes));
                let previous = present.map(Arc::clone);
                Ok(Some(Event { change: Change::Put, object, previous }))
            }
            Prepared::Delete { key, precondition } => {
                let present = self.present(committed, &key);
                check(&key, &precondition, present)?;
                let Some(last) = present.map(Arc::clone) else {
                    return Err(StoreError::NotFound { key });
                };
                let template = Template::again(&last);
                let bytes = template.at(revision);
                let object = Arc::new(Stored::new(last.key.clone(), revision, template.uid, bytes));
                Ok(Some(Event { change: Change::Delete, object, previous: Some(last) }))
            }
            Prepared::Check { key, precondition } => {
                check(&key, &precondition, self.present(committed, &key))?;
                Ok(None)
            }
            Prepared::Still { revision, of } => self.still(committed, revision, of).map(|()| None),
        }
    }

    /// Whether nothing of these resources was, or is about to be, written after a revision.
    fn still(&self, committed: &State, since: u64, of: &[Resource]) -> Result<(), StoreError> {
        let known = committed.since(since).ok().filter(|_| since <= committed.revision());
        let known = known.ok_or(StoreError::Moved { since, key: None })?;
        let mut keys = known.chain(&self.events).map(|event| &event.object.key);
        match keys.find(|key| of.contains(&key.resource)) {
            Some(key) => Err(StoreError::Moved { since, key: Some(key.clone()) }),
            None => Ok(()),
        }
    }

    fn present<'a>(&'a self, committed: &'a State, key: &Key) -> Option<&'a Arc<Stored>> {
        match self.overlay.get(key) {
            Some(pending) => pending.as_ref(),
            None => committed.get(key),
        }
    }
}

fn check(
    key: &Key,
    precondition: &Precondition,
    present: Option<&Arc<Stored>>,
) -> Result<(), StoreError> {
    let (revision, uid) = match precondition {
        Precondition::Any => return Ok(()),
        Precondition::Absent => {
            return match present {
                Some(_) => Err(StoreError::AlreadyExists { key: key.clone() }),
                None => Ok(()),
            };
        }
        Precondition::Match { revision, uid } => (revision, uid),
    };
    let Some(present) = present else {
        return Err(StoreError::NotFound { key: key.clone() });
    };
    if let Some(expected) = uid
        && **expected != *present.uid
    {
        return Err(StoreError::UidMismatch {
            key: key.clone(),
            expected: expected.clone(),
            actual: present.uid.to_string(),
        });
    }
    match *revision {
        Some(expected) if expected != present.revision => {
            Err(StoreError::Conflict { key: key.clone(), expected, actual: present.revision })
        }
        _ => Ok(()),
    }
}
