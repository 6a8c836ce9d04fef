//! One framework's session, whatever carries it.
//!
//! One task a session. It has six sources in one select: calls, where somebody else sets it to work, what the desk and executors say (the events channel),
//! updates of tasks (the mailbox), the heartbeat, and the ends (cut off, transport closed, controller ending). Only this
//! task writes to the transport; when the framework does not read, this task waits, and the desk cuts the session off
//! once the events channel is full.
//!
//! Updates are repeated every [`RESEND`] until they are acknowledged. The acknowledgement of an end takes the finalizer
//! off the task's object, which is the durable memory of it: after a restart whoever has the finalizer is told again.

use std::collections::BTreeMap;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use muster_api::kind::framework::{ACKNOWLEDGE_FINALIZER, FrameworkSpec};
use muster_api::kind::task::Task;
use muster_api::wire::framework::v1 as wire;
use muster_api::wire::framework_session::{position_to_wire, set_filter, set_position};
use muster_controller_core::access::Verb;
use muster_controller_core::offer::DEFAULT_REFUSE;
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use wire::call::Call as Said;
use wire::event::Event as Tell;

use super::subscribe::{self, Guest};
use super::{
    CALLS, EVENTS, Frameworks, HEARTBEAT_EVERY, MAX_MESSAGE, Mailbox, Move, Open, Unsent, convert,
    launch, session_in,
};
use crate::audit::Line;
use crate::auth::{self, Asker, Identity};
use crate::objects::{self, TASKS};
use crate::reconcile::desk::{Outlet, Request};
use crate::store::{Key, StoreError};

/// How long an update waits for its acknowledgement until it is said again.
const RESEND: Duration = Duration::from_secs(10);
/// A framework that connects subscribes at once.
const SUBSCRIBE_WITHIN: Duration = Duration::from_secs(10);
/// Longest time that a decline can hold: a year, as in Mesos.
const MAX_REFUSE: Duration = Duration::from_secs(365 * 24 * 3600);

/// What a session is told whose opener lost the right to it.
const TAKEN_BACK: &str = "the right to run this framework was taken back, or the token has ended";

/// The transport's ends.
pub(super) struct Wire {
    /// Who is there.
    pub(super) asker: Asker,
    /// Where calls come from, beside those that come by [`Frameworks::calls_of`].
    pub(super) calls: mpsc::Receiver<wire::Call>,
    /// The sender of the same channel, for a transport whose calls come one by one; none: when the framework closes
    /// its side, the session ends.
    pub(super) keep_calls: Option<mpsc::Sender<wire::Call>>,
    /// Where events go.
    pub(super) out: mpsc::Sender<wire::Event>,
}

impl Wire {
    /// A channel of calls of the usual depth.
    pub(super) fn calls() -> (mpsc::Sender<wire::Call>, mpsc::Receiver<wire::Call>) {
        mpsc::channel(CALLS)
    }
}

/// The session is over: the framework does not read any more.
#[derive(Debug)]
struct Closed;

struct Session {
    frameworks: Arc<Frameworks>,
    /// Who opened it.
    by: Arc<Identity>,
    guest: Guest,
    number: u64,
    out: mpsc::Sender<wire::Event>,
    mailbox: Arc<Mailbox>,
    /// Said, and not acknowledged.
    unacknowledged: BTreeMap<String, (wire::Update, Instant)>,
}

/// Runs a session to its end.
pub(super) async fn run(frameworks: Arc<Frameworks>, mut wire: Wire) {
    let stop = frameworks.context.stop.clone();
    let first = tokio::time::timeout(SUBSCRIBE_WITHIN, wire.calls.recv());
    let first = tokio::select! {
        () = stop.cancelled() => return,
        first = first => first,
    };
    let Ok(Some(wire::Call { call: Some(Said::Subscribe(subscribe)), .. })) = first else {
        return refuse(&wire.out, "Invalid", "the first call of a session is Subscribe").await;
    };
    match subscribe::subscribe(&frameworks, &wire.asker, &subscribe).await {
        Ok(guest) => serve(frameworks, wire, guest).await,
        Err(subscribe::Refused(reason, message)) => refuse(&wire.out, reason, &message).await,
    }
}

