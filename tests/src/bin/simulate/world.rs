//! Everything together: one controller, its disk, machines with agents, frameworks, the network, the people; and the world's time, in
//! milliseconds. Nothing here happens but by [`World::run_to`] and the actions.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use muster_api::id::TaskUid;
use muster_api::kind::node::NodeKind;
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_controller::store::memory::Disk;

use crate::action::Tally;
use crate::agenda::{Agenda, Due};
use crate::agent::{Agent, Hands, What};
use crate::applications::Told;
use crate::controller::{Controller, House, Member, Said, Skew};
use crate::dice::{self, Dice};
use crate::framework::{Deed, Framework};
use crate::invariant::{Invariant, Violation};
use crate::log::Log;
use crate::mutation::Mutation;
use crate::net::{Conn, Down, Net, Up};
use crate::truth::{Room, Truth};
use crate::users::Users;
use crate::view::View;

/// Turns of the world without any time passing, after which somebody runs in circles.
const IN_CIRCLES: u32 = 20_000;
/// How long each framework may be away, milliseconds.
const PATIENCE: [u64; 2] = [12_000, 40_000];

/// Which machines have a gate: of the robots one has none.
const GATED: [bool; 4] = [true, true, false, false];

/// What there is in a run beside tasks and frameworks: not everything in each, which makes all of them slow.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cast {
    pub(crate) sets: bool,
    pub(crate) applications: bool,
}

/// One run of so many has sets, and another one an application.
const SHARE: u64 = 12;

impl Cast {
    /// A planted fault has what it is planted in.
    fn of(seed: u64, mutation: Option<Mutation>) -> Cast {
        let share = seed % SHARE;
        Cast {
            sets: share == 0 || mutation == Some(Mutation::HastyRollout),
            applications: share == SHARE / 2 || mutation == Some(Mutation::HastyStandby),
        }
    }
}

/// The world.
pub(crate) struct World {
    pub(crate) now: u64,
    pub(crate) seed: u64,
    pub(crate) dice: Dice,
    pub(crate) agenda: Agenda,
    pub(crate) net: Net,
    pub(crate) house: House,
    pub(crate) controller: Option<Controller>,
    /// Since when the controller answers; none: it does not.
    pub(crate) up_since: Option<u64>,
    pub(crate) agents: Vec<Agent>,
    pub(crate) frameworks: Vec<Framework>,
    pub(crate) truth: Truth,
    pub(crate) users: Users,
    pub(crate) view: View,
    pub(crate) log: Log,
    pub(crate) broken: Option<Violation>,
    pub(crate) mutation: Option<Mutation>,
    pub(crate) cast: Cast,
    pub(crate) tally: Tally,
    /// How far the holders of robots have counted what they handed on.
    pub(crate) handed_on: BTreeMap<TaskUid, u32>,
    /// When a commit was last made to fail.
    pub(crate) failed_at: u64,
}

