//! Makes a failing run short: leaves steps out as long as the same invariant breaks.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use crate::run::{self, Outcome, Plan};

/// How long it may take. What is left out first is half of all, so most is gone in the first seconds.
const AT_MOST: Duration = Duration::from_secs(180);

/// A shorter run that breaks the same invariant.
pub(crate) fn shrink(plan: &Plan, outcome: &Outcome) -> Plan {
    let Some((invariant, _, last)) = &outcome.broken else { return plan.clone() };
    let breaks = |steps: &[u64]| {
        let only: BTreeSet<u64> = steps.iter().copied().collect();
        let (outcome, _) = run::apart(&Plan { only: Some(only), ..plan.clone() }, false);
        outcome.broken.is_some_and(|(broken, ..)| broken == *invariant)
    };
    let all = plan.only.clone().unwrap_or_else(|| (0..plan.steps).collect());
    let mut kept: Vec<u64> = all.into_iter().filter(|step| step <= last).collect();
    let begun = Instant::now();
    let mut chunk = kept.len().div_ceil(2);
    while chunk > 0 && begun.elapsed() < AT_MOST {
        let (mut at, mut shorter) = (0, false);
        while at < kept.len() && begun.elapsed() < AT_MOST {
            let end = (at + chunk).min(kept.len());
            let without: Vec<u64> = kept[..at].iter().chain(&kept[end..]).copied().collect();
            if breaks(&without) {
                (kept, shorter) = (without, true);
            } else {
                at = end;
            }
        }
        if !shorter || chunk > kept.len() {
            chunk /= 2;
        }
    }
    Plan { only: Some(kept.into_iter().collect()), ..plan.clone() }
}