async fn refuse(out: &mpsc::Sender<wire::Event>, reason: &str, message: &str) {
    let error = wire::Error { reason: reason.to_owned(), message: message.to_owned() };
    // A framework that is gone need not be told.
    drop(out.send(wire::Event { event: Some(Tell::Error(error)) }).await);
}

async fn serve(frameworks: Arc<Frameworks>, wire: Wire, guest: Guest) {
    let number = frameworks.session_number();
    let session_id = uuid::Uuid::new_v4().to_string();
    let (events, mut told) = mpsc::channel(EVENTS);
    let (cut, slow) = (CancellationToken::new(), CancellationToken::new());
    let outlet = Outlet::new(number, events, slow.clone());
    let mailbox = Arc::new(Mailbox::default());
    let mut session = Session {
        frameworks: Arc::clone(&frameworks),
        number,
        out: wire.out,
        mailbox: Arc::clone(&mailbox),
        unacknowledged: BTreeMap::new(),
        by: Arc::new(wire.asker.identity),
        guest,
    };
    let (uid, key) = (Arc::clone(&session.guest.uid), session.guest.key.clone());
    tracing::info!(framework = %key, id = %uid, returned = session.guest.returned, "framework subscribed");
    let calls = wire.keep_calls.unwrap_or_else(|| mpsc::channel(1).0);
    let direct = session.guest.direct;
    let by = Arc::clone(&session.by);
    let whose = Arc::clone(&by);
    let (moves, moved) = mpsc::channel(1);
    let open = Open { outlet: outlet.clone(), by, direct, mailbox, moves, calls, cut: cut.clone() };
    frameworks.connect(&uid, &session_id, open);
    // After it is taken in: whoever writes that it is away looks first whether it is.
    let written = subscribe::write_connected(&frameworks, &session.guest, number).await;
    if let Err(subscribe::Refused(reason, message)) = written {
        refuse(&session.out, reason, &message).await;
        return session.leave(&session_id).await;
    }
    let ended = {
        let (context, out) = (&frameworks.context, session.out.clone());
        let asked = session_in(key.namespace(), Some(&key.name));
        let revoked = auth::until_revoked(context, &whose, &asked);
        let worked = pin!(session.work(&session_id, outlet, (wire.calls, moved), &mut told));
        tokio::select! {
            worked = worked => worked,
            // Also of one that calls nothing, or does not read: with its session its tickets end.
            () = revoked => {
                refuse_quickly(&out, "Forbidden", TAKEN_BACK);
                Err(Closed)
            }
            () = cut.cancelled() => Err(Closed),
            // It is told nothing: it does not read, and may come back.
            () = slow.cancelled() => Err(Closed),
            () = frameworks.context.stop.cancelled() => Err(Closed),
        }
    };
    if cut.is_cancelled() {
        refuse_quickly(&session.out, "Cut", subscribe::LATER);
    }
    tracing::info!(framework = %key, torn_down = ended.is_ok(), "framework's session ended");
    session.leave(&session_id).await;
}

/// Says why a session ends, if there is room to say it.
fn refuse_quickly(out: &mpsc::Sender<wire::Event>, reason: &str, message: &str) {
    let error = wire::Error { reason: reason.to_owned(), message: message.to_owned() };
    drop(out.try_send(wire::Event { event: Some(Tell::Error(error)) }));
}

