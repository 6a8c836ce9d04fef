//! A person's hold on a robot's actuators: whether they get it, and what their grant does to others.
//!
//! The model is Spot's lease service: Acquire takes only what is free, Take takes it from whoever has it, and only who holds it
//! returns it. A grant to a person has a number as a task's has. What was granted before it never counts again (the *fence*), also
//! after the person has returned it: automation does not take a robot back by itself; a new task gets a new grant.

use std::fmt;

use muster_api::id::Epoch;
use muster_api::kind::lease::{HolderKind, LeaseHolder, LeaseStatus};

/// What a person does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Takes what is free.
    Acquire,
    /// Takes it, whoever has it.
    Take,
    /// Gives it back.
    Return,
}

/// What is known of the robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Robot {
    /// Why commands of a former holder would still pass; none: its gate refuses them.
    pub unfenced: Option<String>,
    /// Its agent is there.
    pub is_heard: bool,
    /// Tasks that have not ended there were granted it, or what was called off there lives: whoever holds it now, they may
    /// have its drivers still.
    pub is_driven: bool,
}

/// What becomes of the lease.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// It is as the person wants it already.
    AsItWas,
    /// They hold it.
    Held {
        /// What is written; its `acquired` is the caller's to say.
        status: LeaseStatus,
        /// From whom it was taken.
        from: Option<LeaseHolder>,
    },
    /// Nobody holds it.
    Free {
        /// What is written.
        status: LeaseStatus,
    },
}

/// Why not.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Refused {
    /// Somebody holds it.
    Held(LeaseHolder),
    /// Only who holds it returns it.
    NotHolder(Option<LeaseHolder>),
    /// Its present holder could not be kept from driving on.
    NotFenced(String),
    /// Its agent cannot be told.
    Away,
}

impl Refused {
    /// One word.
    #[must_use]
    pub const fn reason(&self) -> &'static str {
        match self {
            Refused::Held(_) => "LeaseHeld",
            Refused::NotHolder(_) => "NotHolder",
            Refused::NotFenced(_) => "NotFenced",
            Refused::Away => "NodeAway",
        }
    }
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Refused::Held(by) => write!(f, "{by} holds it; `take` takes it from them"),
            Refused::NotHolder(Some(by)) => write!(f, "{by} holds it, and only they return it"),
            Refused::NotHolder(None) => f.write_str("nobody holds it"),
            Refused::NotFenced(why) => write!(
                f,
                "a task there would drive on: {why}; stop the robot (`muster estop`) or end the task"
            ),
            Refused::Away => f.write_str(
                "the robot's agent is not connected, so its task cannot be told; what drives it drives on",
            ),
        }
    }
}

/// What comes of a step of `user` on a lease.
///
/// # Errors
///
/// Why nothing does.
pub fn step(
    step: Step,
    user: &str,
    before: &LeaseStatus,
    robot: &Robot,
) -> Result<Outcome, Refused> {
    let mine = |holder: &LeaseHolder| holder.kind == HolderKind::User && holder.name == user;
    // Whoever stands in the lease: a task that had it before a person runs on, and drives until its gate refuses it.
    let takes = || match robot.is_driven {
        true => can_be_told(robot),
        false => Ok(()),
    };
    match (step, &before.holder) {
        (Step::Acquire | Step::Take, Some(holder)) if mine(holder) => {
            takes()?;
            Ok(Outcome::AsItWas)
        }
        (Step::Acquire, Some(holder)) => Err(Refused::Held(holder.clone())),
        (Step::Take, Some(holder)) if holder.kind == HolderKind::Task => {
            can_be_told(robot)?;
            Ok(held(user, before))
        }
        (Step::Acquire, None) | (Step::Take, _) => {
            takes()?;
            Ok(held(user, before))
        }
        (Step::Return, Some(holder)) if mine(holder) => {
            let status = LeaseStatus { holder: None, acquired: None, ..before.clone() };
            Ok(Outcome::Free { status })
        }
        (Step::Return, holder) => Err(Refused::NotHolder(holder.clone())),
    }
}

fn can_be_told(robot: &Robot) -> Result<(), Refused> {
    if !robot.is_heard {
        return Err(Refused::Away);
    }
    match &robot.unfenced {
        Some(why) => Err(Refused::NotFenced(why.clone())),
        None => Ok(()),
    }
}

fn held(user: &str, before: &LeaseStatus) -> Outcome {
    let epoch: Epoch = before.epoch.next();
    let status = LeaseStatus {
        epoch,
        holder: Some(LeaseHolder::person(user, epoch)),
        acquired: None,
        renewed: None,
        fence: Some(epoch),
    };
    Outcome::Held { status, from: before.holder.clone() }
}

#[cfg(test)]
mod tests {
    use muster_api::id::TaskUid;

    use super::*;

