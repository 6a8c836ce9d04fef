//! Which template is wanted, which was good, and which are forgotten.

use std::collections::BTreeSet;

use super::rollout::Course;
use super::view::RevisionView;
use super::{Action, Plan, Snapshot};

/// The revisions that matter now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct History {
    /// That of the spec's template.
    pub update: String,
    /// The last that was available everywhere, while its template is still known.
    pub good: Option<String>,
}

/// Finds the revision of the spec's template, and makes it the newest.
pub(super) fn settle(snapshot: &Snapshot<'_>, plan: &mut Plan) -> History {
    let newest = snapshot.revisions.iter().map(|r| r.number).max().unwrap_or(0);
    let same = |r: &&RevisionView| r.template == snapshot.spec.template;
    // Templates are compared and not digests: a digest is only a name.
    let update = match snapshot.revisions.iter().filter(same).max_by_key(|r| r.number) {
        Some(found) => {
            if found.number < newest {
                let (name, number) = (found.name.clone(), newest + 1);
                plan.actions.push(Action::Renumber { name, number });
            }
            found.name.clone()
        }
        None => {
            let name = new_name(snapshot);
            let number = newest + 1;
            plan.actions.push(Action::CreateRevision { name: name.clone(), number });
            name
        }
    };
    let status = &mut plan.status;
    status.update_revision.clone_from(&update);
    // Whoever wants another template has seen what became of the one before.
    status.rolled_back_from.take_if(|back| back.revision != update);
    let good = Some(status.current_revision.clone()).filter(|name| is_known(snapshot, name));
    History { update, good }
}

fn is_known(snapshot: &Snapshot<'_>, name: &str) -> bool {
    snapshot.revisions.iter().any(|r| r.name == name)
}

fn new_name(snapshot: &Snapshot<'_>) -> String {
    let name = |salt| format!("{}-{}", snapshot.name, snapshot.spec.template.digest(salt));
    (0..)
        .map(name)
        .find(|name| !is_known(snapshot, name))
        .expect("there are fewer revisions than salts")
}

/// Forgets the oldest of those that nothing is made of.
pub(super) fn forget(snapshot: &Snapshot<'_>, course: &Course, plan: &mut Plan) {
    let status = &plan.status;
    let used: BTreeSet<&str> = snapshot
        .tasks
        .iter()
        .map(|t| t.revision.as_str())
        .chain(status.replacing.iter().map(|r| r.revision.as_str()))
        .chain(status.rolled_back_from.iter().map(|b| b.revision.as_str()))
        .chain([
            &*status.current_revision,
            &*status.update_revision,
            &*course.target,
            &*course.base,
        ])
        .collect();
    let mut old: Vec<&RevisionView> =
        snapshot.revisions.iter().filter(|r| !used.contains(r.name.as_str())).collect();
    old.sort_by_key(|r| r.number);
    let limit = usize::try_from(snapshot.spec.rollout.revision_history_limit).unwrap_or(usize::MAX);
    let surplus = old.len().saturating_sub(limit);
    let gone = old[..surplus].iter().map(|r| Action::DeleteRevision { name: r.name.clone() });
    let gone: Vec<Action> = gone.collect();
    plan.actions.extend(gone);
}
