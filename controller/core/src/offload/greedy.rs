//! AnyScale's Algorithm 1: the part that uses most cpu goes to the strongest scale that takes it, one part a look.
//!
//! It is kept as the policy `Greedy` and as the baseline of the solver. It knows no worth: parts are in the order of their
//! use of cpu at home, scales in that of their α, and what is away stays away until a violation brings it home.

use super::constraint::check;
use super::problem::{HOME, Mapping, Problem};

/// The one move that a look of Algorithm 1 makes: a part and the scale that takes it. `may_move` says which parts were not
/// brought home within the last T.
#[must_use]
pub fn step(
    problem: &Problem,
    mapping: &[usize],
    may_move: impl Fn(usize) -> bool,
) -> Option<(usize, usize)> {
    let scales = scales(problem);
    for item in parts(problem) {
        if mapping[item] != HOME || !may_move(item) {
            continue;
        }
        for &scale in &scales {
            let mut next = mapping.to_vec();
            next[item] = scale;
            if check(problem, &next).is_empty() {
                return Some((item, scale));
            }
        }
    }
    None
}

/// Where Algorithm 1 ends when nothing changes meanwhile.
#[must_use]
pub fn settle(problem: &Problem) -> Mapping {
    let mut mapping = problem.all_home();
    while let Some((item, scale)) = step(problem, &mapping, |_| true) {
        mapping[item] = scale;
    }
    mapping
}

/// Brings parts home while a link is over-used, those first that moved last ("select right (node, scale) from migrated
/// list"). `moved`: the parts that are away, the last one last.
#[must_use]
pub fn bring_home(problem: &Problem, mapping: &[usize], moved: &[usize]) -> Mapping {
    let mut mapping = mapping.to_vec();
    for item in moved.iter().rev() {
        if check(problem, &mapping).is_empty() {
            break;
        }
        mapping[*item] = HOME;
    }
    mapping
}

fn parts(problem: &Problem) -> Vec<usize> {
    let mut parts: Vec<usize> = (0..problem.items.len()).collect();
    let cpu = |item: usize| problem.items[item].cpu[HOME];
    parts.sort_by(|a, b| cpu(*b).total_cmp(&cpu(*a)).then(a.cmp(b)));
    parts
}

fn scales(problem: &Problem) -> Vec<usize> {
    let mut scales: Vec<usize> = (1..problem.scales.len()).collect();
    let gain = |scale: usize| problem.scales[scale].gain;
    scales.sort_by(|a, b| gain(*b).total_cmp(&gain(*a)).then(a.cmp(b)));
    scales
}
