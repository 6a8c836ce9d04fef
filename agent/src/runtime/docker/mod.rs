//! Containers of a Docker Engine. The engine outlives the agent, so a container needs no shim: its
//! name is the attempt, which makes a second launch of it impossible.
//!
//! | module | holds |
//! |---|---|
//! | [`engine`] | the connection, the stream of events, whether the engine is there |
//! | [`create`] | a launch as the engine wants it |
//! | [`inspect`] | what the engine says of a container, as the core wants it |
//! | [`exec`] | programs inside a running container: its checks |
//! | [`interact`], [`hijack`] | the same for clients, with their input and output |
//! | [`guard`] | the process that ends a container when the agent cannot |
//!
//! Level-triggered: an event only says which container to look at; after every reconnection each is
//! looked at. An end is told when the engine says so *and* the kernel shows the group empty.

mod create;
mod engine;
mod exec;
mod guard;
mod hijack;
mod inspect;
mod interact;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bollard::Docker;
use bollard::query_parameters::{
    CreateContainerOptionsBuilder, CreateImageOptionsBuilder, KillContainerOptionsBuilder,
    LogsOptionsBuilder, RemoveContainerOptionsBuilder, StopContainerOptionsBuilder,
};
use bytes::Bytes;
use futures::future::{BoxFuture, FutureExt};
use futures::stream::{BoxStream, StreamExt, TryStreamExt};
use muster_agent_core::desired::StopTimes;
use muster_agent_core::observed::{End, Exit, Loss, Observed, Started};
use muster_agent_core::workload::Failure;
use muster_api::id::TaskUid;
use muster_failpoint::{Failpoint, Step, reach};
use tokio::sync::Notify;

use super::cgroup::group::Group;
use super::process::{KEPT_ATTEMPTS, Reexec};
use super::{
    AttemptId, Executed, IMAGE_PULL_FAILED, Launch, Launched, Limits, LogQuery, Reached, Runtime,
    RuntimeError, RuntimeStatus, Used,
};
use crate::clock;
use crate::driver::chain;
use crate::exec::ends::{Ends, Invocation, Outlet, Ran};
use crate::given::files::Place;
use crate::runtime::launch::{Container, Network, Program, Pull};
use engine::Engine;
use inspect::Seen;

/// Between an engine's hearing of a container's end and of why the kernel killed it.
const HEARD_WITHIN: Duration = Duration::from_millis(200);

/// What the runtime is made of.
#[derive(Debug)]
pub(crate) struct DockerConfig {
    /// Absent: no Docker.
    pub(crate) socket: Option<PathBuf>,
    /// The agent's: names its containers.
    pub(crate) identity: String,
    /// Holds `<uid>/run`, which containers see.
    pub(crate) tasks: PathBuf,
    pub(crate) files: Place,
    pub(crate) reexec: Reexec,
    pub(crate) contact: PathBuf,
}

/// The runtime. Cheap to clone; all clones are one.
#[derive(Debug, Clone)]
pub(crate) struct DockerRuntime(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    config: DockerConfig,
    engine: Engine,
    live: Mutex<BTreeMap<AttemptId, Live>>,
    boot_id: String,
    /// Guards of this life of the agent, to be taken out of the process table.
    guards: Mutex<Vec<Child>>,
}

/// A container that somebody waits for.
#[derive(Debug, Clone, Default)]
struct Live {
    group: Option<Group>,
    changed: Arc<Notify>,
}

impl DockerRuntime {
    pub(crate) fn new(config: DockerConfig) -> DockerRuntime {
        let engine = Engine::new(config.socket.clone());
        let boot_id = clock::boot_id();
        DockerRuntime(Arc::new(Inner {
            config,
            engine,
            live: Mutex::default(),
            boot_id,
            guards: Mutex::default(),
        }))
    }

    fn live(&self) -> MutexGuard<'_, BTreeMap<AttemptId, Live>> {
        self.0.live.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn watched(&self, id: &AttemptId) -> Live {
        self.live().entry(id.clone()).or_default().clone()
    }

    fn name(&self, id: &AttemptId) -> String {
        format!("muster-{}-{id}", self.0.config.identity)
    }

    fn client(&self) -> Result<Docker, RuntimeError> {
        let error = |source| RuntimeError::new("reach the Docker Engine", source);
        self.0.engine.client().map_err(error)
    }

    fn socket(&self) -> Result<&Path, RuntimeError> {
        let socket = self.0.config.socket.as_deref();
        socket.ok_or_else(|| RuntimeError::new("reach the Docker Engine", "there is none"))
    }

