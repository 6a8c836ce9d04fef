//! What a change looks like to those who watch it: rendered once for all of them, where that is more than to copy what is
//! stored.

use std::collections::{HashMap, VecDeque};
use std::sync::{Mutex, PoisonError};

use bytes::Bytes;

use super::form::Form;
use super::registry::View;

/// Bytes that are kept: some thousand objects. Watchers read changes within moments of each other, and who comes later
/// renders for itself.
const KEPT: usize = 8 << 20;

/// One change in one form. A revision is one change of one object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Sight {
    pub(super) revision: u64,
    /// As the object was before the change, for those who do not see what it became.
    pub(super) before: bool,
    pub(super) view: View,
    pub(super) form: Form,
}

/// The last changes that were rendered.
#[derive(Debug, Default)]
pub struct Rendered(Mutex<Recent>);

#[derive(Debug, Default)]
struct Recent {
    known: HashMap<Sight, Bytes>,
    /// The oldest first.
    order: VecDeque<Sight>,
    bytes: usize,
}

impl Rendered {
    /// The change as `make` renders it, or as somebody else had it rendered.
    pub(super) fn of(&self, sight: Sight, make: impl FnOnce() -> Bytes) -> Bytes {
        let known = |recent: &Recent| recent.known.get(&sight).cloned();
        if let Some(known) = known(&self.0.lock().unwrap_or_else(PoisonError::into_inner)) {
            return known;
        }
        // Others are not held up meanwhile; one that renders the same has done it for nothing.
        let bytes = make();
        self.0.lock().unwrap_or_else(PoisonError::into_inner).keep(sight, &bytes);
        bytes
    }
}

impl Recent {
    fn keep(&mut self, sight: Sight, bytes: &Bytes) {
        if self.known.insert(sight, bytes.clone()).is_some() {
            return;
        }
        self.order.push_back(sight);
        self.bytes += bytes.len();
        while self.bytes > KEPT
            && let Some(oldest) = self.order.pop_front()
        {
            self.bytes -= self.known.remove(&oldest).map_or(0, |bytes| bytes.len());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_is_rendered_once_while_it_is_new() {
        let rendered = Rendered::default();
        let sight =
            |revision| Sight { revision, before: false, view: View::Pod, form: Form::Whole };
        let mut made = 0;
        let mut look = |revision| {
            rendered.of(sight(revision), || {
                made += 1;
                Bytes::from(vec![b'x'; KEPT / 4])
            })
        };
        for revision in [1, 1, 2, 1, 3, 4, 1] {
            assert_eq!(look(revision).len(), KEPT / 4);
        }
        assert_eq!(made, 4);
        let mut again = 0;
        for revision in [5, 1] {
            rendered.of(sight(revision), || {
                again += 1;
                Bytes::from_static(b"1")
            });
        }
        assert_eq!(again, 2, "the oldest made room for the newest");
        let recent = rendered.0.lock().unwrap();
        assert!(recent.bytes <= KEPT && recent.order.len() == recent.known.len());
    }
}
