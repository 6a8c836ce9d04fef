//! Images that the node is to have before a task needs them: which is pulled now, which later, and what is said of each.
//!
//! ```text
//! want (whole) ──▶ Waiting ──next──▶ Pulling ──done──▶ Pulled
//!                                      ▲         └──▶ BackOff ── 10 s, 20 s … 5 min ──┐
//!                                      └────────────────────────────────────────────┘
//! ```
//!
//! One at a time, the oldest wish first, as Kubernetes does: a robot's radio is shared with what drives it. One that failed
//! makes room for the others. Nothing outlives the agent: another life of it is told the wishes again, and looks.

use muster_api::kind::node::image::{ImagePhase, ImageStatus, ImageWish};

use crate::event::Failure;
use crate::time::Boot;

/// First delay after a pull that failed, Kubernetes' own.
pub const BASE_MS: u64 = 10_000;
/// Longest delay, Kubernetes' own.
pub const CAP_MS: u64 = 5 * 60 * 1_000;

/// `10 s · 2^(failures − 1)`, at most [`CAP_MS`].
#[must_use]
pub fn delay_ms(failures: u32) -> u64 {
    match failures {
        0 => 0,
        // 10 s · 2^5 is above the cap already.
        1..=5 => (BASE_MS << (failures - 1)).min(CAP_MS),
        _ => CAP_MS,
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Entry {
    status: ImageStatus,
    /// Not before; while it waits or backs off.
    due: Boot,
}

/// The wishes for a node, and how it stands with them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Pulls(Vec<Entry>);

impl Pulls {
    /// What is wanted now, whole. What is known of wishes that stay is kept.
    pub fn want(&mut self, wishes: impl IntoIterator<Item = ImageWish>) {
        let mut before = std::mem::take(&mut self.0);
        let waiting = |wish| Entry {
            status: ImageStatus {
                wish,
                phase: ImagePhase::Waiting,
                reason: String::new(),
                message: String::new(),
                failures: 0,
            },
            due: Boot::default(),
        };
        for wish in wishes {
            let known = before.iter().position(|entry| entry.status.wish == wish);
            let known = known.map(|at| before.swap_remove(at));
            if known.is_some() || !self.is_wanted(&wish) {
                self.0.push(known.unwrap_or_else(|| waiting(wish)));
            }
        }
        self.0.sort_by(|a, b| a.status.wish.since.cmp(&b.status.wish.since));
    }

    /// Whether somebody still wants it.
    #[must_use]
    pub fn is_wanted(&self, wish: &ImageWish) -> bool {
        self.0.iter().any(|entry| entry.status.wish == *wish)
    }

    /// The pull to begin now; none while another one is under way. It must be answered by [`Pulls::done`], unless it is not
    /// wanted any more.
    #[must_use = "a pull that is not made keeps all others waiting"]
    pub fn next(&mut self, now: Boot) -> Option<ImageWish> {
        if self.is_busy() {
            return None;
        }
        let open =
            |entry: &&mut Entry| entry.status.phase != ImagePhase::Pulled && entry.due <= now;
        let entry = self.0.iter_mut().find(open)?;
        entry.status.phase = ImagePhase::Pulling;
        Some(entry.status.wish.clone())
    }

    fn is_busy(&self) -> bool {
        self.0.iter().any(|entry| entry.status.phase == ImagePhase::Pulling)
    }

    /// When to ask for the next pull; none: not before one is done, or another wanted.
    #[must_use]
    pub fn wake(&self) -> Option<Boot> {
        let open = self.0.iter().filter(|entry| entry.status.phase != ImagePhase::Pulled);
        open.map(|entry| entry.due).min().filter(|_| !self.is_busy())
    }

    /// What came of a pull. Of one that is not wanted any more it means nothing.
    pub fn done(&mut self, wish: &ImageWish, result: Result<(), Failure>, now: Boot) {
        let Some(entry) = self.0.iter_mut().find(|entry| entry.status.wish == *wish) else {
            return;
        };
        let status = &mut entry.status;
        match result {
            Ok(()) => {
                status.phase = ImagePhase::Pulled;
                status.reason.clear();
                status.message.clear();
            }
            Err(Failure { reason, message, .. }) => {
                status.phase = ImagePhase::BackOff;
                (status.reason, status.message) = (reason, message);
                status.failures = status.failures.saturating_add(1);
                entry.due = now.plus(delay_ms(status.failures));
            }
        }
    }

    /// How it stands with each, the oldest wish first.
    #[must_use]
    pub fn statuses(&self) -> Vec<ImageStatus> {
        self.0.iter().map(|entry| entry.status.clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use muster_api::kind::task::PullPolicy;
    use proptest::prelude::*;
    use serde_json::{from_value, json};

    use super::*;

    fn wish(image: &str, since: i64) -> ImageWish {
        let since = Timestamp::from_second(since).unwrap();
        from_value(json!({"image": image, "since": since.to_string()})).unwrap()
    }

    fn failure() -> Failure {
        let reason = "ImagePullFailed".to_owned();
        Failure { reason, message: "no route".to_owned(), retry: true }
    }

    fn phases(pulls: &Pulls) -> Vec<(String, ImagePhase)> {
        pulls.statuses().into_iter().map(|s| (s.wish.image, s.phase)).collect()
    }

    #[test]
    fn delays_are_kubernetes_own() {
        let delays: Vec<u64> = (0..8).map(delay_ms).collect();
        assert_eq!(delays[..6], [0, 10_000, 20_000, 40_000, 80_000, 160_000]);
        assert_eq!(delays[6..], [CAP_MS, CAP_MS]);
    }

    #[test]
    fn one_at_a_time_and_one_that_fails_makes_room() {
        let mut pulls = Pulls::default();
        pulls.want([wish("b", 2), wish("a", 1)]);
        assert_eq!(pulls.next(Boot(0)), Some(wish("a", 1)), "the older wish");
        assert_eq!((pulls.next(Boot(0)), pulls.wake()), (None, None));
        pulls.done(&wish("a", 1), Err(failure()), Boot(5));
        assert_eq!(pulls.next(Boot(5)), Some(wish("b", 2)));
        pulls.done(&wish("b", 2), Ok(()), Boot(6));
        assert_eq!(pulls.wake(), Some(Boot(10_005)));
        assert_eq!(pulls.next(Boot(10_004)), None);
        assert_eq!(pulls.next(Boot(10_005)), Some(wish("a", 1)));
        let [a, b] = &pulls.statuses()[..] else { panic!("two") };
        assert_eq!((a.phase, a.failures, a.message.as_str()), (ImagePhase::Pulling, 1, "no route"));
        assert_eq!((b.phase, b.failures), (ImagePhase::Pulled, 0));
        pulls.done(&wish("a", 1), Ok(()), Boot(10_006));
        assert_eq!(pulls.wake(), None);
        assert_eq!(pulls.statuses()[0].message, "");
    }

    #[test]
    fn what_is_said_of_a_wish_that_stays_is_kept_and_a_later_one_is_another() {
        let mut pulls = Pulls::default();
        pulls.want([wish("a", 1)]);
        let a = pulls.next(Boot(0)).unwrap();
        pulls.done(&a, Ok(()), Boot(0));
        pulls.want([wish("a", 1), wish("a", 9), wish("a", 9)]);
        let known = |phase| ("a".to_owned(), phase);
        assert_eq!(phases(&pulls), [known(ImagePhase::Pulled), known(ImagePhase::Waiting)]);
        let again = pulls.next(Boot(0)).unwrap();
        pulls.want([]);
        assert!(!pulls.is_wanted(&again));
        pulls.done(&again, Err(failure()), Boot(0));
        assert_eq!(pulls, Pulls::default());
    }

    proptest! {
        /// Whatever is wanted and however pulls end: at most one is under way, and when pulls succeed from then on, all are had.
        #[test]
        fn everything_wanted_is_had_in_the_end(rounds in prop::collection::vec(
            (prop::collection::vec((0..3_u8, 0..3_i64), 0..4), any::<bool>()), 0..20,
        )) {
            let (mut pulls, mut now) = (Pulls::default(), Boot(0));
            for (wanted, succeeds) in rounds {
                let wanted = wanted.into_iter().map(|(image, since)| ImageWish {
                    pull_policy: PullPolicy::IfNotPresent,
                    ..wish(&image.to_string(), since)
                });
                pulls.want(wanted);
                let busy = pulls.is_busy();
                let begun = pulls.next(now);
                prop_assert!(!(busy && begun.is_some()));
                if let Some(wish) = begun {
                    pulls.done(&wish, if succeeds { Ok(()) } else { Err(failure()) }, now);
                }
                now = now.plus(3_000);
            }
            for _ in 0..16 {
                now = pulls.wake().map_or(now, |wake| wake.max(now));
                if let Some(wish) = pulls.next(now) {
                    pulls.done(&wish, Ok(()), now);
                }
            }
            prop_assert!(pulls.statuses().iter().all(|s| s.phase == ImagePhase::Pulled));
        }
    }
}
