//! A framework: what it believes by what it was told, and what it may rely on since. Its session is the controller's real one;
//! the framework itself is modelled, with the manners of the SDKs: it comes back with its id, gives a silent connection up, and
//! acknowledges what it has heard, sooner or later.

use std::collections::{BTreeMap, BTreeSet};

use muster_api::id::TaskUid;
use muster_api::wire::framework::v1 as wire;
use muster_api::wire::framework_session::struct_of;
use serde_json::json;
use wire::call::Call as Say;
use wire::event::Event as Hear;

use crate::agenda::Due;
use crate::agent::Hands;
use crate::dice::Dice;
use crate::invariant::{Invariant, Violation};
use crate::net::{Conn, Down, Up};

/// A connection on which nothing was heard for this long is given up: three heartbeats.
const DEAF_AFTER: u64 = 15_000;
/// Between two looks whether something was heard, and before another try, milliseconds.
const LOOK_EVERY: u64 = 5_000;
const PAUSE: u64 = 1_000;
/// What was on its way when a session ended may be heard so much later.
const ON_THE_WAY: u64 = 1_000;
/// Tasks of one framework at once.
const CROWD: usize = 4;

/// Something that happens to a framework. What names a life comes to no later one.
#[derive(Debug)]
pub(crate) enum Deed {
    /// It is started.
    Begin,
    /// It is let go on.
    Thaw,
    /// It dials the controller.
    Dial(u32),
    /// It looks whether its session is silent.
    Look(u32, Conn),
}

/// What it was offered.
#[derive(Debug, Clone)]
pub(crate) struct Offer {
    pub(crate) node: String,
    cpu: u64,
    drives: bool,
    /// An Accept with it is under way, or was refused.
    used: bool,
}

/// One task of a framework.
#[derive(Debug, Default)]
struct Own {
    /// It heard of the end, and said so.
    acknowledged: bool,
    over: bool,
}

/// What it has under one id.
#[derive(Debug, Default)]
pub(crate) struct Tenure {
    tasks: BTreeMap<TaskUid, Own>,
    /// It was torn down, or told that it is no more.
    over: bool,
}

#[derive(Debug)]
struct Session {
    conn: Conn,
    subscribed: bool,
    last_heard: u64,
    offers: BTreeMap<String, Offer>,
    /// Accepts without an answer: the offer of each.
    asked: BTreeMap<String, String>,
}

/// A framework.
#[derive(Debug)]
pub(crate) struct Framework {
    /// Its end of the network.
    pub(crate) end: usize,
    pub(crate) name: String,
    /// How long it may be away, milliseconds.
    timeout: u64,
    id: Option<String>,
    lives: u32,
    up: bool,
    pub(crate) frozen: bool,
    /// It never comes back.
    pub(crate) retired: bool,
    session: Option<Session>,
    /// What arrived while it was frozen.
    unread: Vec<(u64, Conn, Down)>,
    /// When it last heard of the controller in a session.
    heard: u64,
    /// What it heard then may be old: it may have been given up before.
    doubt: bool,
    calls: u64,
    /// Offers that it ever had, and those with which tasks were launched.
    seen: BTreeSet<String>,
    spent: BTreeSet<String>,
    /// Tasks that it was told are not launched: it may launch something else in their place.
    refused: BTreeSet<String>,
    pub(crate) tenures: BTreeMap<String, Tenure>,
    /// It acknowledges everything at once.
    pub(crate) keen: bool,
}

impl Framework {
    pub(crate) fn new(end: usize, name: &str, timeout: u64) -> Framework {
        Framework {
            end,
            name: name.to_owned(),
            timeout,
            id: None,
            lives: 0,
            up: false,
            frozen: false,
            retired: false,
            session: None,
            unread: Vec::new(),
            heard: 0,
            doubt: false,
            calls: 0,
            seen: BTreeSet::new(),
            spent: BTreeSet::new(),
            refused: BTreeSet::new(),
            tenures: BTreeMap::new(),
            keen: false,
        }
    }

