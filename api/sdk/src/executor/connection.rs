//! One connection at a time to the agent, made again whenever it breaks.
//!
//! At most one event waits for the executor's code; while it waits nothing more is read, and commands are taken.
//! Updates go into the book first, so that a connection that breaks loses none.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use muster_api::wire::executor::v1 as proto;
use proto::call::Call as Say;
use proto::event::Event as Hear;
use tokio::net::UnixStream;
use tokio::net::unix::OwnedWriteHalf;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until, timeout};

use super::book::Book;
use super::frame::{self, Frames};
use super::{Registration, Status};
use crate::backoff::Backoff;

/// An agent on the same machine that does not read for so long has lost its way.
const PATIENCE: Duration = Duration::from_secs(10);
/// Largest message to a framework.
const MAX_MESSAGE: usize = 4 << 20;

/// What the handle wants.
#[derive(Debug)]
pub(crate) enum Command {
    Update(Status),
    Message(Bytes),
    /// End once the agent has every update, or after so long.
    Finish(Duration),
}

/// What happens.
#[derive(Debug)]
pub(crate) enum Event {
    Registered(Registration),
    Reregistered,
    Disconnected,
    Launch(proto::Launch),
    Kill { task: String, grace: Duration },
    Message(Bytes),
    Shutdown(Duration),
}

/// Why a connection ended.
enum End {
    Broken(io::Error),
    /// The executor was shut down.
    Finished,
}

impl From<io::Error> for End {
    fn from(error: io::Error) -> Self {
        End::Broken(error)
    }
}

/// The executor's side, across connections.
#[derive(Debug)]
pub(crate) struct Connection {
    socket: PathBuf,
    token: String,
    book: Book,
    /// The executor's code was told that it is registered, in this life.
    registered: bool,
    /// This connection got as far as Registered.
    connected: bool,
    /// Set by Finish: when to end at the latest.
    finish_by: Option<Instant>,
    /// Events that wait for room.
    backlog: VecDeque<Event>,
    commands: mpsc::Receiver<Command>,
    events: mpsc::Sender<Event>,
}

impl Connection {
    pub(crate) fn new(
        socket: PathBuf,
        token: String,
        commands: mpsc::Receiver<Command>,
        events: mpsc::Sender<Event>,
    ) -> Self {
        Connection {
            socket,
            token,
            book: Book::default(),
            registered: false,
            connected: false,
            finish_by: None,
            backlog: VecDeque::new(),
            commands,
            events,
        }
    }

    /// Runs until the executor is shut down.
    pub(crate) async fn run(&mut self) {
        let mut backoff = Backoff::new();
        loop {
            let Err(end) = self.connect().await;
            match end {
                End::Finished => return,
                End::Broken(error) => {
                    tracing::warn!(%error, socket = %self.socket.display(), "not connected to the agent");
                }
            }
            if std::mem::take(&mut self.connected) {
                backoff.reset();
                self.backlog.push_back(Event::Disconnected);
            }
            let until = Instant::now() + backoff.pause();
            if self.wait_until(until).await.is_err() {
                return;
            }
        }
    }

    /// Takes commands while there is no agent.
    async fn wait_until(&mut self, until: Instant) -> Result<(), End> {
        let events = self.events.clone();
        loop {
            let finish_by = self.finish_by.unwrap_or(until);
            // Every arm is cancel-safe: permits and commands are taken whole or not at all.
            tokio::select! {
                () = sleep_until(until.min(finish_by)) => {
                    return if self.is_over() { Err(End::Finished) } else { Ok(()) };
                }
                permit = events.reserve(), if !self.backlog.is_empty() => {
                    hand_out(&mut self.backlog, permit)?;
                }
                Some(command) = self.commands.recv() => {
                    self.keep(command);
                    if self.is_over() {
                        return Err(End::Finished);
                    }
                }
            }
        }
    }

    /// Takes a command for later.
    fn keep(&mut self, command: Command) {
        match command {
            Command::Update(status) => drop(self.book.update(status)),
            Command::Message(_) => tracing::warn!("a message is lost: the agent is away"),
            Command::Finish(grace) => self.finish_by = Some(Instant::now() + grace),
        }
    }

