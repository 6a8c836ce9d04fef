//! An application on its scales: parts start, serve and end, links break, the controller decides with the production
//! policy, and the robot acts alone when it is cut off.
//!
//! Time goes in steps of [`STEP`]. In each the link is looked at, what was due happens, and the controller plans when its
//! plan said so or a link changed. The controller stands on the network, behind the robot's link: while that is down it
//! reaches nobody at home, and the robot knows only what it was authorised to do before.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::numbers::Numbers;
use super::trace::Trace;
use crate::offload::migration::{Act, Attempt, Event, Stage};
use crate::offload::model::Model;
use crate::offload::problem::HOME;
use crate::offload::view::{ConnectionView, LinkView, PartView, ScaleView, SignalView, Snapshot};
use crate::offload::{Action, Fallback, plan};

/// Of the simulation's clock.
pub const STEP: Duration = Duration::from_millis(50);

/// How long things take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    /// From the start of an attempt to Ready, anywhere but at home.
    pub start_away: Duration,
    /// The same at home; at most the application's `returnTime`.
    pub start_home: Duration,
    /// To switch the connections.
    pub switch: Duration,
    /// From Stop to Gone.
    pub stop: Duration,
    /// How much earlier than the robot's standby begins, what is cut off ends itself: the difference of two clocks that
    /// both count from the last contact.
    pub margin: Duration,
}

impl Default for Pace {
    fn default() -> Self {
        Pace {
            start_away: Duration::from_millis(800),
            start_home: Duration::from_millis(300),
            switch: Duration::from_millis(50),
            stop: Duration::from_millis(200),
            margin: Duration::from_millis(100),
        }
    }
}

/// What went wrong, and what it cost. Everything but the moves should be 0.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Record {
    /// Moves of parts to other scales.
    pub out: u64,
    /// Returns that a violation forced, by the controller.
    pub returned: u64,
    /// Returns that the robot made alone.
    pub alone: u64,
    /// Moves of a part within T of the one before that no violation forced.
    pub flaps: u64,
    /// Steps in which nothing of a part had lived for longer than a robot that is cut off needs to take over.
    pub lost: u64,
    /// Steps in which more than two attempts of a part were live, or two outside of a window.
    pub twice: u64,
    /// Seconds for which a connection had been below its threshold for longer than it tolerates.
    pub violated: f64,
    /// Σ of what the mapping was worth × seconds (AnyScale, eq. 2), over home.
    pub gained: f64,
}

/// A process, as it is.
#[derive(Debug, Clone, Copy)]
struct Process {
    attempt: Attempt,
    ready_at: Timestamp,
    /// It was told to end.
    gone_at: Option<Timestamp>,
}

#[derive(Debug)]
struct Runner {
    stage: Stage,
    processes: Vec<Process>,
    switched_at: Option<Timestamp>,
    moved_at: Option<Timestamp>,
    uid: u64,
    /// The standing order for when the robot is cut off.
    fallback: Option<Duration>,
    /// Since when nothing of it lives.
    dead_since: Option<Timestamp>,
}

/// The world.
#[derive(Debug)]
pub struct World<'m> {
    model: &'m Model,
    scales: Vec<ScaleView>,
    pace: Pace,
    runners: Vec<Runner>,
    below: Vec<Option<Timestamp>>,
    /// Since when a scale and home have no contact, by scale: both count from the last one, whichever link it is.
    silent: Vec<Option<Timestamp>>,
    look_at: Timestamp,
    /// Of the last plan, over home.
    gain: f64,
    /// What happened.
    pub record: Record,
    now: Timestamp,
}

impl<'m> World<'m> {
    /// Everything at home, links up.
    #[must_use]
    pub fn new(model: &'m Model, scales: Vec<ScaleView>, pace: Pace, now: Timestamp) -> Self {
        let home = Attempt { uid: 0, scale: HOME };
        let process = Process { attempt: home, ready_at: now, gone_at: None };
        let runner = |_| Runner {
            stage: Stage::Settled { serves: home },
            processes: vec![process],
            switched_at: None,
            moved_at: None,
            uid: 0,
            fallback: None,
            dead_since: None,
        };
        World {
            model,
            silent: vec![None; scales.len()],
            scales,
            pace,
            runners: (0..model.parts.len()).map(runner).collect(),
            below: vec![None; model.connections.len()],
            look_at: now,
            gain: 0.0,
            record: Record::default(),
            now,
        }
    }

    /// Where a part serves, and whether it does: it is Ready and its links are up.
    #[must_use]
    pub fn serves(&self, part: usize) -> (usize, bool) {
        let runner = &self.runners[part];
        let serving = runner.stage.serves();
        let process = runner.processes.iter().find(|p| p.attempt == serving);
        let ready = process.is_some_and(|p| p.ready_at <= self.now && p.gone_at.is_none());
        (serving.scale, ready && (serving.scale == HOME || self.reaches(serving.scale)))
    }

    fn reaches(&self, scale: usize) -> bool {
        self.scales[scale].link.up && self.scales[HOME].link.up
    }

