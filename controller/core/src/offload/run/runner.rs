//! One part: which of its tasks serves, what becomes of the others, and how a move goes on.

use std::collections::BTreeMap;
use std::time::Duration;

use muster_api::kind::application::{
    ApplicationSpec, AttemptStatus, MoveStage, Part, PartStatus, Runs, stamp, task_name,
};
use muster_api::phase::TaskPhase;
use muster_api::quantity::MilliCpu;

use super::view::TaskSeen;
use super::{Abort, Action, Ending, Gathered, Look, NewTask, News, only_home};
use crate::offload::migration::{Act, Attempt, Event, Stage};
use crate::offload::problem::HOME;
use crate::offload::view::PartView;
use crate::schedule::filter::unsuited;
use crate::taskset::after;
use crate::taskset::health::{Fault, Health, fault, health};
use crate::taskset::places::REPLACE_ENDED_AFTER;

/// How long the next task has to become Ready before the move is given up: an image may have to be pulled. The task before
/// serves meanwhile, so nothing but the gain is lost.
const MAKE_WITHIN: Duration = Duration::from_secs(300);
/// How long the next task must have run on another scale before it serves: a program that cannot run there mostly ends at
/// once. One that comes home is needed there.
const MIN_READY_AWAY: Duration = Duration::from_secs(1);

/// Mean uses of cpu that differ by less are the same: cores, and a share.
const LEARNED_STEP: (f64, f64) = (0.005, 0.05);

/// Why a part without a task gets one.
const BEGUN: (&str, &str) = ("Begun", "it had no task");

/// One part.
#[derive(Debug)]
pub(super) struct Runner {
    /// Its place in the spec; none: it is not in it any more.
    pub(super) part: Option<usize>,
    /// What was written last, and is changed here.
    pub(super) status: PartStatus,
    /// None: it has no task.
    pub(super) stage: Option<Stage>,
    /// Why its task was refused; it is begun when that is over.
    pub(super) refused: Option<String>,
    /// The part has come to another scale in this look.
    pub(super) moved: bool,
    /// The task that stands by at home.
    pub(super) standby: Option<Attempt>,
    attempts: BTreeMap<u64, AttemptStatus>,
}

/// The parts of the spec in their order, then those that still have tasks and are not in it any more.
pub(super) fn all(look: &Look<'_>) -> Vec<Runner> {
    let (spec, before) = (look.snapshot.spec, look.snapshot.status);
    let of_spec = spec.parts.iter().enumerate().map(|(i, part)| {
        let named = || PartStatus { name: part.name.clone(), ..PartStatus::default() };
        Runner::of(look, Some(i), before.part(&part.name).cloned().unwrap_or_else(named))
    });
    let gone = before.parts.iter().filter(|part| spec.part(&part.name).is_none());
    of_spec.chain(gone.map(|part| Runner::of(look, None, part.clone()))).collect()
}

impl Runner {
    fn of(look: &Look<'_>, part: Option<usize>, mut status: PartStatus) -> Self {
        let mut attempts = BTreeMap::new();
        for attempt in status.tasks() {
            let uid = look.task(&attempt.name).map(|task| task.uid.clone()).unwrap_or_default();
            attempts.insert(attempt.number, AttemptStatus { uid, ..attempt.clone() });
        }
        let stage = stage_of(look, &status);
        let standby = status.standby.as_ref().map(|a| Attempt { uid: a.number, scale: HOME });
        let refused = look.refusal(&status);
        (status.task, status.other, status.also, status.standby) = (None, None, None, None);
        Runner { part, status, stage, refused, moved: false, standby, attempts }
    }

