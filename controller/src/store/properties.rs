//! Admission and history against a model that applies one operation at a time and copies everything.

use std::collections::BTreeMap;
use std::sync::Arc;

use proptest::prelude::*;
use serde_json::json;

use super::document::Template;
use super::pending::{Pending, Prepared};
use super::state::{RingLimits, State};
use super::*;

const TASKS: Resource = Resource::new("tasks");

#[derive(Debug, Clone)]
enum Step {
    Transaction(Vec<Change>),
    Commit,
    Fail,
}

#[derive(Debug, Clone)]
enum Change {
    Put(u8, Guard),
    Delete(u8, Guard),
}

#[derive(Debug, Clone, Copy)]
enum Guard {
    Any,
    Absent,
    Present,
    /// The revision that the object has in the model.
    Right,
    Wrong,
}

type Model = BTreeMap<u8, u64>;

fn guard() -> impl Strategy<Value = Guard> {
    use Guard::*;
    prop_oneof![Just(Any), Just(Absent), Just(Present), Just(Right), Just(Wrong)]
}

fn step() -> impl Strategy<Value = Step> {
    let change = prop_oneof![
        3 => (0..4_u8, guard()).prop_map(|(key, guard)| Change::Put(key, guard)),
        1 => (0..4_u8, guard()).prop_map(|(key, guard)| Change::Delete(key, guard)),
    ];
    prop_oneof![
        6 => prop::collection::vec(change, 1..4).prop_map(Step::Transaction),
        2 => Just(Step::Commit),
        1 => Just(Step::Fail),
    ]
}

fn key(n: u8) -> Key {
    Key::namespaced(TASKS, "default", n.to_string())
}

fn allowed(model: &Model, n: u8, guard: Guard) -> bool {
    match guard {
        Guard::Any => true,
        Guard::Absent => !model.contains_key(&n),
        Guard::Present | Guard::Right => model.contains_key(&n),
        Guard::Wrong => false,
    }
}

fn precondition(model: &Model, n: u8, guard: Guard) -> Precondition {
    match guard {
        Guard::Any => Precondition::Any,
        Guard::Absent => Precondition::Absent,
        Guard::Present => Precondition::PRESENT,
        Guard::Right => Precondition::revision(model.get(&n).copied().unwrap_or(u64::MAX)),
        Guard::Wrong => Precondition::revision(u64::MAX),
    }
}

/// The model's answer to a transaction, and the operations with the revisions that the model foresees.
fn foresee(model: &Model, last: u64, changes: &[Change]) -> (Vec<Prepared>, Option<(Model, u64)>) {
    let (mut model, mut last, mut fits) = (model.clone(), last, true);
    let mut ops = Vec::new();
    for change in changes {
        let (n, guard, put) = match *change {
            Change::Put(n, guard) => (n, guard, true),
            Change::Delete(n, guard) => (n, guard, false),
        };
        let precondition = precondition(&model, n, guard);
        fits &= allowed(&model, n, guard) && (put || model.contains_key(&n));
        last += 1;
        if put {
            let template = Template::new(&json!({"metadata": {"name": n.to_string()}})).unwrap();
            ops.push(Prepared::Put { key: key(n), template, precondition });
            model.insert(n, last);
        } else {
            ops.push(Prepared::Delete { key: key(n), precondition });
            model.remove(&n);
        }
    }
    (ops, fits.then_some((model, last)))
}

fn view(items: &[Arc<Stored>]) -> Vec<(String, u64)> {
    items.iter().map(|stored| (stored.key.name.to_string(), stored.revision)).collect()
}

fn expected(model: &Model) -> Vec<(String, u64)> {
    model.iter().map(|(n, revision)| (n.to_string(), *revision)).collect()
}

proptest! {
    #[test]
    fn batches_behave_like_one_operation_at_a_time(steps in prop::collection::vec(step(), 1..60)) {
        let mut state = State::new(RingLimits { events: 12, bytes: 1 << 20 });
        let mut pending = Pending::default();
        let mut committed = (Model::new(), 0);
        let mut ahead = committed.clone();
        let mut history = BTreeMap::from([committed.clone()].map(|(model, last)| (last, model)));
        for step in steps {
            match step {
                Step::Transaction(changes) => {
                    let (ops, outcome) = foresee(&ahead.0, ahead.1, &changes);
                    let admitted = pending.admit(&state, ops);
                    prop_assert_eq!(admitted.is_ok(), outcome.is_some(), "{:?}", admitted);
                    ahead = outcome.unwrap_or(ahead);
                }
                Step::Commit => {
                    for event in std::mem::take(&mut pending).events {
                        prop_assert_eq!(event.revision(), state.revision() + 1);
                        state.apply(event);
                    }
                    committed = ahead.clone();
                    history.insert(committed.1, committed.0.clone());
                }
                Step::Fail => {
                    pending = Pending::default();
                    ahead = committed.clone();
                }
            }
            prop_assert_eq!(view(&state.snapshot(TASKS, None, None).items), expected(&committed.0));
        }
        // Every committed point that the ring still reaches can be listed exactly.
        for (&revision, model) in &history {
            match state.snapshot_at(TASKS, None, None, revision) {
                Ok(then) => prop_assert_eq!(view(&then.items), expected(model)),
                Err(_) => prop_assert!(revision < state.compacted()),
            }
        }
    }
}
