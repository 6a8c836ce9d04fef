//! What the engine says of a container, as the core wants it.

use bollard::Docker;
use bollard::errors::Error;
use bollard::models::{ContainerState, ContainerStateStatusEnum as Status};
use muster_agent_core::observed::{End, Exit};
use muster_agent_core::time::Wall;

/// Where a container is.
#[derive(Debug)]
pub(super) enum Seen {
    /// Made, never started.
    Created,
    /// Its first process runs.
    Running { pid: i32, at: Wall },
    /// Over.
    Ended(Exit),
}

/// Looks at a container; `None`: there is none of that name.
pub(super) async fn inspect(docker: &Docker, name: &str) -> Result<Option<Seen>, Error> {
    match docker.inspect_container(name, None).await {
        Ok(answer) => Ok(answer.state.map(|state| seen(&state))),
        Err(error) if is_missing(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

fn seen(state: &ContainerState) -> Seen {
    let started_at = time(state.started_at.as_deref());
    match state.status {
        Some(Status::RUNNING | Status::PAUSED | Status::RESTARTING) => Seen::Running {
            pid: state.pid.and_then(|pid| i32::try_from(pid).ok()).unwrap_or(0),
            at: started_at.unwrap_or_default(),
        },
        Some(Status::CREATED) | None | Some(Status::EMPTY) => Seen::Created,
        Some(Status::EXITED | Status::DEAD | Status::REMOVING | Status::STOPPING) => {
            Seen::Ended(Exit {
                end: end(state.exit_code.unwrap_or(-1)),
                oom_killed: state.oom_killed.unwrap_or(false),
                disconnected: false,
                started_at,
                finished_at: time(state.finished_at.as_deref()).unwrap_or_default(),
            })
        }
    }
}

/// The engine tells a signal as a shell does. A program that itself returns 137 is taken for killed:
/// nobody can tell the two apart, and programs do not.
fn end(code: i64) -> End {
    match i32::try_from(code).unwrap_or(-1) {
        137 => End::Signaled(libc::SIGKILL),
        143 => End::Signaled(libc::SIGTERM),
        139 => End::Signaled(libc::SIGSEGV),
        134 => End::Signaled(libc::SIGABRT),
        code => End::Exited(code),
    }
}

/// The engine writes the year 1 for "never".
fn time(text: Option<&str>) -> Option<Wall> {
    let time: jiff::Timestamp = text?.parse().ok()?;
    Some(Wall(time.as_millisecond())).filter(|wall| wall.0 > 0)
}

/// The engine's own answer: status and words. `None`: it did not answer.
pub(super) fn refusal(error: &Error) -> Option<(u16, String)> {
    match error {
        Error::DockerResponseServerError { status_code, message } => {
            Some((*status_code, message.clone()))
        }
        _ => None,
    }
}

/// The engine was not reached: whatever was asked for has not happened.
pub(super) fn never_sent(error: &Error) -> bool {
    match error {
        Error::HyperLegacyError { err } => err.is_connect(),
        Error::SocketNotFoundError(_) => true,
        _ => false,
    }
}

pub(super) fn is_missing(error: &Error) -> bool {
    matches!(refusal(error), Some((404, _)))
}

/// The container does not run (any more).
pub(super) fn is_over(error: &Error) -> bool {
    matches!(refusal(error), Some((304 | 404 | 409, _)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_of_the_engine() {
        let state = |status, code| ContainerState {
            status: Some(status),
            exit_code: Some(code),
            started_at: Some("0001-01-01T00:00:00Z".to_owned()),
            finished_at: Some("2026-01-31T12:00:00.5Z".to_owned()),
            ..ContainerState::default()
        };
        let Seen::Ended(exit) = seen(&state(Status::EXITED, 137)) else { panic!("ended") };
        assert_eq!((exit.code(), exit.signal(), exit.started_at), (Some(137), Some(9), None));
        assert_eq!(exit.finished_at, Wall(1_769_860_800_500));
        assert!(matches!(seen(&state(Status::CREATED, 0)), Seen::Created));
        assert!(matches!(seen(&state(Status::PAUSED, 0)), Seen::Running { .. }));
    }
}
