//! What an agent runs and should not: strays.
//!
//! A task is a stray from the moment when its agent says that it lives and the store does not give it
//! to that node (it was fenced, lost, deleted), until the agent says that it has ended. While there is
//! one, nothing new may begin there: what the stray uses is not in the books any more, its actuators
//! among it (invariants 1 and 2).

use std::collections::BTreeSet;

use muster_api::id::TaskUid;

/// The live tasks of one agent's session, and which of them are strays.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Strays {
    live: BTreeSet<TaskUid>,
    strays: BTreeSet<TaskUid>,
}

impl Strays {
    /// Takes in that the agent says that a task lives or has ended. `assigned`: the store gives the
    /// task to this node, and knows no end of it. True: the strays are others than before.
    #[must_use = "a change of the strays must be written to the node"]
    pub fn told(&mut self, uid: &TaskUid, lives: bool, assigned: bool) -> bool {
        if !lives {
            self.live.remove(uid);
            return self.strays.remove(uid);
        }
        self.live.insert(uid.clone());
        !assigned && self.strays.insert(uid.clone())
    }

    /// Takes in that the store does not give a task to this node any more, or has recorded its end.
    /// True: it lives there, and is a stray from now on.
    #[must_use = "a change of the strays must be written to the node"]
    pub fn withdrawn(&mut self, uid: &TaskUid) -> bool {
        self.live.contains(uid) && self.strays.insert(uid.clone())
    }

    /// Takes in all that the store gives to this node: what lives beside that is a stray. True: the strays are others than
    /// before.
    #[must_use = "a change of the strays must be written to the node"]
    pub fn given(&mut self, is_given: impl Fn(&TaskUid) -> bool) -> bool {
        let before = self.strays.len();
        self.strays.extend(self.live.iter().filter(|uid| !is_given(uid)).cloned());
        self.strays.len() > before
    }

    /// The agent says that the task lives.
    #[must_use]
    pub fn lives(&self, uid: &TaskUid) -> bool {
        self.live.contains(uid)
    }

    /// Nothing runs that should not.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.strays.is_empty()
    }

    /// Those that should not run.
    pub fn iter(&self) -> impl Iterator<Item = &TaskUid> {
        self.strays.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stray_stays_one_until_its_end_is_told() {
        let uid = |text: &str| TaskUid::new(text);
        let (good, bad) = (uid("good"), uid("bad"));
        let mut strays = Strays::default();
        assert!(!strays.told(&good, true, true));
        assert!(strays.told(&bad, true, false));
        assert!(!strays.told(&bad, true, false), "known already");
        assert!(!strays.told(&bad, true, true), "an assignment does not make it good again");
        assert_eq!(strays.iter().collect::<Vec<_>>(), [&bad]);
        assert!(strays.withdrawn(&good) && !strays.withdrawn(&good));
        assert!(!strays.withdrawn(&uid("unheard")), "nothing of it lives here");
        assert!(strays.told(&bad, false, false) && !strays.is_empty());
        let more = uid("more");
        assert!(!strays.told(&more, true, true) && !strays.given(|uid| *uid == more));
        assert!(strays.given(|_| false) && strays.iter().any(|uid| *uid == more));
        assert!(!strays.given(|_| false) && strays.told(&more, false, false));
        assert!(strays.told(&good, false, false) && strays.is_empty());
        assert!(!strays.lives(&good) && !strays.told(&good, false, false));
    }
}