    pub(crate) fn is_up(&self) -> bool {
        self.up
    }

    pub(crate) fn conn(&self) -> Option<Conn> {
        self.session.as_ref().map(|session| session.conn)
    }

    fn subscribed(&self) -> Option<&Session> {
        self.session.as_ref().filter(|session| session.subscribed && !self.frozen)
    }

    /// Nodes of which it has an offer; none: it has no session.
    pub(crate) fn offered(&self) -> Option<BTreeSet<&str>> {
        let session = self.subscribed()?;
        Some(session.offers.values().map(|offer| &*offer.node).collect())
    }

    /// Accepts that wait for an answer.
    pub(crate) fn unanswered(&self) -> usize {
        self.session.as_ref().map_or(0, |session| session.asked.len())
    }

    /// Whether what it has under this id may be ended: it ended itself, was told that it is over, or is away for too long.
    pub(crate) fn may_lose(&self, id: &str, now: u64) -> bool {
        let over = self.tenures.get(id).is_some_and(|tenure| tenure.over);
        over || (self.id.as_deref() == Some(id) && (self.doubt || self.is_away(now)))
    }

    fn is_away(&self, now: u64) -> bool {
        now + ON_THE_WAY >= self.heard + self.timeout
    }

    /// The tasks that it relies on under an id, and whether it has acknowledged the end of each.
    pub(crate) fn tasks(&self, id: &str) -> impl Iterator<Item = (&TaskUid, bool)> {
        let tenure = self.tenures.get(id);
        tenure.into_iter().flat_map(|t| t.tasks.iter().map(|(uid, own)| (uid, own.acknowledged)))
    }

    /// Something that happens to it.
    pub(crate) fn handle(&mut self, deed: &Deed, hands: &mut Hands<'_>) {
        match *deed {
            Deed::Begin => {
                if !self.up && !self.retired {
                    self.up = true;
                    self.lives += 1;
                    self.dial(hands);
                }
            }
            Deed::Thaw => {
                self.frozen = false;
                for (came, conn, what) in std::mem::take(&mut self.unread) {
                    self.read((came, conn), what, hands);
                }
            }
            Deed::Dial(life) | Deed::Look(life, _) if life != self.lives || !self.up => {}
            Deed::Dial(_) => self.dial(hands),
            Deed::Look(_, conn) => self.look(conn, hands),
        }
    }

    fn later(&self, wait: u64, deed: Deed, hands: &mut Hands<'_>) {
        let at = hands.now + wait;
        hands.agenda.at(at, Due::Framework(self.end, deed));
    }

    fn dial(&mut self, hands: &mut Hands<'_>) {
        if self.session.is_some() {
            return;
        }
        if self.frozen || hands.net.is_blocked(self.end) {
            return self.later(LOOK_EVERY, Deed::Dial(self.lives), hands);
        }
        let conn = hands.net.open(self.end);
        let (last_heard, subscribed) = (hands.now, false);
        let (offers, asked) = (BTreeMap::new(), BTreeMap::new());
        self.session = Some(Session { conn, subscribed, last_heard, offers, asked });
        hands.net.send_up(conn, Up::Open, hands.now, (hands.dice, hands.agenda));
        let subscribe = wire::Subscribe {
            name: self.name.clone(),
            framework_id: self.id.clone().unwrap_or_default(),
            failover_timeout_seconds: Some(self.timeout as f64 / 1_000.0),
            nonce: format!("{}-{}", self.name, self.lives),
            ..wire::Subscribe::default()
        };
        self.say(String::new(), Say::Subscribe(subscribe), hands);
        self.later(LOOK_EVERY, Deed::Look(self.lives, conn), hands);
    }

    fn say(&mut self, id: String, call: Say, hands: &mut Hands<'_>) {
        let Some(conn) = self.conn() else { return };
        let call = Up::Call(Box::new(wire::Call { id, call: Some(call) }));
        hands.net.send_up(conn, call, hands.now, (hands.dice, hands.agenda));
    }

