//! Reports in their wire form.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use muster_agent_core::report::{Phase, Report};
use muster_agent_core::time::Wall;
use muster_api::id::TaskUid;
use muster_api::wire::agent::v1 as proto;

/// A report as the controller gets it.
#[must_use]
pub fn to_wire(uid: &TaskUid, report: &Report) -> proto::TaskReport {
    let content = &report.content;
    proto::TaskReport {
        uid: uid.to_string(),
        sequence: report.sequence,
        phase: phase(content.phase).into(),
        attempt: content.attempt,
        exit_code: content.exit_code,
        reason: content.reason.to_string(),
        message: content.message.clone(),
        started_at: content.started_at.map(|at| time(at).into()),
        finished_at: content.finished_at.map(|at| time(at).into()),
        restarts: content.restarts,
        signal: content.signal,
        ready: content.ready,
        failed_attempts: content.failed_attempts,
    }
}

fn phase(phase: Phase) -> proto::TaskPhase {
    match phase {
        Phase::Starting => proto::TaskPhase::Starting,
        Phase::Running => proto::TaskPhase::Running,
        Phase::Stopping => proto::TaskPhase::Stopping,
        Phase::Succeeded => proto::TaskPhase::Succeeded,
        Phase::Failed => proto::TaskPhase::Failed,
    }
}

/// The wire has its own type for this; both ends of it know the system's.
fn time(wall: Wall) -> SystemTime {
    let millis = Duration::from_millis(wall.0.unsigned_abs());
    if wall.0 >= 0 { UNIX_EPOCH + millis } else { UNIX_EPOCH - millis }
}
