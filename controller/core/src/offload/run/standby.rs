//! What a robot begins by itself when it is cut off: while a part is away, a task of it stands by at home, with its cpu and
//! memory kept.
//!
//! A part that is [`CutOff::Fenced`] never runs twice:
//!
//! ```text
//!   robot cut off ──stop──▶ the controller ends what is away ──grace──▶ gone ──SLACK──▶ the robot begins the standby
//!                   its server cut off just before that ──stop──▶ the server ends it ──grace──▶ gone ─▲
//! ```
//!
//! What is away ends by the controller's word when the robot is silent, and by its own node's when that is cut off as well
//! (`onDisconnect: Stop`). Each counts from its last contact by its own clock; heartbeats that one side knows of and the
//! other does not are what [`SLACK`] is for. A part with actuators never comes here: it is critical.
//!
//! One that is [`CutOff::InTime`] begins before its connections' tolerance is over, where that is longer than a controller
//! takes to start again; what is away is told to end at the same moment.
//!
//! A controller that is killed and started again does not know when the robot was heard last. Until it hears it, that is
//! written into the Node ([`NodeSeen::unheard`]), and lasts however often it is killed: the robot is given up for silent a
//! fixed time after the first of these starts, and what is away is ended as soon as it is.
//!
//! [`NodeSeen::unheard`]: super::view::NodeSeen::unheard

use std::time::Duration;

use muster_api::kind::application::{CutOff, Part, stamp};
use muster_api::phase::TaskPhase;

use super::runner::Runner;
use super::view::TaskSeen;
use super::{Action, Ending, Gathered, Look, NewTask, News};
use crate::offload::migration::{Attempt, Event, Stage};
use crate::offload::problem::HOME;
use crate::taskset::after;
use crate::taskset::places::REPLACE_ENDED_AFTER;

/// For so long without contact nothing away is ended, and nothing is begun at home: a controller that is started again, or
/// upgraded, is back by then.
const BEARS: Duration = Duration::from_secs(5);
/// Between the end of what is away and the beginning of the standby: heartbeats that only one side knows of (until a silence is
/// noticed, 2 s), a controller that is started again (it counts every node as heard 3 s longer), and clocks.
const SLACK: Duration = Duration::from_secs(8);

/// When who acts without contact, counted from the last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Alone {
    /// What is away is told to end.
    pub(super) stop: Duration,
    /// The robot begins the standby.
    pub(super) begin: Duration,
}

impl Alone {
    /// The standby serves before its connections' tolerance is over; of a part that must not run twice, where that is longer
    /// than fencing takes.
    pub(super) fn of(patience: Option<Duration>, grace: Duration, when: CutOff) -> Self {
        let takes = grace + SLACK;
        let fenced = patience.unwrap_or_default().max(BEARS * 2 + takes);
        let begin = urgent(when, patience).map_or(fenced, |patience| patience.max(BEARS));
        Alone { stop: fenced.saturating_sub(takes) / 2, begin }
    }
}

/// How long its connections bear, of a part that is begun in time; none: it waits until what is away has surely ended.
fn urgent(when: CutOff, patience: Option<Duration>) -> Option<Duration> {
    patience.filter(|_| when == CutOff::InTime)
}

fn grace(part: &Part) -> Duration {
    Duration::from_secs(part.template.spec.grace_period_seconds.into())
}

impl Runner {
    pub(super) fn alone_after(&self, look: &Look<'_>) -> Option<Alone> {
        let part = self.spec(look)?;
        let patience = look.model.patience(self.part?);
        Some(Alone::of(patience, grace(part), part.when_cut_off))
    }

    /// What became of the task that stands by.
    pub(super) fn take_in_standby(&mut self, look: &Look<'_>, out: &mut Gathered) {
        let Some(standby) = self.standby else { return };
        let Some(task) = self.task(look, standby) else {
            self.standby = None;
            return;
        };
        if task.view.phase.is_terminal() {
            // By the controller's clock it cannot have ended later than now.
            let ended = task.view.finished.unwrap_or(task.view.created).min(look.now);
            let due = after(ended, REPLACE_ENDED_AFTER);
            if due > look.now {
                return out.look_at(due);
            }
            self.standby = None;
            return self.take_away(look, standby, Ending::Over, out);
        }
        // One that is being ended is there until it is gone: a robot that cannot be told begins it all the same.
        if task.view.attempt == 0 || task.view.ending {
            return;
        }
        // The robot has begun it.
        self.standby = None;
        self.explain(standby, ("Alone", "its robot was cut off, and has begun it by itself"));
        self.happen(look, Event::CutOff { standby }, out);
        if self.stage.map(Stage::serves) != Some(standby) {
            return self.take_away(look, standby, Ending::NotNeeded, out);
        }
        self.status.moved_at = Some(stamp(look.now));
        let (part, task) = (self.status.name.clone(), self.name_of(standby).to_owned());
        out.news.push(News::Alone { part, task });
    }