    fn task() -> LeaseHolder {
        LeaseHolder {
            kind: HolderKind::Task,
            namespace: "default".to_owned(),
            name: "patrol".to_owned(),
            uid: TaskUid::new("u"),
        }
    }

    fn lease(epoch: u64, holder: Option<LeaseHolder>) -> LeaseStatus {
        LeaseStatus { epoch: Epoch(epoch), holder, ..LeaseStatus::default() }
    }

    const READY: Robot = Robot { unfenced: None, is_heard: true, is_driven: false };

    fn held_by(outcome: Result<Outcome, Refused>) -> (u64, String, Option<LeaseHolder>) {
        match outcome {
            Ok(Outcome::Held { status, from }) => {
                assert_eq!(status.fence, Some(status.epoch));
                (status.epoch.0, status.holder.unwrap().to_string(), from)
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn acquire_takes_what_is_free_and_nothing_else() {
        let got = held_by(step(Step::Acquire, "ada", &lease(4, None), &READY));
        assert_eq!(got, (5, "user ada".to_owned(), None));
        let refused = step(Step::Acquire, "ada", &lease(4, Some(task())), &READY).unwrap_err();
        assert_eq!(refused, Refused::Held(task()));
        let bob = lease(5, Some(LeaseHolder::person("bob", Epoch(5))));
        assert_eq!(step(Step::Acquire, "bob", &bob, &READY), Ok(Outcome::AsItWas));
        assert!(step(Step::Acquire, "ada", &bob, &READY).is_err());
    }

    #[test]
    fn take_is_a_newer_grant_than_that_of_whoever_had_it() {
        let got = held_by(step(Step::Take, "ada", &lease(4, Some(task())), &READY));
        assert_eq!(got, (5, "user ada".to_owned(), Some(task())));
        let bob = LeaseHolder::person("bob", Epoch(5));
        let away =
            Robot { unfenced: Some("no driver".to_owned()), is_heard: false, is_driven: false };
        let got = held_by(step(Step::Take, "ada", &lease(5, Some(bob.clone())), &away));
        assert_eq!(got, (6, "user ada".to_owned(), Some(bob)));
    }

    #[test]
    fn nothing_is_taken_from_a_task_that_would_drive_on() {
        let taken = lease(4, Some(task()));
        let unfenced =
            Robot { unfenced: Some("no driver".to_owned()), is_heard: true, is_driven: true };
        let refused = step(Step::Take, "ada", &taken, &unfenced).unwrap_err();
        assert_eq!(refused, Refused::NotFenced("no driver".to_owned()));
        let away = Robot { unfenced: None, is_heard: false, is_driven: true };
        assert_eq!(step(Step::Take, "ada", &taken, &away).unwrap_err(), Refused::Away);
    }

    #[test]
    fn a_task_that_had_it_before_a_person_counts_as_long_as_it_runs() {
        let bob = lease(5, Some(LeaseHolder::person("bob", Epoch(5))));
        let unfenced =
            Robot { unfenced: Some("no driver".to_owned()), is_heard: true, is_driven: true };
        let away = Robot { unfenced: None, is_heard: false, is_driven: true };
        for (asks, user, lease) in [
            (Step::Take, "ada", &bob),
            (Step::Take, "bob", &bob),
            (Step::Acquire, "bob", &bob),
            (Step::Acquire, "ada", &lease(5, None)),
            (Step::Take, "ada", &lease(5, None)),
        ] {
            let why = step(asks, user, lease, &unfenced).unwrap_err();
            assert_eq!(why, Refused::NotFenced("no driver".to_owned()), "{asks:?} of {user}");
            assert_eq!(step(asks, user, lease, &away).unwrap_err(), Refused::Away);
        }
        let told = Robot { is_driven: true, ..READY };
        assert_eq!(held_by(step(Step::Take, "ada", &bob, &told)).0, 6);
        assert!(matches!(step(Step::Return, "bob", &bob, &unfenced), Ok(Outcome::Free { .. })));
    }

    #[test]
    fn only_who_holds_it_returns_it_and_its_number_stays() {
        let ada = lease(5, Some(LeaseHolder::person("ada", Epoch(5))));
        let mut ada = ada;
        ada.fence = Some(Epoch(5));
        let Ok(Outcome::Free { status }) = step(Step::Return, "ada", &ada, &READY) else {
            panic!("hers")
        };
        assert_eq!((status.epoch, status.fence, status.holder), (Epoch(5), Some(Epoch(5)), None));
        assert!(matches!(
            step(Step::Return, "bob", &ada, &READY),
            Err(Refused::NotHolder(Some(_)))
        ));
        let none = step(Step::Return, "ada", &lease(5, None), &READY);
        assert_eq!(none, Err(Refused::NotHolder(None)));
        // A task of the user's name is not the user.
        let namesake = LeaseHolder { name: "ada".to_owned(), ..task() };
        assert!(step(Step::Return, "ada", &lease(5, Some(namesake)), &READY).is_err());
    }
}