    async fn fetch(&self, image: &str, pull: Pull) -> Result<(), Failure> {
        let failed = |message: String| Failure {
            reason: IMAGE_PULL_FAILED.to_owned(),
            message: format!("image {image:?}: {message}"),
            retry: true,
        };
        let docker = self.client().map_err(|error| self.unavailable(&error))?;
        let present = match docker.inspect_image(image).await {
            Ok(_) => true,
            Err(error) if inspect::is_missing(&error) => false,
            Err(error) => return Err(self.unavailable(&error)),
        };
        match (pull, present) {
            (Pull::Never, false) => {
                return Err(failed("it is not on this node, and pullPolicy is Never".to_owned()));
            }
            (Pull::Never | Pull::IfNotPresent, true) => return Ok(()),
            (Pull::IfNotPresent, false) | (Pull::Always, _) => {}
        }
        let (image, tag) = create::image_and_tag(image);
        let options = CreateImageOptionsBuilder::new().from_image(image).tag(tag).build();
        let mut progress = docker.create_image(Some(options), None, None).boxed();
        while let Some(step) = progress.next().await {
            step.map_err(|error| failed(chain(&error)))?;
        }
        Ok(())
    }

    fn unavailable(&self, error: &dyn std::error::Error) -> Failure {
        Failure {
            reason: "RuntimeUnavailable".to_owned(),
            message: chain(error),
            // Without a socket there will be none later either.
            retry: self.0.config.socket.is_some(),
        }
    }

    async fn launch(&self, launch: &Launch) -> Launched {
        let docker = match self.client() {
            Ok(docker) => docker,
            Err(error) => return Launched::Refused(self.unavailable(&error)),
        };
        let name = self.name(&launch.id);
        let launch = &self.with_user(&docker, launch).await;
        let written = self.0.config.files.write(launch, None);
        let body = match written.and_then(|()| create::body(launch, &self.0.config)) {
            Ok(body) => body,
            Err(failure) => return Launched::Refused(failure),
        };
        if let Some(old) = launch.id.attempt.checked_sub(KEPT_ATTEMPTS).filter(|old| *old > 0) {
            let old = AttemptId { uid: launch.id.uid.clone(), attempt: old };
            // Older logs go; a failure only keeps them longer.
            let _ = self.remove_container(&docker, &self.name(&old)).await;
        }
        let options = CreateContainerOptionsBuilder::new().name(&name).build();
        reach(Failpoint::ContainerCreation, Step::Before);
        if let Err(error) = docker.create_container(Some(options), body).await {
            return match inspect::refusal(&error) {
                Some((409, _)) => Launched::Unclear(RuntimeError::new("create a container", error)),
                Some((404, message)) => {
                    let reason = "ImageMissing".to_owned();
                    Launched::Unprepared(Failure { reason, message, retry: true })
                }
                Some((_, message)) => refused("CreateContainerError", message, false),
                None if inspect::never_sent(&error) => Launched::Refused(self.unavailable(&error)),
                None => Launched::Unclear(RuntimeError::new("create a container", error)),
            };
        }
        reach(Failpoint::ContainerCreation, Step::After);
        self.start(&docker, &name, launch).await
    }

    /// The launch with its user, or with the image's when there are files to be handed over to it. An image that is missing
    /// shows when the container is created.
    async fn with_user(&self, docker: &Docker, launch: &Launch) -> Launch {
        let mut launch = launch.clone();
        let files = launch.given.as_ref().is_some_and(|given| !given.files.is_empty());
        let Program::Container(container) = &mut launch.program else { return launch };
        if let Some(user) = &container.run_as {
            container.user = create::user_ids(user);
        } else if files {
            let image = docker.inspect_image(&container.image).await.ok();
            let user = image.and_then(|image| image.config?.user).unwrap_or_default();
            container.user = create::user_ids(&user);
        }
        launch
    }

    async fn start(&self, docker: &Docker, name: &str, launch: &Launch) -> Launched {
        reach(Failpoint::ContainerStart, Step::Before);
        if let Err(error) = docker.start_container(name, None).await {
            return match inspect::refusal(&error) {
                // The engine's words: a program that is not there, a mount that is not, …
                Some((_, message)) => Launched::Ended(not_started(message)),
                None => Launched::Unclear(RuntimeError::new("start a container", error)),
            };
        }
        reach(Failpoint::ContainerStart, Step::After);
        if launch.stop_after_ms.is_some() {
            // Before the task is said to run: it must not run a moment that nobody would end.
            if let Err(error) = self.guard(docker, launch).await {
                tracing::error!(id = %launch.id, error = chain(&error), "no guard; it is ended");
                if let Err(error) = self.kill(docker, &launch.id).await {
                    return Launched::Unclear(error);
                }
            }
        }
        Launched::Running(Started { at: clock::wall() })
    }