    /// A task stands by while the part is away, and at no other time; and what is away ends in time when the robot is cut
    /// off.
    pub(super) fn stand_by(&mut self, look: &Look<'_>, out: &mut Gathered) {
        let away = self.stage.filter(|stage| stage.serves().scale != HOME);
        if let Some(stage) = away.filter(|stage| comes_home(*stage)) {
            // What stood by comes home: the robot may begin it, told or not.
            stage.other().into_iter().for_each(|next| self.end_before(look, stage, next, out));
        }
        let wanted = away.filter(|stage| !comes_home(*stage) && !self.is_done(look));
        match (wanted, self.standby) {
            (None, Some(standby)) => self.take_away(look, standby, Ending::NotNeeded, out),
            (Some(Stage::Settled { serves }), None) => self.begin_standby(look, serves, out),
            (Some(stage), Some(standby)) => {
                let enough = self.begins_after(look, stage.serves());
                let begins = self.task(look, standby).and_then(|task| task.standby);
                // Who cannot be told goes by the old one.
                if (self.is_outdated(look, standby) || begins < enough) && look.home_is_there() {
                    self.take_away(look, standby, Ending::Outdated, out);
                }
                self.end_before(look, stage, standby, out);
            }
            (_, None) => {}
        }
    }

    /// After how long without contact the robot may begin what stands by for a task that is away; none: that does not end
    /// by itself.
    fn begins_after(&self, look: &Look<'_>, away: Attempt) -> Option<Duration> {
        let part = self.spec(look)?;
        let stop = self.task(look, away)?.view.stop_after?;
        let begin = self.alone_after(look)?.begin;
        Some(match urgent(part.when_cut_off, look.model.patience(self.part?)) {
            Some(_) => begin,
            None => begin.max(stop * 2 + grace(part) + SLACK),
        })
    }

    /// Ends what is away of a robot that cannot be reached and has something that stands by.
    fn end_before(&self, look: &Look<'_>, stage: Stage, standby: Attempt, out: &mut Gathered) {
        let placed = |task: &&TaskSeen| task.view.phase.holds_node();
        let home = &look.scales.views[HOME].link;
        let Some(standby) = self.task(look, standby).filter(placed).filter(|_| !home.up) else {
            return;
        };
        for away in [Some(stage.serves()), stage.other()].into_iter().flatten() {
            let stop = self.task(look, away).and_then(|task| task.view.stop_after);
            let Some(stop) = stop.filter(|_| away.scale != HOME) else { continue };
            // By then it runs at home, if the robot lives.
            let stop = standby.standby.map_or(stop, |begins| begins.min(stop));
            // Who does not know how long it has been silent takes it for long enough.
            let due = if look.scales.home_unheard { look.now } else { after(home.since, stop) };
            if due > look.now {
                out.look_at(due);
            } else if !self.is_gone(look, away) {
                self.take_away(look, away, Ending::RobotAlone, out);
            }
        }
    }

    fn begin_standby(&mut self, look: &Look<'_>, serves: Attempt, out: &mut Gathered) {
        let Some(begin) = self.begins_after(look, serves) else { return };
        if self.refused.is_some() || !look.home_is_there() {
            return;
        }
        let standby = self.new_attempt(look, HOME, ("Standby", "stands by at home"));
        self.standby = Some(standby);
        out.actions.push(Action::Create(NewTask {
            name: self.name_of(standby).to_owned(),
            part: self.status.name.clone(),
            node: look.scales.views[HOME].name.clone(),
            standby: Some(begin),
            stop_after: None,
        }));
    }

    /// Why nothing is kept at home for the part that is away.
    pub(super) fn not_kept(&self, look: &Look<'_>) -> Option<String> {
        let view = &self.task(look, self.standby?)?.view;
        let waits = view.phase == TaskPhase::Pending;
        view.refusal.clone().filter(|_| waits)
    }
}

/// Its next task is at home: that is what stood by.
fn comes_home(stage: Stage) -> bool {
    match stage {
        Stage::Making { next, .. } | Stage::Switching { next, .. } => next.scale == HOME,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_away_has_ended_when_the_robot_begins_it() {
        let seconds = Duration::from_secs;
        let fenced = |patience, grace| Alone::of(patience, grace, CutOff::Fenced);
        let short = fenced(Some(seconds(1)), seconds(2));
        assert_eq!(short, Alone { stop: BEARS, begin: seconds(20) });
        let long = fenced(Some(seconds(65)), seconds(2));
        assert_eq!(long, Alone { stop: Duration::from_millis(27_500), begin: seconds(65) });
        for (patience, grace) in [(None, 0), (Some(seconds(7)), 10), (Some(seconds(400)), 3)] {
            let alone = fenced(patience, seconds(grace));
            assert!(alone.stop * 2 + seconds(grace) + SLACK <= alone.begin, "{alone:?}");
            assert!(alone.begin >= patience.unwrap_or_default());
        }
    }

    #[test]
    fn a_robot_begins_in_time_unless_its_controller_may_only_be_starting_again() {
        let (seconds, grace) = (Duration::from_secs, Duration::from_secs(2));
        let in_time = |patience| Alone::of(patience, grace, CutOff::InTime);
        assert_eq!(in_time(Some(seconds(7))), Alone { stop: BEARS, begin: seconds(7) });
        assert_eq!(in_time(Some(Duration::ZERO)), Alone { stop: BEARS, begin: BEARS });
        assert_eq!(in_time(Some(seconds(65))).begin, seconds(65));
        assert_eq!(in_time(None), Alone::of(None, grace, CutOff::Fenced), "nothing is urgent");
    }
}