impl Session {
    /// Ok: the framework tore itself down.
    async fn work(
        &mut self,
        session_id: &str,
        outlet: Outlet,
        (mut calls, mut moves): (mpsc::Receiver<wire::Call>, mpsc::Receiver<Move>),
        told: &mut mpsc::Receiver<wire::Event>,
    ) -> Result<(), Closed> {
        self.say(Tell::Subscribed(wire::Subscribed {
            framework_id: self.guest.uid.to_string(),
            session_id: session_id.to_owned(),
            reregistered: self.guest.returned,
            heartbeat_interval_ms: u32::try_from(HEARTBEAT_EVERY.as_millis()).unwrap_or(u32::MAX),
        }))
        .await?;
        self.ask(Request::Subscribe {
            uid: Arc::clone(&self.guest.uid),
            key: self.guest.key.clone(),
            spec: Box::new(self.guest.spec.clone()),
            outlet: outlet.clone(),
        })
        .await?;
        self.frameworks.may_dial(&self.guest.uid, self.number, self.guest.direct);
        self.tell_what_is_open();
        let mut beat = interval(HEARTBEAT_EVERY);
        beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                // Cancel safe: a call that was not received stays in the channel.
                call = calls.recv() => match call {
                    Some(call) => if self.take(call).await? { return Ok(()) },
                    // The framework closed its side.
                    None => return Err(Closed),
                },
                // Cancel safe, as above.
                Some(asked) = moves.recv() => self.be_moved(asked).await?,
                // Cancel safe, as above.
                Some(event) = told.recv() => {
                    outlet.taken(&event);
                    self.send(event).await?;
                }
                // Cancel safe: the permit stays.
                () = self.mailbox.wake.notified() => {
                    for (_, update) in self.mailbox.take() {
                        self.update(update).await?;
                    }
                }
                // Cancel safe: a tick that was not taken comes again.
                _ = beat.tick() => {
                    self.say(Tell::Heartbeat(wire::Heartbeat {})).await?;
                    self.say_again().await?;
                }
                () = self.out.closed() => return Err(Closed),
            }
        }
    }

    async fn send(&self, event: wire::Event) -> Result<(), Closed> {
        self.out.send(event).await.map_err(|_| Closed)
    }

    async fn say(&self, event: Tell) -> Result<(), Closed> {
        self.send(wire::Event { event: Some(event) }).await
    }

    /// Asks the desk; it ends only with the controller.
    async fn ask(&self, request: Request) -> Result<(), Closed> {
        self.frameworks.scheduler.desk(request).await.map_err(|_| Closed)
    }

    async fn answer(&self, id: String, refusal: Option<wire::Refusal>) -> Result<(), Closed> {
        let answer = wire::Answer { id, refusal, launched: Vec::new() };
        if !convert::is_wanted(&answer) {
            return Ok(());
        }
        self.say(Tell::Answer(answer)).await
    }

    /// Every task of the framework whose end it has not acknowledged.
    fn tell_what_is_open(&self) {
        for (stored_revision, task) in self.tasks() {
            if is_open(&task) {
                self.mailbox.put(convert::update(&task, stored_revision));
            }
        }
    }

    fn tasks(&self) -> Vec<(u64, Task)> {
        let store = &self.frameworks.context.store;
        let items = store.list(TASKS, self.guest.key.namespace()).items;
        let own = items.iter().filter(|s| s.mentions(&self.guest.uid));
        own.filter_map(|s| Some((s.revision, objects::read::<Task>(s)?)))
            .filter(|(_, t)| {
                subscribe::owner_of(&t.metadata).is_some_and(|uid| uid == self.guest.uid)
            })
            .collect()
    }

    async fn update(&mut self, update: wire::Update) -> Result<(), Closed> {
        self.unacknowledged.insert(update.task.clone(), (update.clone(), Instant::now()));
        self.say(Tell::Update(update)).await
    }

    async fn say_again(&mut self) -> Result<(), Closed> {
        let now = Instant::now();
        let due: Vec<wire::Update> = self
            .unacknowledged
            .values_mut()
            .filter(|(_, said)| now.duration_since(*said) >= RESEND)
            .map(|(update, said)| {
                *said = now;
                update.clone()
            })
            .collect();
        for update in due {
            self.say(Tell::Update(update)).await?;
        }
        Ok(())
    }

    /// True: the framework tore itself down.
    async fn take(&mut self, call: wire::Call) -> Result<bool, Closed> {
        let wire::Call { id, call } = call;
        let uid = Arc::clone(&self.guest.uid);
        let refusal = match call {
            _ if !self.still_may() => {
                refuse_quickly(&self.out, "Forbidden", TAKEN_BACK);
                return Err(Closed);
            }
            // What ends tasks or gives offers back waits for no disk.
            Some(Said::Accept(_) | Said::SetPosition(_) | Said::SetFilter(_))
                if !self.is_audited().await =>
            {
                Some(convert::unavailable())
            }
            Some(Said::Accept(accept)) => return self.accept(id, &accept).await.map(|()| false),
            Some(Said::SetPosition(new)) => {
                self.wish(|spec| set_position(spec, new.position.as_ref())).await?
            }
            Some(Said::SetFilter(new)) => {
                self.wish(|spec| set_filter(spec, new.filter.as_ref())).await?
            }
            Some(Said::Revive(_)) => {
                self.ask(Request::Revive { uid }).await?;
                None
            }
            Some(Said::Suppress(_)) => {
                self.ask(Request::Suppress { uid }).await?;
                None
            }
            Some(Said::Decline(decline)) => self.decline(&decline).await?,
            Some(Said::Kill(kill)) => self.kill(&kill).await,
            Some(Said::Acknowledge(acknowledge)) => self.acknowledge(&acknowledge).await,
            Some(Said::Reconcile(reconcile)) => {
                self.reconcile(&reconcile).await?;
                None
            }
            Some(Said::Message(message)) => self.message(message),
            Some(Said::Teardown(_)) => {
                let torn_down = self.tear_down().await;
                let done = torn_down.is_none();
                self.answer(id, torn_down).await?;
                return Ok(done);
            }
            Some(Said::Subscribe(_)) => Some(invalid("subscribe", "the session has begun already")),
            None => Some(invalid("call", "is missing")),
        };
        self.answer(id, refusal).await?;
        Ok(false)
    }

    /// Whether who opened the session may run the framework now: a session may last for weeks.
    fn still_may(&self) -> bool {
        let key = &self.guest.key;
        let asked = session_in(key.namespace(), Some(&key.name));
        auth::still_may(&self.frameworks.context, &self.by, &asked)
    }

    async fn is_audited(&self) -> bool {
        let context = &self.frameworks.context;
        let ready = context.audit.ready(context.clock.now()).await;
        if let Err(error) = &ready {
            tracing::warn!(error = error as &dyn std::error::Error, framework = %self.guest.key, "nothing is written while the audit log cannot be");
        }
        ready.is_ok()
    }

    async fn wish(
        &mut self,
        change: impl FnOnce(&mut FrameworkSpec) -> Result<(), muster_api::wire::WireError>,
    ) -> Result<Option<wire::Refusal>, Closed> {
        let mut spec = self.guest.spec.clone();
        if let Err(error) = change(&mut spec) {
            return Ok(Some(invalid("", &error.to_string())));
        }
        let violations = spec.violations();
        if !violations.is_empty() {
            return Ok(Some(convert::invalid(convert::causes("", &violations))));
        }
        let is_new = self.guest.spec != spec;
        self.follow(spec).await?;
        if let Err(error) = self.write_spec(&self.guest.spec).await {
            // It holds for the offers; only the object shows the older wish until the next change.
            tracing::warn!(framework = %self.guest.key, error = crate::app::chain(&error), "a wish is not written");
        }
        if is_new {
            let Guest { key, uid, .. } = &self.guest;
            self.write_line(Verb::Update, "frameworks", (key, uid)).await;
        }
        Ok(None)
    }

    /// Somebody else says where the framework works: it is told before it hears of offers there.
    async fn be_moved(&mut self, asked: Move) -> Result<(), Closed> {
        let spec = asked.position.of(&self.guest.spec);
        let written = self.write_spec(&spec).await;
        if written.is_ok() {
            let position = position_to_wire(&spec);
            self.follow(spec).await?;
            self.say(Tell::Moved(wire::Moved { position, by: asked.by })).await?;
        }
        // Who asked may have left.
        drop(asked.answer.send(written));
        Ok(())
    }

    async fn write_spec(&self, spec: &FrameworkSpec) -> Result<(), StoreError> {
        let Guest { key, uid, .. } = &self.guest;
        subscribe::write_spec(&self.frameworks.context, key, uid, spec).await
    }

    /// From now on it is offered what this asks for, and what it was offered for its old wish does not hold any more.
    async fn follow(&mut self, spec: FrameworkSpec) -> Result<(), Closed> {
        self.guest.spec = spec.clone();
        let uid = Arc::clone(&self.guest.uid);
        let (done, rescinded) = oneshot::channel();
        self.ask(Request::Wish { uid, spec: Box::new(spec), done }).await?;
        rescinded.await.map_err(|_| Closed)
    }

    async fn decline(&self, decline: &wire::Decline) -> Result<Option<wire::Refusal>, Closed> {
        let refuse = match decline.refuse_seconds.map(refuse_time) {
            None => DEFAULT_REFUSE,
            Some(Some(refuse)) => refuse,
            Some(None) => return Ok(Some(invalid("decline.refuseSeconds", "is not a time"))),
        };
        let offers = decline.offers.iter().filter_map(|id| launch::parse(id)).collect();
        self.ask(Request::Decline { uid: Arc::clone(&self.guest.uid), offers, refuse }).await?;
        Ok(None)
    }

    async fn accept(&self, id: String, accept: &wire::Accept) -> Result<(), Closed> {
        // One that cannot be read is one that is not offered.
        let unread: Vec<String> =
            accept.offers.iter().filter(|id| launch::parse(id).is_none()).cloned().collect();
        if !unread.is_empty() {
            return self.answer(id, Some(convert::offers_gone(unread))).await;
        }
        let owner = (&self.guest.key, &self.guest.uid);
        let context = &self.frameworks.context;
        // What they may at this moment: the session lasts longer.
        let asker = Asker::with(context, (*self.by).clone());
        let prepared = launch::prepare((context, &asker), owner, accept);
        let (launches, guard) = match prepared {
            Ok(prepared) => prepared,
            Err(refusal) => return self.answer(id, Some(refusal)).await,
        };
        let Some(refuse) = refuse_time(accept.refuse_seconds) else {
            return self.answer(id, Some(invalid("accept.refuseSeconds", "is not a time"))).await;
        };
        let offers = accept.offers.iter().filter_map(|id| launch::parse(id)).collect();
        let (uid, session, by) = (Arc::clone(&self.guest.uid), self.number, Arc::clone(&self.by));
        self.ask(Request::Accept { uid, session, by, call: id, offers, launches, refuse, guard })
            .await
    }

    /// The key of one of the framework's tasks.
    fn find(&self, uid: &str) -> Option<Key> {
        match self.frameworks.roster().find(uid) {
            Some((key, owner)) => {
                // By now another task may have the name.
                let stored = self.frameworks.context.store.get(&key)?;
                (owner? == self.guest.uid && *stored.uid == *uid).then_some(key)
            }
            // The roster is a moment behind: one that was just launched may not be on it yet.
            None => self.look_for(uid),
        }
    }

    /// Looks at the uids of all tasks of the namespace, and reads one.
    fn look_for(&self, uid: &str) -> Option<Key> {
        let tasks = self.frameworks.context.store.list(TASKS, self.guest.key.namespace()).items;
        let stored = tasks.into_iter().find(|stored| *stored.uid == *uid)?;
        let owner = subscribe::owner_of(&objects::read::<Task>(&stored)?.metadata)?;
        (owner == self.guest.uid).then(|| stored.key.clone())
    }

    async fn kill(&self, kill: &wire::Kill) -> Option<wire::Refusal> {
        let Some(key) = self.find(&kill.task) else {
            return Some(convert::not_found(format!("the framework has no task {}", kill.task)));
        };
        let grace = kill.grace_period_seconds.map(i64::from);
        match crate::rest::delete::delete_with_grace(&self.frameworks.context, &key, grace).await {
            Ok(stored) => {
                self.write_line(Verb::Delete, "tasks", (&stored.key, &stored.uid)).await;
                None
            }
            Err(failure) if failure.code() == 404 => None,
            Err(failure) => {
                tracing::warn!(task = %key, error = failure.message(), "a kill is not written");
                Some(convert::unavailable())
            }
        }
    }

    async fn acknowledge(&mut self, acknowledge: &wire::Acknowledge) -> Option<wire::Refusal> {
        let said = self.unacknowledged.get(&acknowledge.task);
        let Some((update, _)) = said.filter(|(u, _)| u.version <= acknowledge.version) else {
            // Acknowledged before, or a newer state is on its way.
            return None;
        };
        if is_end(update.state) {
            // The update says where it is; `let_go` looks at the uid.
            let key = Key::namespaced(
                TASKS,
                self.guest.key.namespace().unwrap_or_default(),
                &*update.name,
            );
            let store = &self.frameworks.context.store;
            if let Err(error) = let_go(store, &key, &acknowledge.task).await {
                // It is said again, and acknowledged again.
                tracing::warn!(task = %key, error = crate::app::chain(&error), "an acknowledgement is not written");
                return Some(convert::unavailable());
            }
        }
        self.unacknowledged.remove(&acknowledge.task);
        None
    }

    async fn reconcile(&mut self, reconcile: &wire::Reconcile) -> Result<(), Closed> {
        let tasks = self.tasks();
        let wanted =
            |uid: &str| reconcile.tasks.is_empty() || reconcile.tasks.iter().any(|t| t == uid);
        for (revision, task) in &tasks {
            if wanted(objects::uid_of(&task.metadata)) {
                self.update(convert::update(task, *revision)).await?;
            }
        }
        for uid in &reconcile.tasks {
            if !tasks.iter().any(|(_, t)| objects::uid_of(&t.metadata) == uid) {
                self.say(Tell::Update(convert::gone(uid))).await?;
            }
        }
        Ok(())
    }

    /// To an executor: at most once, so nothing waits when its node is away.
    fn message(&self, message: wire::Message) -> Option<wire::Refusal> {
        if message.data.len() > MAX_MESSAGE {
            let text =
                format!("{} bytes are more than the {MAX_MESSAGE} allowed", message.data.len());
            return Some(invalid("message.data", &text));
        }
        let sent = self.frameworks.send_to_executor(&self.guest.uid, message);
        sent.err().map(|unsent| match unsent {
            Unsent::NoExecutor(why) => convert::not_found(why.to_owned()),
            Unsent::NotNow(why) => convert::not_now(why.to_owned()),
        })
    }

    /// Removes the framework's object; the collector of garbage ends its tasks.
    async fn tear_down(&self) -> Option<wire::Refusal> {
        let context = &self.frameworks.context;
        match crate::rest::delete::delete_object(context, &self.guest.key).await {
            Ok(stored) => {
                self.write_line(Verb::Delete, "frameworks", (&stored.key, &stored.uid)).await;
                None
            }
            Err(failure) if failure.code() == 404 => None,
            Err(failure) => {
                tracing::warn!(framework = %self.guest.key, error = failure.message(), "a teardown is not written");
                Some(convert::unavailable())
            }
        }
    }

    /// The line in the audit log of what was done to an object. Where it is not written, it was done all the same.
    async fn write_line(&self, verb: Verb, resource: &'static str, (key, uid): (&Key, &str)) {
        let context = &self.frameworks.context;
        let line = Line {
            time: context.clock.now(),
            namespace: key.namespace().map(str::to_owned),
            name: Some(key.name.to_string()),
            uid: Some(uid.to_owned()),
            code: Some(200),
            ..Line::of(&self.by, verb, resource)
        };
        drop(context.audit.write(line).await);
    }

    async fn leave(self, session_id: &str) {
        let Session { frameworks, guest, number, .. } = self;
        // The desk ends only with the controller.
        frameworks.may_not_dial(&guest.uid, number);
        let leave = Request::Leave { uid: Arc::clone(&guest.uid), session: number };
        let _ = frameworks.scheduler.desk(leave).await;
        if frameworks.disconnect(&guest.uid, session_id, number)
            && let Err(error) = subscribe::write_presence(&frameworks, &guest.key, &guest.uid).await
        {
            // The failover loop finds it connected and without a session, and writes it again.
            tracing::warn!(framework = %guest.key, error = crate::app::chain(&error), "an absence is not written yet");
        }
    }
}