    /// Starts the process that ends the container when contact is lost and the agent cannot.
    async fn guard(&self, docker: &Docker, launch: &Launch) -> Result<(), RuntimeError> {
        let what = "guard a container";
        let name = self.name(&launch.id);
        let seen = inspect::inspect(docker, &name).await.map_err(|e| RuntimeError::new(what, e))?;
        let Some(Seen::Running { pid, .. }) = seen else { return Ok(()) };
        let Some(group) = self.group_of(&launch.id, pid) else { return Ok(()) };
        let started = guard::start(&self.0.config, &self.0.boot_id, launch, pid, group).await;
        let started = started.map_err(|error| RuntimeError::new(what, error))?;
        let mut guards = self.0.guards.lock().unwrap_or_else(PoisonError::into_inner);
        guards.retain_mut(|guard| matches!(guard.try_wait(), Ok(None)));
        guards.extend(started);
        Ok(())
    }

    fn group_of(&self, id: &AttemptId, pid: i32) -> Option<Group> {
        let group = super::cgroup::hierarchy::group_of(pid);
        self.live().entry(id.clone()).or_default().group.clone_from(&group);
        group
    }

    async fn find(&self, launch: &Launch) -> Result<Observed, RuntimeError> {
        let what = "find a container";
        let docker = self.client()?;
        let name = self.name(&launch.id);
        match inspect::inspect(&docker, &name).await.map_err(|e| RuntimeError::new(what, e))? {
            None => Ok(Observed::NeverStarted),
            Some(Seen::Created) => {
                self.remove_container(&docker, &name).await?;
                Ok(Observed::NeverStarted)
            }
            Some(Seen::Running { pid, at }) => {
                self.group_of(&launch.id, pid);
                if launch.stop_after_ms.is_some() {
                    self.guard(&docker, launch).await?;
                }
                Ok(Observed::Running(Started { at }))
            }
            Some(Seen::Ended(exit)) => Ok(Observed::Ended(self.ended(&launch.id, exit))),
        }
    }

    /// An exit as the engine tells it, with what only this node knows.
    fn ended(&self, id: &AttemptId, exit: Exit) -> Exit {
        let disconnected = guard::ended_it(&self.0.config, id);
        Exit { disconnected, ..exit }
    }

    /// An exit by SIGKILL, looked at once more: the engine hears that memory ran out and that the container ended by two ways.
    async fn ended_by_kill(&self, name: &str, exit: Exit) -> Exit {
        if exit.end != End::Signaled(libc::SIGKILL) || exit.oom_killed {
            return exit;
        }
        tokio::time::sleep(HEARD_WITHIN).await;
        let Ok(docker) = self.client() else { return exit };
        match inspect::inspect(&docker, name).await {
            Ok(Some(Seen::Ended(again))) => again,
            _ => exit,
        }
    }

    async fn wait(&self, launch: &Launch) -> Exit {
        let id = &launch.id;
        let name = self.name(id);
        let changed = self.watched(id).changed;
        loop {
            // Asked for before the look, so that a change after the look is not missed.
            let next = changed.notified();
            let looked = match self.client() {
                Ok(docker) => inspect::inspect(&docker, &name).await.map_err(|e| chain(&e)),
                Err(error) => Err(chain(&error)),
            };
            match looked {
                Ok(Some(Seen::Ended(exit))) => {
                    self.wait_empty(id).await;
                    // Without a limit there is no memory that runs out.
                    let exit = match launch.limits.memory_bytes {
                        Some(_) => self.ended_by_kill(&name, exit).await,
                        None => exit,
                    };
                    self.live().remove(id);
                    return self.ended(id, exit);
                }
                Ok(Some(Seen::Running { pid, .. })) => {
                    if self.watched(id).group.is_none() {
                        self.group_of(id, pid);
                    }
                    next.await;
                }
                // Created: its start is under way, and an event follows.
                Ok(Some(Seen::Created)) => next.await,
                Ok(None) => {
                    self.wait_empty(id).await;
                    self.live().remove(id);
                    return self.ended(id, lost());
                }
                Err(error) => {
                    // The engine is away; the reconnection wakes everybody.
                    tracing::debug!(%id, error, "a container cannot be seen");
                    next.await;
                }
            }
        }
    }