    fn look(&mut self, conn: Conn, hands: &mut Hands<'_>) {
        let Some(session) = self.session.as_ref().filter(|session| session.conn == conn) else {
            return;
        };
        if !self.frozen && hands.now - session.last_heard > DEAF_AFTER {
            hands.net.send_up(conn, Up::End, hands.now, (hands.dice, hands.agenda));
            return self.lose(hands);
        }
        self.later(LOOK_EVERY, Deed::Look(self.lives, conn), hands);
    }

    /// Its session is over; it tries again.
    pub(crate) fn lose(&mut self, hands: &mut Hands<'_>) {
        self.session = None;
        self.later(PAUSE, Deed::Dial(self.lives), hands);
    }

    /// `kill -9`.
    pub(crate) fn crash(&mut self, hands: &mut Hands<'_>) {
        self.up = false;
        self.frozen = false;
        if let Some(Session { conn, .. }) = self.session.take() {
            hands.net.send_up(conn, Up::End, hands.now, (hands.dice, hands.agenda));
        }
    }

    /// Launches something on an offer. False: it has none, or enough tasks.
    pub(crate) fn accept(&mut self, hands: &mut Hands<'_>) -> bool {
        let Some(id) = self.id.clone().filter(|id| self.live(id) < CROWD) else { return false };
        let Some((offer_id, offer)) = self.pick(hands.dice) else { return false };
        self.calls += 1;
        let call = format!("call-{}", self.calls);
        let launch = launch(self.named_by(&call), &offer, hands.dice);
        let accept = wire::Accept {
            offers: vec![offer_id.clone()],
            launches: vec![launch],
            refuse_seconds: hands.dice.between(0, 3) as f64,
        };
        if let Some(session) = &mut self.session {
            session.asked.insert(call.clone(), offer_id.clone());
            session.offers.entry(offer_id).and_modify(|offer| offer.used = true);
        }
        hands.log.say(
            hands.now,
            format_args!("{} ({id}) accepts {} with {call}", self.name, offer.node),
        );
        self.say(call, Say::Accept(accept), hands);
        true
    }

    /// The name of the task that a call launches.
    fn named_by(&self, call: &str) -> String {
        format!("{}-{}", self.name, call.trim_start_matches("call-"))
    }

    fn live(&self, id: &str) -> usize {
        let tenure = self.tenures.get(id);
        tenure.map_or(0, |tenure| tenure.tasks.values().filter(|own| !own.over).count())
    }

    fn pick(&self, dice: &mut Dice) -> Option<(String, Offer)> {
        let offers = &self.subscribed()?.offers;
        let free: Vec<_> = offers.iter().filter(|(_, offer)| !offer.used).collect();
        dice.pick(&free).map(|(id, offer)| ((*id).clone(), (*offer).clone()))
    }

    pub(crate) fn decline(&mut self, hands: &mut Hands<'_>) -> bool {
        let Some((id, _)) = self.pick(hands.dice) else { return false };
        self.session.iter_mut().for_each(|session| drop(session.offers.remove(&id)));
        let refuse_seconds = Some(hands.dice.between(0, 20) as f64);
        let decline = wire::Decline { offers: vec![id], refuse_seconds };
        self.say(String::new(), Say::Decline(decline), hands);
        true
    }

    /// Wants one of its tasks gone; gives which.
    pub(crate) fn kill(&mut self, hands: &mut Hands<'_>) -> Option<TaskUid> {
        self.subscribed()?;
        let tasks = &self.tenures.get(self.id.as_ref()?)?.tasks;
        let all: Vec<&TaskUid> =
            tasks.iter().filter(|(_, own)| !own.over).map(|(u, _)| u).collect();
        let uid = TaskUid::clone(hands.dice.pick(&all)?);
        let kill = wire::Kill { task: uid.to_string(), grace_period_seconds: None };
        self.say(String::new(), Say::Kill(kill), hands);
        Some(uid)
    }