    pub(super) fn spec<'s>(&self, look: &Look<'s>) -> Option<&'s Part> {
        let spec: &'s ApplicationSpec = look.snapshot.spec;
        self.part.map(|part| &spec.parts[part])
    }

    pub(super) fn name_of(&self, attempt: Attempt) -> &str {
        self.attempts.get(&attempt.uid).map_or("", |a| a.name.as_str())
    }

    pub(super) fn task<'l>(&self, look: &'l Look<'_>, attempt: Attempt) -> Option<&'l TaskSeen> {
        look.task(self.name_of(attempt))
    }

    /// The task that serves.
    pub(super) fn serving<'l>(&self, look: &'l Look<'_>) -> Option<&'l TaskSeen> {
        self.stage.and_then(|stage| self.task(look, stage.serves()))
    }

    /// It has done what it had to, and is not begun again.
    pub(super) fn is_done(&self, look: &Look<'_>) -> bool {
        let runs = self.spec(look).map_or(Runs::Always, |part| part.runs);
        let ended = self.serving(look).is_some_and(|t| t.view.phase == TaskPhase::Succeeded);
        ended && runs != Runs::Always
    }

    /// Its task runs and is Ready, and nobody ends it.
    pub(super) fn serves(&self, look: &Look<'_>) -> bool {
        let task = self.serving(look);
        task.is_some_and(|t| {
            !t.view.ending && health(&t.view, Duration::ZERO, look.now) == Health::Available
        })
    }

    /// Remembers the mean use of cpu of what serves, when that is another than was known.
    fn learn(&mut self, look: &Look<'_>) {
        let Some(stage) = self.stage else { return };
        let Some(used) = self.task(look, stage.serves()).and_then(|task| task.used) else { return };
        let scale = &look.scales.views[stage.serves().scale].name;
        let known = self.status.learned.get(scale).map(|cpu| cpu.cores());
        if known.is_none_or(|known| (used - known).abs() > LEARNED_STEP.0 + LEARNED_STEP.1 * known)
        {
            let millis = MilliCpu((used * 1000.0).round().max(0.0) as u64);
            self.status.learned.insert(scale.clone(), millis);
        }
    }

    /// Takes in what became of its tasks, and does what follows for this part by itself.
    pub(super) fn follow(&mut self, look: &Look<'_>, out: &mut Gathered) {
        self.learn(look);
        self.take_in_standby(look, out);
        self.take_in_ends(look, out);
        let Some(part) = self.spec(look) else { return self.leave(look, out) };
        match self.stage {
            None => self.begin(look, out),
            Some(Stage::Making { serves, next }) => self.make(look, (serves, next), out),
            Some(Stage::Switching { serves, next }) => self.switch(look, (serves, next), out),
            Some(Stage::Settled { .. }) => self.renew(look, part, out),
            Some(Stage::Breaking { .. } | Stage::Aborting { .. } | Stage::Alone { .. }) => {}
        }
        self.end_others(look, out);
        self.stand_by(look, out);
    }

    pub(super) fn is_gone(&self, look: &Look<'_>, attempt: Attempt) -> bool {
        self.task(look, attempt).is_none_or(|task| task.view.phase.is_terminal())
    }

    /// Tasks that have ended, and what serves then.
    fn take_in_ends(&mut self, look: &Look<'_>, out: &mut Gathered) {
        let Some(stage) = self.stage else { return };
        let also = match stage {
            Stage::Alone { also, .. } => also,
            _ => None,
        };
        for attempt in stage.other().into_iter().chain(also) {
            if !self.is_gone(look, attempt) {
                continue;
            }
            let next = matches!(stage, Stage::Making { .. } | Stage::Switching { .. });
            let failed = self.task(look, attempt).map(|task| task.view.message.clone());
            self.take_away(look, attempt, Ending::Over, out);
            if next {
                let message = failed.unwrap_or_default();
                self.give_up(look, attempt, Abort::Failed(Fault::Crashed { message }), out);
            }
            self.happen(look, Event::Gone(attempt.uid), out);
        }
        self.take_in_end_of_serving(look, out);
    }

    fn take_in_end_of_serving(&mut self, look: &Look<'_>, out: &mut Gathered) {
        let Some(stage) = self.stage else { return };
        let serves = stage.serves();
        if self.is_done(look) || !self.is_gone(look, serves) {
            return;
        }
        if matches!(stage, Stage::Making { .. } | Stage::Switching { .. }) {
            self.take_away(look, serves, Ending::Over, out);
            return self.happen(look, Event::Gone(serves.uid), out);
        }
        let Some(task) = self.task(look, serves) else {
            // Its object is gone.
            return self.begin_in_its_place(look, out);
        };
        if serves.scale != HOME && matches!(stage, Stage::Settled { .. }) && self.part.is_some() {
            let why = format!("its task has ended there: {}", task.view.message);
            return self.go(look, HOME, ("Ended", &why), out);
        }
        // By the controller's clock it cannot have ended later than now.
        let ended = task.view.finished.unwrap_or(task.view.created).min(look.now);
        let due = after(ended, REPLACE_ENDED_AFTER);
        if due > look.now {
            out.look_at(due);
        } else {
            self.take_away(look, serves, Ending::Over, out);
        }
    }

    fn begin_in_its_place(&mut self, look: &Look<'_>, out: &mut Gathered) {
        match self.stage {
            Some(Stage::Settled { .. }) | None => self.stage = None,
            Some(_) if self.part.is_some() && self.can_begin() => {
                let again = self.at_home(look, BEGUN);
                self.happen(look, Event::Lost { again }, out);
            }
            Some(_) => {}
        }
    }

    /// The object of a task that has ended, or the end of one that is to.
    pub(super) fn take_away(
        &self,
        look: &Look<'_>,
        attempt: Attempt,
        why: Ending,
        out: &mut Gathered,
    ) {
        if self.task(look, attempt).is_some_and(|task| !task.view.ending) {
            out.delete(self.name_of(attempt), why);
        }
    }

    /// Ends what is left of a part that is not in the spec any more.
    fn leave(&mut self, look: &Look<'_>, out: &mut Gathered) {
        let all = [self.stage.map(Stage::serves), self.stage.and_then(Stage::other), self.standby];
        for attempt in all.into_iter().flatten() {
            if !self.is_held(look, attempt) {
                self.take_away(look, attempt, Ending::NoSuchPart, out);
            }
        }
    }

    /// The part's template is another than the task was made of.
    pub(super) fn is_outdated(&self, look: &Look<'_>, attempt: Attempt) -> bool {
        let template = self.spec(look).map(|part| part.template.digest());
        self.attempts.get(&attempt.uid).map(|a| &a.template) != template.as_ref()
    }

    /// Why a task was begun.
    pub(super) fn explain(&mut self, attempt: Attempt, (reason, why): (&str, &str)) {
        if let Some(attempt) = self.attempts.get_mut(&attempt.uid) {
            (attempt.reason, attempt.message) = (reason.to_owned(), why.to_owned());
        }
    }

    /// A mission lock keeps what runs on its node as it is.
    fn is_held(&self, look: &Look<'_>, attempt: Attempt) -> bool {
        let node = self.task(look, attempt).and_then(|task| task.view.node.as_deref());
        node.and_then(|node| look.node(node)).is_some_and(|node| node.view.lock.is_some())
    }

    fn begin(&mut self, look: &Look<'_>, out: &mut Gathered) {
        if !self.can_begin() {
            return;
        }
        let serves = self.at_home(look, BEGUN);
        self.stage = Some(Stage::Settled { serves });
        self.act(look, &[Act::Start(serves)], out);
        let (task, node) = (self.name_of(serves).to_owned(), look.scales.views[HOME].name.clone());
        self.moved = self.status.scale.as_ref().is_some_and(|before| *before != node);
        if self.moved {
            self.status.moved_at = Some(stamp(look.now));
        }
        out.news.push(News::Begun { task, node });
    }

    /// There is a task for it at home, or a new one is not refused.
    fn can_begin(&self) -> bool {
        self.standby.is_some() || self.refused.is_none()
    }

    /// A task at home: the one that stands by, or a new one.
    fn at_home(&mut self, look: &Look<'_>, (reason, why): (&str, &str)) -> Attempt {
        let lives = |task: &TaskSeen| !task.view.ending && !task.view.phase.is_terminal();
        let stands_by = |standby: &mut Attempt| {
            self.attempts.get(&standby.uid).is_none_or(|a| look.task(&a.name).is_none_or(lives))
        };
        let Some(standby) = self.standby.take_if(stands_by) else {
            return self.new_attempt(look, HOME, (reason, why));
        };
        self.explain(standby, (reason, why));
        standby
    }

    /// The next task: it serves when it is Ready, and is given up when it cannot be.
    fn make(&mut self, look: &Look<'_>, (serves, next): (Attempt, Attempt), out: &mut Gathered) {
        let Some(task) = self.task(look, next) else { return };
        let ready = if next.scale == HOME { Duration::ZERO } else { MIN_READY_AWAY };
        let may_leave = next.scale == HOME || look.home_is_there();
        match health(&task.view, ready, look.now) {
            Health::Available if may_leave && !task.view.ending => {
                return self.happen(look, Event::Ready(next.uid), out);
            }
            Health::Ready { available_at } => out.look_at(available_at),
            Health::Available | Health::NotReady => {}
        }
        if let Some(why) = self.hopeless(look, next, task)
            && !self.is_gone(look, serves)
        {
            self.give_up(look, next, why, out);
            self.happen(look, Event::Abort, out);
        }
    }

    /// That the next task serves was written down with the stage; the one before may go, unless the next one is worse by now.
    fn switch(&mut self, look: &Look<'_>, (serves, next): (Attempt, Attempt), out: &mut Gathered) {
        let ready = |task: &TaskSeen| health(&task.view, Duration::ZERO, look.now);
        let worse = self.task(look, next).filter(|t| t.view.ending || ready(t) == Health::NotReady);
        let worse =
            worse.map(|task| Abort::Failed(Fault::Crashed { message: task.view.message.clone() }));
        match worse.or_else(|| self.left_alone(look, next)) {
            Some(why) if !self.is_gone(look, serves) => {
                self.give_up(look, next, why, out);
                self.happen(look, Event::Abort, out);
            }
            _ => self.happen(look, Event::Switched(next.uid), out),
        }
    }

    /// Why the next task is given up. One that comes home is not: there is nowhere else.
    fn hopeless(&self, look: &Look<'_>, next: Attempt, task: &TaskSeen) -> Option<Abort> {
        if next.scale == HOME {
            return None;
        }
        let scale = &look.scales.views[next.scale];
        if only_home(look.snapshot.spec) {
            return Some(Abort::Unwanted);
        }
        if let Some(why) = self.left_alone(look, next) {
            return Some(why);
        }
        if let Some(why) = scale.unfit.clone() {
            return Some(Abort::Scale { why });
        }
        if !scale.link.up {
            return Some(Abort::Scale { why: "it is not heard".to_owned() });
        }
        let cooldown = look.snapshot.spec.cooldown.as_duration();
        if task.view.phase == TaskPhase::Pending && after(task.view.created, cooldown) <= look.now {
            let why = task.view.refusal.clone().unwrap_or_else(|| task.view.message.clone());
            return Some(Abort::NoRoom { why });
        }
        let node = look.node(&scale.name).map(|node| &node.view);
        fault(&task.view, node, MAKE_WITHIN, look.now).map(Abort::Failed)
    }

    /// Nothing leaves a robot that cannot be reached: what is there could not be told to end, and nothing would stand by.
    fn left_alone(&self, look: &Look<'_>, next: Attempt) -> Option<Abort> {
        let alone = next.scale != HOME && !look.home_is_there();
        alone.then(|| Abort::Scale { why: "its robot is not heard".to_owned() })
    }

    fn give_up(&mut self, look: &Look<'_>, next: Attempt, why: Abort, out: &mut Gathered) {
        self.status.moved_at = Some(stamp(look.now));
        let (part, to) = (self.status.name.clone(), look.scales.views[next.scale].name.clone());
        out.news.push(News::Aborted { part, to, why });
    }

    /// What is wrong with a settled part for itself: somebody ends its task, it may not be away any more, or its template
    /// has changed.
    fn renew(&mut self, look: &Look<'_>, part: &Part, out: &mut Gathered) {
        let Some(Stage::Settled { serves }) = self.stage else { return };
        let Some(task) = self.task(look, serves).filter(|_| !self.is_done(look)) else { return };
        let away = serves.scale != HOME;
        if task.view.ending {
            if away {
                self.go(look, HOME, ("Ended", "its task there is being ended"), out);
            }
            return;
        }
        let node = look.node(&look.scales.views[serves.scale].name).map(|node| &node.view);
        if let Some(fault) = fault(&task.view, node, MAKE_WITHIN, look.now)
            && away
            && !self.serves(look)
        {
            let why = format!("its task there {fault}");
            return self.go(look, HOME, (fault.reason(), &why), out);
        }
        let pins = muster_api::kind::application::pin::pins(look.snapshot.spec, part);
        if let Some(pin) = pins.first().filter(|_| away) {
            let why = format!("it stays at home: {pin}");
            return self.go(look, HOME, (pin.reason(), &why), out);
        }
        if self.is_outdated(look, serves)
            && task.view.phase != TaskPhase::Unknown
            && !self.is_held(look, serves)
        {
            self.take_away(look, serves, Ending::Outdated, out);
        }
    }

    /// Tells those to end that are to be gone, until they are.
    fn end_others(&self, look: &Look<'_>, out: &mut Gathered) {
        let scale = |attempt: Attempt| look.scales.views[attempt.scale].name.clone();
        match self.stage {
            Some(Stage::Breaking { serves, old }) => {
                self.take_away(look, old, Ending::Moved { to: scale(serves) }, out);
            }
            Some(Stage::Aborting { next, .. }) => {
                self.take_away(look, next, Ending::Aborted, out);
            }
            Some(Stage::Alone { serves, lost, also }) => {
                for attempt in [Some(lost), also].into_iter().flatten() {
                    self.take_away(look, attempt, Ending::Moved { to: scale(serves) }, out);
                }
            }
            Some(Stage::Settled { .. } | Stage::Making { .. } | Stage::Switching { .. }) | None => {
            }
        }
    }

    /// What the decision about all parts wants of this one.
    pub(super) fn carry_out(
        &mut self,
        look: &Look<'_>,
        decided: &crate::offload::Plan,
        action: &crate::offload::Action,
        out: &mut Gathered,
    ) {
        let stand = &decided.parts[action.part].stand;
        debug_assert!(
            look.model.parts[action.part].may_move(),
            "only those that may move are decided"
        );
        match self.stage {
            Some(Stage::Settled { .. }) => {
                self.go(look, action.to, (stand.reason(), &stand.to_string()), out);
            }
            Some(Stage::Making { next, .. } | Stage::Switching { next, .. })
                if action.to == HOME && next.scale != HOME =>
            {
                self.give_up(look, next, Abort::Unwanted, out);
                self.happen(look, Event::Abort, out);
                self.end_others(look, out);
            }
            _ => {}
        }
    }

    /// Begins a move.
    fn go(&mut self, look: &Look<'_>, to: usize, (reason, why): (&str, &str), out: &mut Gathered) {
        let Some(Stage::Settled { serves }) = self.stage else { return };
        let refused = if to == HOME { !self.can_begin() } else { self.refused.is_some() };
        if to == serves.scale || refused {
            return;
        }
        let next = match to {
            HOME => self.at_home(look, (reason, why)),
            _ => self.new_attempt(look, to, (reason, why)),
        };
        self.status.moved_at = Some(stamp(look.now));
        let name = |scale: usize| look.scales.views[scale].name.clone();
        let (part, from, to) = (self.status.name.clone(), name(serves.scale), name(to));
        out.news.push(News::Moving { part, from, to, message: why.to_owned() });
        self.happen(look, Event::Go(next), out);
    }

    pub(super) fn new_attempt(
        &mut self,
        look: &Look<'_>,
        scale: usize,
        why: (&str, &str),
    ) -> Attempt {
        let number = look.next_number(&self.status);
        let template = self.spec(look).map(|part| part.template.digest()).unwrap_or_default();
        let attempt = AttemptStatus {
            name: task_name(look.snapshot.name, &self.status.name, number),
            uid: String::new(),
            scale: look.scales.views[scale].name.clone(),
            number,
            template,
            reason: why.0.to_owned(),
            message: why.1.to_owned(),
        };
        self.status.attempts = number;
        self.attempts.insert(number, attempt);
        Attempt { uid: number, scale }
    }

    pub(super) fn happen(&mut self, look: &Look<'_>, event: Event, out: &mut Gathered) {
        let Some(stage) = self.stage else { return };
        let step = stage.on(event);
        self.stage = Some(step.stage);
        self.act(look, &step.acts, out);
        let (before, now) = (stage.serves(), step.stage.serves());
        if before.scale != now.scale {
            self.moved = true;
            self.status.moved_at = Some(stamp(look.now));
            let message = self.attempts.get(&now.uid).map(|a| a.message.clone());
            out.news.push(News::Moved {
                part: self.status.name.clone(),
                to: look.scales.views[now.scale].name.clone(),
                message: message.unwrap_or_default(),
            });
        }
    }

    /// Connections are with whom the status says; ends are ordered as long as they are wanted: [`Self::end_others`].
    fn act(&self, look: &Look<'_>, acts: &[Act], out: &mut Gathered) {
        for act in acts {
            let Act::Start(attempt) = act else { continue };
            let task = self.name_of(*attempt).to_owned();
            if look.task(&task).is_some() {
                out.actions.push(Action::Release { task });
                continue;
            }
            // One that was to stand by from this look on.
            if let Some(new) = out.new_task(&task) {
                new.standby = None;
                continue;
            }
            let away = attempt.scale != HOME;
            out.actions.push(Action::Create(NewTask {
                name: task,
                part: self.status.name.clone(),
                node: look.scales.views[attempt.scale].name.clone(),
                standby: None,
                stop_after: self.alone_after(look).filter(|_| away).map(|alone| alone.stop),
            }));
        }
    }

    /// The part as a decision about all of them sees it.
    pub(super) fn view(&self, look: &Look<'_>) -> PartView {
        let part = self.spec(look).expect("decisions are about parts of the spec");
        let serves = self.serves(look);
        let settled = matches!(self.stage, Some(Stage::Settled { .. }));
        // What does not serve yet is not moved about; one that is out of reach may have to come home.
        let away = self.stage.is_some_and(|stage| stage.serves().scale != HOME);
        let learned = |name: &str| self.status.learned.get(name).map(|cpu| cpu.cores());
        let barred = |name: &str| {
            let facts = &look.node(name)?.view.facts;
            unsuited(name, facts, &part.template.spec).map(|refusal| refusal.to_string())
        };
        let names = || look.scales.views.iter().map(|view| view.name.as_str());
        PartView {
            scale: self.stage.map_or(HOME, |stage| stage.serves().scale),
            moving: !settled || !(serves || away),
            moved_at: self.status.moved_at.as_ref().map(|at| at.0),
            active: part.runs == Runs::Always || serves,
            learned: names().map(learned).collect(),
            barred: names().map(barred).collect(),
        }
    }

    /// The part's status, its tasks in it; none: nothing of it is left.
    pub(super) fn into_status(mut self, look: &Look<'_>) -> Option<PartStatus> {
        if self.part.is_none() && self.stage.is_none() && self.standby.is_none() {
            return None;
        }
        let attempt = |a: Attempt| self.attempts.get(&a.uid).cloned();
        self.status.stage = self.stage.map(stage_word);
        self.status.task = self.stage.and_then(|stage| attempt(stage.serves()));
        self.status.other = self.stage.and_then(Stage::other).and_then(attempt);
        self.status.also = match self.stage {
            Some(Stage::Alone { also, .. }) => also.and_then(attempt),
            _ => None,
        };
        self.status.standby = self.standby.and_then(attempt);
        let serves = self.stage.map(Stage::serves);
        self.status.scale = serves.map(|s| look.scales.views[s.scale].name.clone());
        Some(self.status)
    }
}