    fn is_over(&self) -> bool {
        self.finish_by.is_some_and(|by| self.book.is_settled() || Instant::now() >= by)
    }

    async fn connect(&mut self) -> Result<Infallible, End> {
        let (reader, mut writer) = UnixStream::connect(&self.socket).await?.into_split();
        let mut frames = Frames::new(reader);
        // What was said before the agent was back belongs into the Register.
        while let Ok(command) = self.commands.try_recv() {
            self.keep(command);
        }
        let events = self.events.clone();
        say(&mut writer, Say::Register(self.book.register(&self.token))).await?;
        loop {
            if self.is_over() {
                return Err(End::Finished);
            }
            let finish_by = self.finish_by.unwrap_or_else(|| Instant::now() + PATIENCE);
            // Every arm is cancel-safe: half a frame stays in the frames, permits and commands are taken whole or not at
            // all. What an arm writes, it writes before the next wait.
            tokio::select! {
                event = frames.next::<proto::Event>(), if self.backlog.is_empty() => match event? {
                    Some(proto::Event { event: Some(event) }) => self.hear(event),
                    Some(_) => tracing::warn!("the agent says something newer than this SDK"),
                    None => return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()),
                },
                permit = events.reserve(), if !self.backlog.is_empty() => {
                    hand_out(&mut self.backlog, permit)?;
                }
                Some(command) = self.commands.recv() => self.command(command, &mut writer).await?,
                () = sleep_until(finish_by), if self.finish_by.is_some() => {}
            }
        }
    }

    fn hear(&mut self, event: Hear) {
        let millis = |ms: u32| Duration::from_millis(ms.into());
        let event = match event {
            Hear::Registered(registered) => self.heard_registered(registered),
            Hear::Launch(launch) => {
                if !self.book.launched(&launch.task) {
                    return;
                }
                Event::Launch(launch)
            }
            Hear::Kill(kill) => {
                Event::Kill { task: kill.task, grace: millis(kill.grace_period_ms) }
            }
            Hear::Message(message) => Event::Message(message.data),
            Hear::Acknowledged(acknowledged) => {
                return self.book.acknowledged(acknowledged.sequence);
            }
            Hear::Shutdown(shutdown) => Event::Shutdown(millis(shutdown.grace_period_ms)),
        };
        self.backlog.push_back(event);
    }

    fn heard_registered(&mut self, registered: proto::Registered) -> Event {
        self.connected = true;
        if std::mem::replace(&mut self.registered, true) {
            return Event::Reregistered;
        }
        let proto::Registered { executor, namespace, framework, framework_id, node, .. } =
            registered;
        Event::Registered(Registration { executor, namespace, framework, framework_id, node })
    }

    async fn command(&mut self, command: Command, writer: &mut OwnedWriteHalf) -> io::Result<()> {
        match command {
            Command::Update(status) => {
                let update = self.book.update(status);
                say(writer, Say::StatusUpdate(update)).await
            }
            Command::Message(data) if data.len() > MAX_MESSAGE => {
                tracing::warn!(bytes = data.len(), "a message is too long, and is lost");
                Ok(())
            }
            Command::Message(data) => say(writer, Say::Message(proto::Message { data })).await,
            Command::Finish(grace) => {
                self.finish_by = Some(Instant::now() + grace);
                Ok(())
            }
        }
    }
}

fn hand_out(
    backlog: &mut VecDeque<Event>,
    permit: Result<mpsc::Permit<'_, Event>, mpsc::error::SendError<()>>,
) -> Result<(), End> {
    // Without the executor's code there is nothing left to do.
    let permit = permit.map_err(|_| End::Finished)?;
    if let Some(event) = backlog.pop_front() {
        permit.send(event);
    }
    Ok(())
}

async fn say(writer: &mut OwnedWriteHalf, call: Say) -> io::Result<()> {
    timeout(PATIENCE, frame::write(writer, &proto::Call { call: Some(call) })).await?
}