    /// Asks for the state of everything that it has.
    pub(crate) fn reconcile(&mut self, hands: &mut Hands<'_>) -> bool {
        let may = self.subscribed().is_some();
        if may {
            self.say(String::new(), Say::Reconcile(wire::Reconcile::default()), hands);
        }
        may
    }

    /// Ends itself and what it has. It begins anew after a while, as another.
    pub(crate) fn tear_down(&mut self, hands: &mut Hands<'_>) -> bool {
        if self.subscribed().is_none() {
            return false;
        }
        let Some(id) = self.id.clone() else { return false };
        self.tenures.entry(id).or_default().over = true;
        self.say(String::new(), Say::Teardown(wire::Teardown {}), hands);
        true
    }

    /// Something of the controller arrives.
    pub(crate) fn hear(&mut self, conn: Conn, what: Down, hands: &mut Hands<'_>) {
        if self.frozen {
            return self.unread.push((hands.now, conn, what));
        }
        self.read((hands.now, conn), what, hands);
    }

    /// Reads what came at a time: of what is read later the controller may be long past.
    fn read(&mut self, (came, conn): (u64, Conn), what: Down, hands: &mut Hands<'_>) {
        let Some(session) = self.session.as_mut().filter(|session| session.conn == conn) else {
            return;
        };
        session.last_heard = hands.now;
        let event = match what {
            Down::End => return self.lose(hands),
            Down::Event(event) => event.event,
            Down::Message(_) | Down::Order(_) => return,
        };
        let subscribed = session.subscribed;
        if subscribed {
            self.doubt |= self.is_away(hands.now);
            self.heard = came;
        }
        match event {
            Some(Hear::Subscribed(subscribed)) => self.is_subscribed(subscribed, hands),
            Some(Hear::Offers(offers)) => {
                for offer in offers.offers {
                    if let Err(violation) = self.is_offered(&offer) {
                        hands.break_with(violation);
                    }
                }
            }
            Some(Hear::Rescind(rescind)) => {
                let session = self.session.as_mut();
                session
                    .into_iter()
                    .for_each(|s| s.offers.retain(|id, _| !rescind.offers.contains(id)));
            }
            Some(Hear::Update(update)) => self.is_told(&update, hands),
            Some(Hear::Answer(answer)) => self.is_answered(answer, hands),
            Some(Hear::Error(error)) => {
                hands
                    .log
                    .say(hands.now, format_args!("{} is refused: {}", self.name, error.reason));
                if error.reason == "UnknownFramework"
                    && let Some(id) = self.id.take()
                {
                    self.tenures.entry(id).or_default().over = true;
                    // Another one begins in its place.
                    self.lives += 1;
                    // Its end may never come.
                    self.later(LOOK_EVERY, Deed::Look(self.lives, conn), hands);
                }
            }
            _ => {}
        }
    }

    fn is_subscribed(&mut self, said: wire::Subscribed, hands: &mut Hands<'_>) {
        let id = said.framework_id;
        hands.log.say(hands.now, format_args!("{} is subscribed as {id}", self.name));
        if self.id.as_ref().is_some_and(|known| *known != id) {
            let how = format!("{} came back with {:?}, and is {id} now", self.name, self.id);
            hands.break_with(Invariant::WorkOutlivesItsManagers.broken(how));
        }
        (self.heard, self.doubt) = (hands.now, false);
        self.session.iter_mut().for_each(|session| session.subscribed = true);
        self.tenures.entry(id.clone()).or_default();
        self.id = Some(id);
    }

    /// An offer comes once, and of a node there is one at a time.
    fn is_offered(&mut self, offer: &wire::Offer) -> Result<(), Violation> {
        let twice = |how: String| Err(Invariant::NoOversubscription.broken(how));
        let Some(session) = &mut self.session else { return Ok(()) };
        if !self.seen.insert(offer.id.clone()) {
            return twice(format!("{} is offered {} twice", self.name, offer.id));
        }
        // One that is used is rescinded by nobody before its answer.
        let other = session.offers.iter().find(|(_, o)| o.node == offer.node && !o.used);
        if let Some((other, _)) = other {
            let (name, node, id) = (&self.name, &offer.node, &offer.id);
            return twice(format!("{name} has offer {other} of {node}, and is offered {id}"));
        }
        let known = Offer {
            node: offer.node.clone(),
            cpu: offer.free.as_ref().map_or(0, |free| free.cpu_millis),
            drives: !offer.actuators.is_empty(),
            used: false,
        };
        session.offers.insert(offer.id.clone(), known);
        Ok(())
    }