impl World {
    /// A cluster that is just being started: three robots, a server, and two frameworks.
    pub(crate) fn new(seed: u64, mutation: Option<Mutation>, dir: &Path, aloud: bool) -> World {
        let machines = [
            ("r1", NodeKind::Robot, 1000),
            ("r2", NodeKind::Robot, 1000),
            ("r3", NodeKind::Robot, 600),
            ("c1", NodeKind::Cloud, 1500),
        ];
        let member = |(name, kind, _): &(&str, NodeKind, u64)| Member {
            name: NodeName::new(*name).expect("a name"),
            kind: *kind,
            key: format!("key of {name}"),
        };
        let members: Vec<Member> = machines.iter().map(member).collect();
        let room = |cpu| Room { cpu, memory: 512 << 20 };
        let rooms: Vec<Room> = machines.iter().map(|(_, _, cpu)| room(*cpu)).collect();
        let names = members.iter().map(|member| member.name.to_string()).collect();
        let agents = members.iter().zip(&rooms).enumerate();
        let agents = agents
            .map(|(index, (member, room))| Agent::new(index, member.clone(), *room, GATED[index]));
        let frameworks = PATIENCE.iter().enumerate().map(|(number, patience)| {
            Framework::new(machines.len() + number, &format!("f{}", number + 1), *patience)
        });
        let disk = Disk::default();
        if mutation == Some(Mutation::LostWrite) {
            disk.sync_every(8);
        }
        let mut world = World {
            now: 0,
            seed,
            dice: dice::of(seed, 0),
            agenda: Agenda::default(),
            net: Net::new(machines.len() + PATIENCE.len()),
            frameworks: frameworks.collect(),
            agents: agents.collect(),
            house: House { disk, skew: Skew::default(), dir: dir.to_owned(), members },
            controller: None,
            up_since: None,
            truth: Truth::new(rooms, names, GATED.to_vec()),
            users: Users::default(),
            view: View::default(),
            log: Log::new(aloud),
            broken: None,
            mutation,
            cast: Cast::of(seed, mutation),
            tally: Tally::default(),
            handed_on: BTreeMap::new(),
            failed_at: 0,
        };
        world.agenda.at(0, Due::Controller);
        for index in 0..world.agents.len() {
            world.agenda.at(1, Due::Machine(index, What::Begin));
        }
        for framework in &world.frameworks {
            world.agenda.at(500, Due::Framework(framework.end, Deed::Begin));
        }
        world
    }