    /// One step: what the links carry now, by scale, 0: down.
    pub fn step(&mut self, bandwidths: &[f64]) {
        self.now = later(self.now, STEP);
        for (scale, bandwidth) in self.scales.iter_mut().zip(bandwidths) {
            let up = *bandwidth > 0.0;
            if scale.link.up != up {
                (scale.link.up, scale.link.since) = (up, self.now);
                self.look_at = self.now;
            }
            if up && scale.link.bandwidth != *bandwidth {
                scale.link.bandwidth = *bandwidth;
                self.look_at = self.now;
            }
        }
        for scale in 0..self.scales.len() {
            let since = self.silent[scale].or(Some(self.now));
            self.silent[scale] = if self.reaches(scale) { None } else { since };
        }
        for part in 0..self.runners.len() {
            self.pass_time(part);
            self.act_alone(part);
        }
        self.watch_connections();
        // The controller is on the network: without the robot's link it cannot change anything there.
        if self.look_at <= self.now && self.scales[HOME].link.up {
            self.decide();
        }
        self.take_note();
    }

    /// What was due happens.
    fn pass_time(&mut self, part: usize) {
        let (now, margin) = (self.now, self.pace.margin);
        let patience = self.runners[part].fallback;
        let dead = self.silent.clone();
        let runner = &mut self.runners[part];
        // What has no contact with home ends itself (`onDisconnect: Stop`).
        for process in runner.processes.iter_mut().filter(|p| p.attempt.scale != HOME) {
            let since = dead[process.attempt.scale];
            if let (Some(since), Some(patience)) = (since, patience)
                && later(since, patience.saturating_sub(margin)) <= now
            {
                process.gone_at.get_or_insert(now);
            }
        }
        let gone = |p: &Process| p.gone_at.is_some_and(|at| at <= now);
        let ended: Vec<Attempt> =
            runner.processes.iter().filter(|p| gone(p)).map(|p| p.attempt).collect();
        runner.processes.retain(|p| !gone(p));
        for attempt in ended {
            // Who cannot be reached is not known to have ended; it is when there is contact again.
            if attempt.scale == HOME || dead[attempt.scale].is_none() {
                self.happen(part, Event::Gone(attempt.uid));
            }
        }
        self.follow(part, &dead);
    }

    /// News that a migration waits for.
    fn follow(&mut self, part: usize, dead: &[Option<Timestamp>]) {
        let now = self.now;
        let runner = &self.runners[part];
        if let Some(other) = runner.stage.other()
            && (other.scale == HOME || dead[other.scale].is_none())
            && runner.processes.iter().all(|p| p.attempt != other)
        {
            self.happen(part, Event::Gone(other.uid));
            return;
        }
        match runner.stage {
            Stage::Making { next, .. } => {
                let ready = runner.processes.iter().any(|p| p.attempt == next && p.ready_at <= now);
                let heard = next.scale == HOME || dead[next.scale].is_none();
                if ready && heard {
                    self.happen(part, Event::Ready(next.uid));
                }
            }
            Stage::Switching { next, .. } if runner.switched_at.is_some_and(|at| at <= now) => {
                self.happen(part, Event::Switched(next.uid));
            }
            Stage::Alone { lost, .. } if dead[lost.scale].is_none() => {
                self.happen(part, Event::Contact);
            }
            _ => {}
        }
    }

    /// The robot's own rule, as it was given: asked in every step, so that nothing depends on the moment.
    fn act_alone(&mut self, part: usize) {
        let runner = &self.runners[part];
        if self.knows_its_end(runner) {
            return self.cut_off(part);
        }
        // What serves counts; while that is at home, what is on its way out.
        let serves = runner.stage.serves();
        let away = if serves.scale == HOME { runner.stage.other() } else { Some(serves) };
        let away = away.filter(|a| a.scale != HOME).and_then(|a| self.silent[a.scale]);
        let (Some(since), Some(patience)) = (away, runner.fallback) else { return };
        if later(since, patience) > self.now || matches!(runner.stage, Stage::Alone { .. }) {
            return;
        }
        self.cut_off(part);
    }

    /// What serves has ended by itself without contact, and there is contact again.
    fn knows_its_end(&self, runner: &Runner) -> bool {
        let serves = runner.stage.serves();
        serves.scale != HOME
            && self.reaches(serves.scale)
            && runner.processes.iter().all(|p| p.attempt != serves)
    }

    fn cut_off(&mut self, part: usize) {
        let before = self.runners[part].stage;
        let standby = Attempt { uid: self.runners[part].uid + 1, scale: HOME };
        self.happen(part, Event::CutOff { standby });
        if self.runners[part].stage == before {
            return;
        }
        self.runners[part].uid += 1;
        if before.serves().scale != HOME {
            self.record.alone += 1;
            self.runners[part].moved_at = Some(self.now);
        }
    }