    /// The engine tells an end when the first process is gone; the kernel has the last word.
    async fn wait_empty(&self, id: &AttemptId) {
        let Some(group) = self.watched(id).group else { return };
        let mut pause = Duration::from_millis(1);
        while !group.is_empty() {
            group.kill();
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(Duration::from_millis(200));
        }
    }

    async fn kill(&self, docker: &Docker, id: &AttemptId) -> Result<(), RuntimeError> {
        let options = KillContainerOptionsBuilder::new().signal("SIGKILL").build();
        match docker.kill_container(&self.name(id), Some(options)).await {
            Err(error) if !inspect::is_over(&error) => {
                Err(RuntimeError::new("kill a container", error))
            }
            _ => Ok(()),
        }
    }

    async fn stop(&self, id: &AttemptId, times: StopTimes) -> Result<(), RuntimeError> {
        let docker = self.client()?;
        // With the agent goes this wait; the next one asks its executor anew.
        tokio::time::sleep(Duration::from_millis(times.signal_ms)).await;
        let grace = Duration::from_millis(times.kill_ms.saturating_sub(times.signal_ms));
        if grace < Duration::from_secs(1) {
            // The engine knows whole seconds only: a fraction of one is none.
            return self.kill(&docker, id).await;
        }
        let seconds = i32::try_from(grace.as_secs()).unwrap_or(i32::MAX);
        let options = StopContainerOptionsBuilder::new().t(seconds).build();
        let name = self.name(id);
        // The engine carries its own ladder on when the caller goes away. It answers at the end of
        // it, or at once with an error: nobody has to wait for the end here.
        let stop = docker.stop_container(&name, Some(options));
        match tokio::time::timeout(Duration::from_millis(500), stop).await {
            Ok(Err(error)) if !inspect::is_over(&error) => {
                Err(RuntimeError::new("stop a container", error))
            }
            _ => Ok(()),
        }
    }

    async fn remove_container(&self, docker: &Docker, name: &str) -> Result<(), RuntimeError> {
        let options = RemoveContainerOptionsBuilder::new().force(true).v(true).build();
        reach(Failpoint::ContainerRemoval, Step::Before);
        match docker.remove_container(name, Some(options)).await {
            Err(error) if !inspect::is_missing(&error) => {
                return Err(RuntimeError::new("remove a container", error));
            }
            _ => {}
        }
        reach(Failpoint::ContainerRemoval, Step::After);
        Ok(())
    }

    async fn remove(&self, uid: &TaskUid) -> Result<(), RuntimeError> {
        if self.0.config.socket.is_none() {
            return Ok(());
        }
        let docker = self.client()?;
        let filter = format!("{}={uid}", create::LABEL_UID);
        let names = engine::names(&docker, &self.0.config.identity, Some(&filter));
        for (name, _) in names.await.map_err(|e| RuntimeError::new("list containers", e))? {
            self.remove_container(&docker, &name).await?;
        }
        Ok(())
    }

    /// Follows the engine until it is dropped: keeps its status, wakes who waits for a container,
    /// and at the first contact removes containers of tasks that this agent does not know.
    pub(crate) async fn run(&self) {
        let wake = |id: Option<&AttemptId>| {
            for (known, live) in self.live().iter() {
                if id.is_none_or(|id| id == known) {
                    live.changed.notify_one();
                }
            }
        };
        let sweep = || self.sweep();
        self.0.engine.run(&self.0.config.identity, wake, sweep).await;
    }

    async fn sweep(&self) {
        let Ok(docker) = self.client() else { return };
        let Ok(found) = engine::names(&docker, &self.0.config.identity, None).await else { return };
        for (name, uid) in found {
            if !self.0.config.tasks.join(&uid).join("task.json").exists() {
                tracing::info!(%name, "a container of no task is removed");
                if let Err(error) = self.remove_container(&docker, &name).await {
                    tracing::warn!(%name, error = chain(&error), "it stays behind");
                }
            }
        }
    }
}

fn refused(reason: &str, message: String, retry: bool) -> Launched {
    Launched::Refused(Failure { reason: reason.to_owned(), message, retry })
}

fn not_started(message: String) -> Exit {
    Exit {
        end: End::NotStarted { message },
        oom_killed: false,
        disconnected: false,
        started_at: None,
        finished_at: clock::wall(),
    }
}

