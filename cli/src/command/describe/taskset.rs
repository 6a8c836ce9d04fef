//! A set of tasks: what it should be, what it is, and where its rollout stands.

use jiff::Timestamp;
use muster_api::kind::task::Task;
use muster_api::kind::taskset::{
    REVISION_LABEL, Rollout, TaskSet, TaskSetStatus, UnreachablePolicy,
};

use super::{begin, condition_table, when};
use crate::client::Selection;
use crate::output::columns::{task as of_task, taskset as columns};
use crate::output::sheet::Sheet;
use crate::output::style::Mood;
use crate::output::table::{Cell, Table};

/// Where its tasks are and what they have in common.
pub(super) fn its_tasks(set: &TaskSet) -> (Option<&str>, Selection) {
    let name = set.metadata.name.as_deref().unwrap_or_default();
    let labels = Some(set.spec.selects(name).to_string());
    (set.metadata.namespace.as_deref(), Selection { labels, fields: None })
}

pub(super) fn describe(sheet: &mut Sheet, set: &TaskSet, tasks: &[Task], now: Timestamp) {
    begin(sheet, &set.metadata, now);
    let name = set.metadata.name.as_deref().unwrap_or_default();
    let status = set.status.clone().unwrap_or_default();
    sheet.field("Selector", set.spec.selects(name).to_string());
    let how = match (set.spec.every_node, set.spec.spread) {
        (true, _) => "on each node that matches",
        (false, true) => "each on a node of its own",
        (false, false) => "wherever is best",
    };
    sheet.field("Desired", format!("{}, {how}", columns::desired(set)));
    sheet.field(
        "Tasks",
        format!(
            "{} are, {} updated, {} ready, {} available",
            status.replicas,
            status.updated_replicas,
            status.ready_replicas,
            status.available_replicas
        ),
    );
    rollout(sheet, &set.spec.rollout);
    sheet.field("Available", format!("after {} s", set.spec.min_ready_seconds));
    if set.spec.on_unreachable.policy == UnreachablePolicy::Replace {
        sheet.field("Unreachable", "another begins elsewhere");
    }
    revisions(sheet, &status, now);
    sheet.table("Conditions", condition_table(&status.conditions, now));
    if !status.image_pulls.is_empty() {
        sheet.table("Images that come before tasks end", pulls(&status, now));
    }
    if !status.held.is_empty() {
        sheet.table("Held by missions", held(&status));
    }
    sheet.table("Tasks", task_table(set, tasks));
}

fn rollout(sheet: &mut Sheet, rollout: &Rollout) {
    let paused = if rollout.paused { ", paused" } else { "" };
    sheet.field("Strategy", format!("{:?}{paused}", rollout.strategy));
    sheet.field("At once down", format!("{} at most", rollout.max_unavailable));
    sheet.field("Canary", rollout.canary.to_string());
    let then = if rollout.auto_rollback { "then back" } else { "then it stops" };
    sheet.field("Deadline", format!("{} s a task, {then}", rollout.progress_deadline_seconds));
}

fn revisions(sheet: &mut Sheet, status: &TaskSetStatus, now: Timestamp) {
    let some = |text: &str| Some(text.to_owned()).filter(|t| !t.is_empty());
    sheet.maybe("Template", some(&status.update_revision));
    sheet.maybe("Last good", some(&status.current_revision));
    if let Some(back) = &status.rolled_back_from {
        let text = format!("{}, {}: {}", back.revision, back.reason, back.message);
        sheet.field("Given up", Cell::new(text, Mood::Bad));
        sheet.field("", when(back.at.0, now));
    }
}

fn pulls(status: &TaskSetStatus, now: Timestamp) -> Table {
    let mut table = Table::new(["NODE", "IMAGE", "POLICY", "WANTED"]);
    for pull in &status.image_pulls {
        let wish = &pull.wish;
        table.push([
            pull.node.clone(),
            wish.image.clone(),
            format!("{:?}", wish.pull_policy),
            when(wish.since.0, now),
        ]);
    }
    table
}

fn held(status: &TaskSetStatus) -> Table {
    let mut table = Table::new(["NODE", "TASK", "HOLDER", "REASON"]);
    for held in &status.held {
        table.push([&held.node, &held.task, &held.holder, &held.reason]);
    }
    table
}

fn task_table(set: &TaskSet, tasks: &[Task]) -> Table {
    let mut table = Table::new(["NAME", "PHASE", "NODE", "REVISION", "REASON"]);
    let uid = set.metadata.uid.as_deref();
    let mine = |t: &&Task| {
        let mut owners = t.metadata.owner_references.iter().flatten();
        owners.any(|o| Some(o.uid.as_str()) == uid)
    };
    let prefix = format!("{}-", set.metadata.name.as_deref().unwrap_or_default());
    for task in tasks.iter().filter(mine) {
        let status = task.status.clone().unwrap_or_default();
        let labels = task.metadata.labels.clone().unwrap_or_default();
        let revision = labels.get(REVISION_LABEL).map(String::as_str).unwrap_or_default();
        table.push([
            Cell::from(task.metadata.name.as_deref().unwrap_or_default()),
            Cell::new(status.phase.as_str(), of_task::mood(status.phase)),
            status.node.clone().unwrap_or_default().into(),
            revision.strip_prefix(&prefix).unwrap_or(revision).into(),
            of_task::reason(&status).into(),
        ]);
    }
    table
}