    fn happen(&mut self, part: usize, event: Event) {
        let step = self.runners[part].stage.on(event);
        self.runners[part].stage = step.stage;
        let (now, pace) = (self.now, self.pace);
        let runner = &mut self.runners[part];
        for act in step.acts {
            match act {
                Act::Start(attempt) => {
                    let takes =
                        if attempt.scale == HOME { pace.start_home } else { pace.start_away };
                    let ready_at = later(now, takes);
                    runner.processes.push(Process { attempt, ready_at, gone_at: None });
                }
                Act::Connect(_) => runner.switched_at = Some(later(now, pace.switch)),
                Act::Stop(attempt) => {
                    for process in runner.processes.iter_mut().filter(|p| p.attempt == attempt) {
                        process.gone_at.get_or_insert_with(|| later(now, pace.stop));
                    }
                }
            }
        }
    }

    fn watch_connections(&mut self) {
        for (i, connection) in self.model.connections.iter().enumerate() {
            let ends = [connection.from, connection.to].map(|part| self.serves(part));
            let crossing = ends[0].0 != ends[1].0;
            let flows = ends.iter().all(|(_, serves)| *serves);
            let bad =
                connection.min_hz.is_some() && !flows && (crossing || self.below[i].is_some());
            self.below[i] = if bad { self.below[i].or(Some(self.now)) } else { None };
        }
    }

    fn decide(&mut self) {
        let parts: Vec<PartView> = self.runners.iter().map(part_view).collect();
        let connections: Vec<ConnectionView> =
            self.below.iter().map(|since| ConnectionView { below_since: *since }).collect();
        let signals = vec![SignalView::default(); self.model.signals.len()];
        let snapshot = Snapshot {
            model: self.model,
            scales: &self.scales,
            parts: &parts,
            connections: &connections,
            signals: &signals,
        };
        let plan = plan(&snapshot, self.now);
        self.look_at = plan.look_again;
        self.gain = plan.value - plan.home_value;
        for action in &plan.actions {
            self.carry_out(action);
        }
        for Fallback { part, after } in &plan.fallback {
            self.runners[*part].fallback = Some(*after);
        }
    }

    fn carry_out(&mut self, action: &Action) {
        let (part, now) = (action.part, self.now);
        let runner = &mut self.runners[part];
        if runner.stage.is_window() && action.to == HOME && runner.stage.serves().scale == HOME {
            return self.happen(part, Event::Abort);
        }
        let next = Attempt { uid: runner.uid + 1, scale: action.to };
        let before = runner.stage;
        let soon = runner.moved_at.is_some_and(|at| later(at, self.model.cooldown) > now);
        self.happen(part, Event::Go(next));
        if self.runners[part].stage == before {
            return;
        }
        let record = &mut self.record;
        record.flaps += u64::from(soon && action.forced.is_none());
        record.out += u64::from(action.to != HOME);
        record.returned += u64::from(action.forced.is_some());
        self.runners[part].uid += 1;
        self.runners[part].moved_at = Some(now);
    }

    fn take_note(&mut self) {
        let seconds = STEP.as_secs_f64();
        let takes_over = self.pace.margin + STEP + STEP;
        for runner in &mut self.runners {
            let live = runner.processes.len();
            runner.dead_since = if live > 0 { None } else { runner.dead_since.or(Some(self.now)) };
            let lost = runner.dead_since.is_some_and(|since| later(since, takes_over) < self.now);
            self.record.lost += u64::from(lost);
            self.record.twice += u64::from(live > 2 || (live > 1 && !runner.stage.is_window()));
        }
        for (connection, since) in self.model.connections.iter().zip(&self.below) {
            if since.is_some_and(|since| later(since, connection.tolerance) < self.now) {
                self.record.violated += seconds;
            }
        }
        self.record.gained += self.gain * seconds;
    }
}

fn part_view(runner: &Runner) -> PartView {
    PartView {
        scale: runner.stage.serves().scale,
        moving: !matches!(runner.stage, Stage::Settled { .. }),
        moved_at: runner.moved_at,
        active: true,
        ..PartView::default()
    }
}

/// Runs an application on home and two scales for `seconds` over links that come and go ([`Trace::restless`]).
#[must_use]
pub fn restless(model: &Model, seconds: f64, seed: u64) -> Record {
    let mut numbers = Numbers::new(seed);
    let now = Timestamp::UNIX_EPOCH;
    let scales = vec![roomy("home", 1.0, now), roomy("near", 3.5, now), roomy("far", 2.5, now)];
    let traces: Vec<Trace> =
        scales.iter().map(|_| Trace::restless(&mut numbers, seconds)).collect();
    let mut world = World::new(model, scales, Pace::default(), now);
    let mut at = 0.0;
    while at < seconds {
        let carries: Vec<f64> = traces.iter().map(|trace| trace.at(at)).collect();
        world.step(&carries);
        at += STEP.as_secs_f64();
    }
    world.record
}

/// A scale with room for everything.
#[must_use]
pub fn roomy(name: &str, gain: f64, now: Timestamp) -> ScaleView {
    ScaleView {
        name: name.to_owned(),
        gain,
        cpu: 16.0,
        memory: 64e9,
        unfit: None,
        link: LinkView { up: true, since: now, bandwidth: 54e6, latency: 0.002 },
    }
}

fn later(when: Timestamp, span: Duration) -> Timestamp {
    when.checked_add(SignedDuration::try_from(span).unwrap_or_default()).unwrap_or(when)
}
