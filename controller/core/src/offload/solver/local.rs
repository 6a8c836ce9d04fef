//! Correct mappings without proof: parts placed by what they are worth after prices, then moved while that helps.

use super::super::problem::{HOME, Mapping, Problem};
use super::state::State;
use super::{Budget, Options};

/// What counts as better, relatively: less is rounding.
pub(super) const BETTER: f64 = 1e-9;

/// Places each part where `worth` is most among what fits, those first that would lose most by their second choice. None:
/// some part fits nowhere beside those before it.
pub(super) fn construct<'a>(
    empty: &State<'a>,
    options: &Options,
    worth: &[f64],
) -> Option<State<'a>> {
    let mut state = empty.clone();
    let scales = empty.problem().scales.len();
    let worth = |item: usize, k: usize| worth[item * scales + k];
    let regret = |item: usize| {
        let mut best = [f64::NEG_INFINITY; 2];
        for &k in &options[item] {
            let w = worth(item, k);
            if w > best[0] {
                best = [w, best[0]];
            } else if w > best[1] {
                best[1] = w;
            }
        }
        best[0] - best[1]
    };
    let mut order: Vec<(f64, usize)> =
        (0..options.len()).map(|item| (regret(item), item)).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    for (_, item) in order {
        let mut choices = options[item].clone();
        choices.sort_by(|a, b| worth(item, *b).total_cmp(&worth(item, *a)));
        choices.into_iter().find(|k| state.try_put(item, *k))?;
    }
    Some(state)
}

/// Moves parts one by one, in pairs, or one in another's place, while that is worth more.
pub(super) fn improve(state: &mut State<'_>, options: &Options, budget: &mut Budget) {
    loop {
        let before = state.value;
        for item in 0..options.len() {
            shift(state, item, options, budget);
            exchange(state, item, options, budget);
        }
        if budget.is_spent() || state.value <= before + BETTER * before.abs() {
            return;
        }
    }
}

/// Moves one part to where it is worth most.
fn shift(state: &mut State<'_>, item: usize, options: &Options, budget: &mut Budget) {
    let from = state.mapping[item];
    let (mut best, mut at) = (state.value, from);
    state.take(item);
    for &k in options[item].iter().filter(|k| **k != from) {
        budget.spend(1);
        if state.try_put(item, k) {
            if state.value > best + BETTER * best.abs() {
                (best, at) = (state.value, k);
            }
            state.take(item);
        }
    }
    state.put(item, at);
}

/// Puts one part in another's place, and the other wherever it then is worth most.
fn exchange(state: &mut State<'_>, item: usize, options: &Options, budget: &mut Budget) {
    for (other, choices) in options.iter().enumerate() {
        let (from, to) = (state.mapping[item], state.mapping[other]);
        budget.spend(1);
        if budget.is_spent() {
            return;
        }
        // What was struck out may be part of something as good; what is not allowed may not.
        let allowed = state.problem().items[item].allowed[to];
        if other == item || from == to || to == HOME || !allowed {
            continue;
        }
        let before = state.value;
        state.take(item);
        state.take(other);
        if state.try_put(item, to) {
            let mut best: Option<(f64, usize)> = None;
            for &k in choices.iter().filter(|k| **k != to) {
                budget.spend(1);
                if state.try_put(other, k) {
                    if best.is_none_or(|(value, _)| state.value > value) {
                        best = Some((state.value, k));
                    }
                    state.take(other);
                }
            }
            if let Some((_, k)) = best.filter(|(v, _)| *v > before + BETTER * before.abs()) {
                state.put(other, k);
                continue;
            }
            state.take(item);
        }
        state.put(item, from);
        state.put(other, to);
    }
}

/// The mapping of a state, when it keeps every constraint that [`super::super::constraint::check`] knows.
pub(super) fn checked(problem: &Problem, state: &State<'_>) -> Option<Mapping> {
    super::super::constraint::check(problem, &state.mapping)
        .is_empty()
        .then(|| state.mapping.clone())
}