fn stage_of(look: &Look<'_>, status: &PartStatus) -> Option<Stage> {
    let attempt =
        |a: &AttemptStatus| Some(Attempt { uid: a.number, scale: look.scales.index(&a.scale)? });
    let serves = status.task.as_ref().and_then(attempt)?;
    let other = status.other.as_ref().and_then(attempt);
    let also = status.also.as_ref().and_then(attempt);
    Some(match (status.stage.unwrap_or_default(), other) {
        (MoveStage::Making, Some(next)) => Stage::Making { serves, next },
        (MoveStage::Switching, Some(next)) => Stage::Switching { serves, next },
        (MoveStage::Breaking, Some(old)) => Stage::Breaking { serves, old },
        (MoveStage::Aborting, Some(next)) => Stage::Aborting { serves, next },
        (MoveStage::Alone, Some(lost)) => Stage::Alone { serves, lost, also },
        (_, None) | (MoveStage::Settled, Some(_)) => Stage::Settled { serves },
    })
}

fn stage_word(stage: Stage) -> MoveStage {
    match stage {
        Stage::Settled { .. } => MoveStage::Settled,
        Stage::Making { .. } => MoveStage::Making,
        Stage::Switching { .. } => MoveStage::Switching,
        Stage::Breaking { .. } => MoveStage::Breaking,
        Stage::Aborting { .. } => MoveStage::Aborting,
        Stage::Alone { .. } => MoveStage::Alone,
    }
}
