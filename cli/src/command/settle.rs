//! Waiting until tasks are settled: they run, have ended, or say why they wait. A live row per task.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use muster_api::kind::task::{Task, TaskStatus};
use muster_api::phase::TaskPhase;
use serde_json::Value;
use tokio::time::Instant;

use super::Outcome;
use super::why::refusal_table;
use crate::client::Selection;
use crate::error::CliError;
use crate::exit;
use crate::output::columns::task as columns;
use crate::output::human;
use crate::output::progress::Progress;
use crate::session::Session;
use crate::successor;
use crate::target;
use crate::watch::{Change, Follow, merged};

/// A task that says why it waits may be placed a moment later, when another one ends or a node joins.
/// Only when nothing has changed for this long does it count as waiting.
const STEADY: Duration = Duration::from_millis(1500);

/// How far a task is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    /// On its way.
    Moving,
    Runs,
    Succeeded,
    Failed,
    /// No node takes it; the status says why.
    Waits,
    Deleted,
}

fn verdict(status: &TaskStatus) -> Verdict {
    match status.phase {
        TaskPhase::Running => Verdict::Runs,
        TaskPhase::Succeeded => Verdict::Succeeded,
        TaskPhase::Failed => Verdict::Failed,
        // It waits for nobody but the clock.
        TaskPhase::Pending if status.why.iter().any(|w| w.reason == "BackOff") => Verdict::Moving,
        TaskPhase::Pending if !status.why.is_empty() => Verdict::Waits,
        TaskPhase::Pending
        | TaskPhase::Bound
        | TaskPhase::Starting
        | TaskPhase::Stopping
        | TaskPhase::Unknown => Verdict::Moving,
    }
}

struct Row {
    title: String,
    status: TaskStatus,
    verdict: Verdict,
}

/// Waits for the tasks; the exit code says whether all of them are placed and well.
pub(crate) async fn until_settled<'a>(
    tasks: impl Iterator<Item = &'a Value>,
    timeout: Duration,
    session: &mut Session,
) -> Outcome {
    let mut rows: BTreeMap<String, Row> = BTreeMap::new();
    let mut namespaces = BTreeSet::new();
    for object in tasks {
        let Ok(task) = serde_json::from_value::<Task>(object.clone()) else { continue };
        let title = format!("task/{}", task.metadata.name.unwrap_or_default());
        namespaces.insert(task.metadata.namespace.unwrap_or_default());
        let row = Row { title, status: TaskStatus::default(), verdict: Verdict::Moving };
        rows.insert(task.metadata.uid.unwrap_or_default(), row);
    }
    let info = target::kind("task")?;
    let follow = |ns: &String| Follow::new(&session.client, info, Some(ns), Selection::default());
    let mut changes = merged(namespaces.iter().map(follow));
    let mut progress = session.ui.progress();
    for (uid, row) in &rows {
        progress.show(uid, &line(row));
    }
    let deadline = Instant::now() + timeout;
    let mut steady_since = Instant::now();
    loop {
        let moving = rows.values().any(|r| r.verdict == Verdict::Moving);
        let waits = rows.values().any(|r| r.verdict == Verdict::Waits);
        if !moving && !waits {
            break;
        }
        let until = if moving { deadline } else { deadline.min(steady_since + STEADY) };
        match tokio::time::timeout_at(until, changes.recv()).await {
            Err(_) => break,
            Ok(change) => {
                if note(change?, &mut rows, &mut progress) {
                    steady_since = Instant::now();
                }
            }
        }
    }
    progress.end(true);
    report(&rows, timeout, session)
}

/// Notes a change; says whether one of our tasks is at another point now.
fn note(change: Change, rows: &mut BTreeMap<String, Row>, progress: &mut Progress) -> bool {
    let (object, gone) = match change {
        Change::Applied(object) => (object, false),
        Change::Deleted(object) => (object, true),
        Change::Synced => return false,
    };
    let Some((uid, another)) = successor::claim(rows, &object) else { return false };
    another.iter().for_each(|another| progress.drop_row(another));
    let Some(row) = rows.get_mut(&uid) else { return false };
    let status = object.get("status").cloned().unwrap_or_default();
    row.status = serde_json::from_value(status).unwrap_or_default();
    let before = row.verdict;
    row.verdict = match (successor::is_tried_again(&object), gone) {
        (true, _) => Verdict::Moving,
        (false, true) => Verdict::Deleted,
        (false, false) => verdict(&row.status),
    };
    let text = line(row);
    match row.verdict {
        Verdict::Moving => {
            progress.unsettle(&uid);
            progress.show(&uid, &text);
        }
        Verdict::Waits => progress.settle(&uid, "…", &text),
        Verdict::Runs | Verdict::Succeeded => progress.settle(&uid, "✓", &text),
        Verdict::Failed | Verdict::Deleted => progress.settle(&uid, "✗", &text),
    }
    row.verdict != before
}

fn line(row: &Row) -> String {
    let Row { title, status, verdict } = row;
    let mut text = format!("{title} ");
    text.push_str(match verdict {
        Verdict::Waits => "waits",
        Verdict::Deleted => "was deleted",
        _ => status.phase.as_str(),
    });
    if let Some(node) = &status.node {
        text.push_str(&format!(" on {node}"));
    }
    let reason = columns::reason(status);
    if !reason.is_empty() {
        text.push_str(&format!(": {reason}"));
    }
    text
}

/// What is not as it should be, to standard error; the exit code.
fn report(rows: &BTreeMap<String, Row>, timeout: Duration, session: &mut Session) -> Outcome {
    let of = |verdict: Verdict| rows.values().filter(move |r| r.verdict == verdict);
    for row in of(Verdict::Waits) {
        session.ui.line(&format!("\n{} waits:", row.title))?;
        let table = refusal_table(&row.status.why).text(&session.ui.styles);
        session.ui.print(&table)?;
    }
    // Which ones failed stands in the rows above; what they said of it may be long.
    for row in of(Verdict::Failed).filter(|r| !r.status.message.is_empty()) {
        session.ui.note(&format!("{}: {}", row.title, human::plain(&row.status.message)));
    }
    let moving: Vec<&str> = of(Verdict::Moving).map(|r| r.title.as_str()).collect();
    if of(Verdict::Failed).chain(of(Verdict::Deleted)).next().is_some() {
        return Ok(exit::TASK_ENDED);
    }
    if !moving.is_empty() {
        return Err(CliError::Timeout {
            what: moving.join(", "),
            after: timeout,
            hint: Some(format!("`muster why {}` says what it waits for", moving[0])),
        });
    }
    Ok(if of(Verdict::Waits).next().is_some() { exit::NOT_PLACED } else { exit::OK })
}