    fn is_answered(&mut self, answer: wire::Answer, hands: &mut Hands<'_>) {
        let asked = self.session.as_mut().and_then(|session| session.asked.remove(&answer.id));
        let Some(offer) = asked else { return };
        if let Some(refusal) = &answer.refusal {
            let (id, why) = (&answer.id, &refusal.message);
            self.refused.insert(self.named_by(id));
            return hands.log.say(hands.now, format_args!("{}: {id} is refused: {why}", self.name));
        }
        self.session.iter_mut().for_each(|session| drop(session.offers.remove(&offer)));
        if !self.spent.insert(offer.clone()) {
            let how = format!("{}: offer {offer} was accepted twice", self.name);
            hands.break_with(Invariant::NoOversubscription.broken(how));
        }
        let Some(id) = self.id.clone() else { return };
        let tenure = self.tenures.entry(id).or_default();
        for launched in &answer.launched {
            tenure.tasks.entry(TaskUid::new(launched.task.as_str())).or_default();
            let (name, task, node) = (&self.name, &launched.name, &launched.node);
            hands.log.say(hands.now, format_args!("{name} has launched {task} on {node}"));
        }
    }

    /// An update; it is acknowledged now, or when it is said again.
    fn is_told(&mut self, update: &wire::Update, hands: &mut Hands<'_>) {
        let Some(tenure) = self.id.as_ref().and_then(|id| self.tenures.get_mut(id)) else { return };
        let state = wire::TaskState::try_from(update.state).unwrap_or_default();
        if state == wire::TaskState::Gone {
            return;
        }
        if self.refused.contains(&update.name) {
            let how = format!("{}: {} was refused, and is {state:?}", self.name, update.name);
            hands.break_with(Invariant::NothingRunsTwice.broken(how));
        }
        let end = matches!(state, wire::TaskState::Succeeded | wire::TaskState::Failed);
        let own = tenure.tasks.entry(TaskUid::new(update.task.as_str())).or_default();
        if own.over && !end {
            let (name, task) = (&self.name, &update.task);
            // An older state may be said again over what was never acknowledged, but not come after the acknowledgement.
            hands.log.say(hands.now, format_args!("{name}: {task} was over, and is {state:?}"));
        }
        own.over |= end;
        if !self.keen && hands.dice.one_in(4) {
            return;
        }
        own.acknowledged |= end;
        let acknowledge = wire::Acknowledge { task: update.task.clone(), version: update.version };
        self.say(String::new(), Say::Acknowledge(acknowledge), hands);
    }
}

/// What a framework runs on an offer; sometimes more than it was offered.
fn launch(name: String, offer: &Offer, dice: &mut Dice) -> wire::Launch {
    let most = if dice.one_in(8) { 1_000 } else { offer.cpu.clamp(100, 500) };
    let cpu = dice.between(1, most / 100) * 100;
    let mut spec = json!({
        "run": {"process": {"command": ["work"]}},
        "restartPolicy": dice.pick(&["Never", "OnFailure", "Always"]),
        "gracePeriodSeconds": dice.between(0, 4),
        "resources": {"cpu": format!("{cpu}m"), "memory": "32Mi"},
    });
    if offer.drives && dice.one_in(2) {
        spec["resources"]["actuators"] = json!(["base:Drive"]);
    }
    if dice.one_in(4) {
        spec["onDisconnect"] =
            json!({"policy": "Stop", "after": format!("{}s", dice.between(2, 12))});
    }
    wire::Launch { name, spec: spec.as_object().map(struct_of), ..wire::Launch::default() }
}