fn lost() -> Exit {
    Exit { end: End::Lost(Loss::Container), ..not_started(String::new()) }
}

impl Runtime for DockerRuntime {
    fn status(&self) -> RuntimeStatus {
        self.0.engine.status()
    }

    fn prepare<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<(), Failure>> {
        match &launch.program {
            Program::Container(Container { image, pull, .. }) => self.fetch(image, *pull).boxed(),
            Program::Process { .. } | Program::Work(_) => futures::future::ready(Ok(())).boxed(),
        }
    }

    fn fetch<'a>(&'a self, image: &'a str, pull: Pull) -> BoxFuture<'a, Result<(), Failure>> {
        self.fetch(image, pull).boxed()
    }

    fn launch<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Launched> {
        self.launch(launch).boxed()
    }

    fn find<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<Observed, RuntimeError>> {
        self.find(launch).boxed()
    }

    fn wait<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Exit> {
        self.wait(launch).boxed()
    }

    fn stop<'a>(
        &'a self,
        id: &'a AttemptId,
        times: StopTimes,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        self.stop(id, times).boxed()
    }

    fn resize<'a>(
        &'a self,
        id: &'a AttemptId,
        limits: &'a Limits,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        async move {
            let (docker, name) = (self.client()?, self.name(id));
            let update = docker.update_container(&name, create::update(limits));
            update.await.map_err(|error| RuntimeError::new("change a container's limits", error))
        }
        .boxed()
    }

    fn exec<'a>(
        &'a self,
        launch: &'a Launch,
        argv: &'a [String],
        until: BoxFuture<'a, ()>,
    ) -> BoxFuture<'a, Result<Executed, RuntimeError>> {
        async move {
            let docker = self.client()?;
            exec::exec(&docker, &self.name(&launch.id), argv, until).await
        }
        .boxed()
    }

    fn has_processes(&self) -> bool {
        true
    }

    fn has(&self, id: &AttemptId, pid: i32) -> Option<bool> {
        let group = self.live().get(id)?.group.clone()?;
        Some(group.pids().contains(&pid))
    }

    fn interact<'a>(
        &'a self,
        id: &'a AttemptId,
        invocation: &'a Invocation,
        ends: Ends,
        until: BoxFuture<'a, ()>,
    ) -> BoxFuture<'a, Result<Ran, RuntimeError>> {
        async move {
            let engine = (&self.client()?, self.socket()?);
            interact::interact(engine, &self.name(id), invocation, ends, until).await
        }
        .boxed()
    }

    fn attach<'a>(
        &'a self,
        id: &'a AttemptId,
        output: &'a Outlet,
    ) -> BoxFuture<'a, Result<(), RuntimeError>> {
        async move { interact::attach(self.socket()?, &self.name(id), output).await }.boxed()
    }

    fn network<'a>(&'a self, launch: &'a Launch) -> BoxFuture<'a, Result<Reached, RuntimeError>> {
        async move {
            if matches!(&launch.program, Program::Container(c) if c.network == Network::Host) {
                return Ok(Reached::Here);
            }
            exec::network(&self.client()?, &self.name(&launch.id)).await
        }
        .boxed()
    }

    fn remove<'a>(&'a self, uid: &'a TaskUid) -> BoxFuture<'a, Result<(), RuntimeError>> {
        self.remove(uid).boxed()
    }

    fn used(&self, id: &AttemptId) -> Option<Used> {
        let group = self.live().get(id)?.group.clone()?;
        group.used()
    }

    fn logs(&self, id: &AttemptId, query: LogQuery) -> BoxStream<'static, std::io::Result<Bytes>> {
        let docker = match self.client() {
            Ok(docker) => docker,
            Err(error) => {
                let error = Err(std::io::Error::other(chain(&error)));
                return futures::stream::once(futures::future::ready(error)).boxed();
            }
        };
        let tail = query.tail.map_or_else(|| "all".to_owned(), |tail| tail.to_string());
        let since = query.since.map_or(0, |since| i32::try_from(since.as_second()).unwrap_or(0));
        let options = LogsOptionsBuilder::new()
            .stdout(true)
            .stderr(true)
            .follow(query.follow)
            .timestamps(query.timestamps)
            .tail(&tail)
            .since(since)
            .build();
        let name = self.name(id);
        docker
            .logs(&name, Some(options))
            .map_ok(bollard::container::LogOutput::into_bytes)
            .map_err(std::io::Error::other)
            .boxed()
    }
}