fn invalid(field: &str, message: &str) -> wire::Refusal {
    convert::invalid(vec![wire::Cause { field: field.to_owned(), message: message.to_owned() }])
}

fn refuse_time(seconds: f64) -> Option<Duration> {
    Duration::try_from_secs_f64(seconds).ok().map(|d| d.min(MAX_REFUSE))
}

fn is_end(state: i32) -> bool {
    matches!(
        wire::TaskState::try_from(state),
        Ok(wire::TaskState::Succeeded | wire::TaskState::Failed)
    )
}

/// The framework has yet to acknowledge the end of the task.
pub(super) fn is_open(task: &Task) -> bool {
    task.metadata.finalizers.iter().flatten().any(|f| f == ACKNOWLEDGE_FINALIZER)
}

/// Takes the finalizer off a task: nobody has to hear of its end any more.
///
/// # Errors
///
/// When the store fails.
pub(crate) async fn let_go(
    store: &crate::store::Store,
    key: &Key,
    uid: &str,
) -> Result<(), StoreError> {
    objects::change(store, key, |stored, mut task: Task| {
        if *stored.uid != *uid || !is_open(&task) {
            return None;
        }
        if let Some(finalizers) = task.metadata.finalizers.as_mut() {
            finalizers.retain(|f| f != ACKNOWLEDGE_FINALIZER);
        }
        Some(vec![objects::replace(stored, &task)])
    })
    .await
    .map(drop)
}