    /// What a machine does, with what it may use of the world.
    pub(crate) fn with_agent<T>(
        &mut self,
        index: usize,
        act: impl FnOnce(&mut Agent, &mut Hands<'_>) -> T,
    ) -> T {
        let World { now, dice, agenda, net, truth, log, broken, mutation, .. } = self;
        let mut hands =
            Hands { now: *now, dice, agenda, net, truth, log, broken, mutation: *mutation };
        act(&mut self.agents[index], &mut hands)
    }

    /// What a framework does, with what it may use of the world.
    pub(crate) fn with_framework<T>(
        &mut self,
        end: usize,
        act: impl FnOnce(&mut Framework, &mut Hands<'_>) -> T,
    ) -> T {
        let index = end - self.agents.len();
        let World { now, dice, agenda, net, truth, log, broken, mutation, .. } = self;
        let mut hands =
            Hands { now: *now, dice, agenda, net, truth, log, broken, mutation: *mutation };
        act(&mut self.frameworks[index], &mut hands)
    }

    /// Lets everything work until then, or until an invariant is broken.
    pub(crate) fn run_to(&mut self, until: u64) {
        let mut turns = 0;
        while self.broken.is_none() {
            let next = self.agenda.first().map_or(until, |at| at.min(until)).max(self.now);
            let before = self.now;
            if next > self.now {
                self.now = self.work_until(next);
            }
            turns = if self.now > before { 0 } else { turns + 1 };
            if turns > IN_CIRCLES {
                let how = "something runs in circles".to_owned();
                self.break_with(Invariant::EverythingEndsOrExplainsItself.broken(how));
            }
            if self.now < next {
                continue;
            }
            match self.agenda.pop(self.now) {
                Some(due) => self.happens(due),
                None if self.now >= until => return,
                None => {}
            }
        }
    }

    /// Lets the controller work until then or until it says something; gives the time.
    fn work_until(&mut self, next: u64) -> u64 {
        let Some(controller) = &mut self.controller else { return next };
        let reached = controller.run_until(next).min(next);
        let said = controller.take();
        self.now = reached;
        for said in said {
            self.controller_says(said);
        }
        reached
    }

    pub(crate) fn break_with(&mut self, violation: Violation) {
        self.log.say(self.now, format_args!("BROKEN {violation}"));
        self.broken.get_or_insert(violation);
    }

    fn happens(&mut self, due: Due) {
        match due {
            Due::Up(conn) => {
                if let Some(what) = self.net.arrives_up(conn) {
                    self.reaches_controller(conn, what);
                }
            }
            Due::Down(conn) => {
                let node = self.net.node_of(conn);
                let what = self.net.arrives_down(conn);
                if let (Some(node), Some(what)) = (node, what) {
                    if matches!(what, Down::End) {
                        self.net.forget(conn);
                    }
                    if node < self.agents.len() {
                        self.with_agent(node, |agent, hands| agent.hear(conn, what, hands));
                    } else {
                        self.with_framework(node, |framework, h| framework.hear(conn, what, h));
                    }
                }
            }
            Due::Machine(index, what) => {
                self.with_agent(index, |agent, hands| agent.handle(what, hands));
            }
            Due::Framework(end, deed) => {
                self.with_framework(end, |framework, hands| framework.handle(&deed, hands));
                self.let_read(end);
            }
            Due::Lost(conn) => self.lost(conn),
            Due::WellAgain => self.truth.told = Told::default(),
            Due::Controller => self.start_controller(),
            Due::Heal(node) => self.heal(node),
        }
    }

    pub(crate) fn heal(&mut self, node: usize) {
        if self.net.is_blocked(node) {
            self.log.say(self.now, format_args!("node {node} is reached again"));
        }
        self.net.heal(node, self.now, (&mut self.dice, &mut self.agenda));
    }

    fn reaches_controller(&mut self, conn: Conn, what: Up) {
        let Some(node) = self.net.node_of(conn) else { return };
        let taken = match (&mut self.controller, what) {
            (None, _) => false,
            (Some(controller), Up::Open) if node >= self.agents.len() => controller.welcome(conn),
            (Some(controller), Up::Call(call)) => controller.call(conn, *call),
            (Some(controller), Up::Orders) => {
                let member = &self.house.members[node];
                controller.order(conn, &member.name, &member.key)
            }
            (Some(controller), Up::Open) => {
                let member = &self.house.members[node];
                controller.connect(conn, &member.name, &member.key)
            }
            (Some(controller), Up::Message(message)) => controller.deliver(conn, *message),
            (Some(_), Up::End) => {
                self.hang_up(conn);
                self.net.forget(conn);
                return;
            }
        };
        if !taken {
            self.close_down(conn);
        }
    }

    pub(crate) fn close_down(&mut self, conn: Conn) {
        self.net.send_down(conn, Down::End, self.now, (&mut self.dice, &mut self.agenda));
    }

    fn controller_says(&mut self, said: Said) {
        match said {
            Said::Up => {
                self.log.say(self.now, format_args!("the controller answers"));
                self.up_since = Some(self.now);
            }
            Said::Failed(why) => {
                self.log.say(self.now, format_args!("the controller does not start: {why}"));
                self.controller = None;
                self.agenda.at(self.now + 100, Due::Controller);
            }
            Said::ToAgent(conn, message) => {
                let chance = (&mut self.dice, &mut self.agenda);
                self.net.send_down(conn, Down::Message(message), self.now, chance);
            }
            Said::Order(conn, order) => {
                let chance = (&mut self.dice, &mut self.agenda);
                self.net.send_down(conn, Down::Order(order), self.now, chance);
            }
            Said::ToFramework(conn, event) => self.tell_framework(conn, event),
            Said::Closed(conn) => self.close_down(conn),
            Said::Answer(id, code, body) => {
                let asked = self.users.answered(id, code, &body);
                self.log.say(self.now, format_args!("{asked:?}: {code}"));
                if !(200..300).contains(&code) && ![404, 409].contains(&code) {
                    let text = String::from_utf8_lossy(&body).into_owned();
                    self.log.say(self.now, format_args!("{text}"));
                }
                self.is_answered(asked, code, &body);
            }
        }
    }

    pub(crate) fn start_controller(&mut self) {
        if self.controller.is_none() {
            self.log.say(self.now, format_args!("the controller starts"));
            self.controller = Some(Controller::start(&self.house, self.now));
        }
    }

    /// `kill -9` of the controller. Its machine tells the agents, or is gone as well.
    pub(crate) fn crash_controller(&mut self) {
        self.controller = None;
        self.up_since = None;
        // Whoever starts next reads every revision that was not compacted.
        if self.dice.one_in(2) {
            self.house.disk.compact();
        }
        self.users.left_alone();
        for conn in self.net.all() {
            if self.dice.one_in(4) {
                self.net.black_out(conn);
            } else {
                self.close_down(conn);
            }
        }
    }

    /// Asks the controller something, if it answers.
    pub(crate) fn ask(
        &mut self,
        make: impl FnOnce(&mut Users, &mut Dice) -> Option<(u64, http::Request<axum::body::Body>)>,
    ) -> bool {
        let Some(controller) = self.controller.as_ref().filter(|c| c.store().is_some()) else {
            return false;
        };
        let Some((id, request)) = make(&mut self.users, &mut self.dice) else { return false };
        controller.request(id, request)
    }

    /// Plants a leak: a task that drives is ended in the books, and its lease is not given back.
    fn leak(&mut self) {
        let driving = self.view.tasks.all().find(|(_, _, task)| {
            task.status.as_ref().is_some_and(|s| s.phase.holds_node() && s.lease.is_some())
        });
        if let (Some((key, ..)), Some(controller)) = (driving, &self.controller) {
            controller.end_without_lease(key);
        }
    }

    /// Holds what the store and the kernels say against the invariants.
    pub(crate) fn check(&mut self) {
        if self.broken.is_some() {
            return;
        }
        if let Some(words) = crate::run::panicked() {
            return self.break_with(Invariant::Panicked.broken(words));
        }
        if self.mutation == Some(Mutation::Leak) {
            self.leak();
        }
        if let Err(violation) = self.checked() {
            self.break_with(violation);
        }
    }

    fn checked(&mut self) -> Result<(), Violation> {
        let Some(store) = self.controller.as_ref().and_then(Controller::store) else {
            return Ok(());
        };
        let before = self.view.revision;
        let followed = self.view.follow(store, self.now);
        for news in self.view.news.drain(..) {
            self.log.say(self.now, format_args!("{news}"));
        }
        followed?;
        self.fences_count()?;
        self.may_lose();
        self.ends_were_acknowledged()?;
        if self.view.revision != before {
            if self.cast.sets {
                self.users.sets.check(&self.view, &self.truth)?;
            }
            if self.cast.applications {
                self.users.applications.check(&self.view, &self.truth, self.now)?;
            }
            self.users.nothing_acknowledged_is_lost(&self.view)?;
        }
        self.nobody_drives_beside()?;
        self.nobody_was_ended_for_nothing()?;
        self.whoever_waits_says_why()
    }

    /// What a person called off with its node may end, and what it does is theirs, also what was bound there after they asked.
    fn fences_count(&mut self) -> Result<(), Violation> {
        for (uid, node) in std::mem::take(&mut self.view.called_off) {
            if !self.users.fenced.contains(&node) {
                let how = format!("{uid} was called off with {node}, and nobody did that");
                return Err(Invariant::WorkOutlivesItsManagers.broken(how));
            }
            self.truth.write_off(std::slice::from_ref(&uid));
            self.users.may_end.insert(uid);
        }
        Ok(())
    }

    /// The tasks of frameworks that are over, or away for too long, may end.
    fn may_lose(&mut self) {
        for (uid, (_, id)) in &self.view.owners {
            if self.frameworks.iter().any(|framework| framework.may_lose(id, self.now)) {
                self.users.may_end.insert(uid.clone());
            }
        }
    }

    /// What was launched is there until its framework has heard of its end, as long as the framework is there (invariants
    /// 3 and 5).
    fn ends_were_acknowledged(&mut self) -> Result<(), Violation> {
        let View { tasks, frameworks, owners, .. } = &mut self.view;
        let known: BTreeSet<&str> = frameworks.all().map(|(_, uid, _)| uid.as_str()).collect();
        let there: BTreeSet<&TaskUid> = tasks.all().map(|(_, uid, _)| uid).collect();
        for framework in &self.frameworks {
            for (id, _) in framework.tenures.iter().filter(|(id, _)| known.contains(id.as_str())) {
                for (uid, acknowledged) in framework.tasks(id) {
                    if !acknowledged && !there.contains(uid) {
                        let how =
                            format!("{uid} of {} was launched, and is not there", framework.name);
                        return Err(Invariant::NothingAcknowledgedIsLost.broken(how));
                    }
                }
            }
        }
        let mut untold = None;
        owners.retain(|uid, (name, id)| {
            let acknowledged = |f: &Framework| f.tasks(id).any(|(of, done)| done && of == uid);
            let gone = !there.contains(uid);
            if gone && known.contains(id.as_str()) && !self.frameworks.iter().any(acknowledged) {
                untold = Some(format!(
                    "{name} ({uid}) is gone, and its framework has not heard of its end"
                ));
            }
            !gone
        });
        match untold {
            Some(how) => Err(Invariant::WorkOutlivesItsManagers.broken(how)),
            None => Ok(()),
        }
    }

    /// What was told to end was told so by somebody, and the store knows it.
    fn nobody_was_ended_for_nothing(&mut self) -> Result<(), Violation> {
        for (at, uid) in std::mem::take(&mut self.truth.ordered) {
            let launched = self.truth.launched.get(&uid);
            let lost = |id: &String| self.frameworks.iter().any(|f| f.may_lose(id, self.now));
            let asked = self.users.may_end.contains(&uid) || launched.is_some_and(lost);
            let status = self.view.task(&uid).and_then(|task| task.status.as_ref());
            let ordered = status.is_some_and(|s| s.stop.is_some());
            // A set, and an application, ends its tasks by deleting them; they may be gone already.
            let known = self.users.wishes.contains_key(&uid) || launched.is_some();
            let deleted = |task: &Task| task.metadata.deletion_timestamp.is_some();
            let owned = !known && self.view.task(&uid).is_none_or(deleted);
            if !asked && !ordered && !owned {
                let how = format!("{uid} was told to end at {at}, and nobody wanted that");
                return Err(Invariant::WorkOutlivesItsManagers.broken(how));
            }
        }
        Ok(())
    }

    /// Invariant 6, while the controller was up and its disk well for long enough.
    fn whoever_waits_says_why(&self) -> Result<(), Violation> {
        const SOON: u64 = 10_000;
        let Some(up) = self.up_since else { return Ok(()) };
        let well = up.max(self.failed_at);
        for (uid, since) in &self.view.mute {
            if self.now > well.max(*since) + SOON {
                let how = format!("{uid} waits since {since} and does not say why");
                return Err(Invariant::EverythingEndsOrExplainsItself.broken(how));
            }
        }
        Ok(())
    }

    /// Whose tasks may end because a person said that the node is off.
    pub(crate) fn may_end_on(&mut self, index: usize) -> Vec<TaskUid> {
        let live = self.truth.live.iter().filter(|(_, live)| live.node == index);
        let mut uids: Vec<TaskUid> = live.map(|(uid, _)| uid.clone()).collect();
        let name = self.agents[index].name();
        let placed = self.view.tasks.all().filter(|(_, _, task)| {
            task.status.as_ref().and_then(|s| s.node.as_deref()) == Some(name)
        });
        uids.extend(placed.map(|(_, uid, _)| uid.clone()));
        self.users.may_end.extend(uids.iter().cloned());
        uids
    }
}
