//! The actions of a framework.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;
use muster_api::wire::framework::v1 as proto;
use proto::call::Call as Say;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use crate::link::direct::Lanes;
use crate::link::session::Command;
use crate::{CallRefused, Filter, Launch, Position, PositionSource};

/// What a framework can do. Clones act for the same framework.
///
/// Calls made while there is no connection wait for it. Where the connection breaks before the answer, calls that may
/// be repeated are repeated; launches and messages fail with [`Reason::Disconnected`](crate::Reason::Disconnected).
#[derive(Debug, Clone)]
pub struct FrameworkHandle {
    commands: mpsc::Sender<Command>,
    lanes: Lanes,
    stop: CancellationToken,
}

/// # Errors
///
/// Every call fails with the controller's refusal, or with why there is no answer.
impl FrameworkHandle {
    pub(crate) fn new(
        commands: mpsc::Sender<Command>,
        lanes: Lanes,
        stop: CancellationToken,
    ) -> Self {
        FrameworkHandle { commands, lanes, stop }
    }

    async fn call(&self, say: Say) -> Result<Vec<proto::Launched>, CallRefused> {
        let (answer, answered) = oneshot::channel();
        let command = Command::Call { say: Box::new(say), answer };
        self.commands.send(command).await.map_err(|_| CallRefused::ended())?;
        answered.await.unwrap_or_else(|_| Err(CallRefused::ended()))
    }

    /// Launches tasks on the offers they name: all of them, or none. The offers are used up when it passes.
    pub async fn launch_tasks(
        &self,
        launches: impl IntoIterator<Item = Launch>,
    ) -> Result<Vec<proto::Launched>, CallRefused> {
        let launches: Vec<Launch> = launches.into_iter().collect();
        let offers: BTreeSet<&str> =
            launches.iter().map(Launch::offer).filter(|offer| !offer.is_empty()).collect();
        let offers = offers.into_iter().map(str::to_owned).collect();
        let launches = launches.into_iter().map(Launch::into_wire).collect();
        self.call(Say::Accept(proto::Accept { offers, launches, refuse_seconds: 0.0 })).await
    }

    /// Says no to an offer. Its node is not offered again for `refuse`, unless it changes; none: five seconds.
    pub async fn decline_offer(
        &self,
        offer: &proto::Offer,
        refuse: Option<Duration>,
    ) -> Result<(), CallRefused> {
        let refuse_seconds = refuse.map(|refuse| refuse.as_secs_f64());
        let decline = proto::Decline { offers: vec![offer.id.clone()], refuse_seconds };
        self.call(Say::Decline(decline)).await.map(drop)
    }

    /// Offers are wanted again, of everything: forgets what was declined and ends
    /// [`suppress_offers`](Self::suppress_offers).
    pub async fn revive_offers(&self) -> Result<(), CallRefused> {
        self.call(Say::Revive(proto::Revive {})).await.map(drop)
    }

    /// No offers until [`revive_offers`](Self::revive_offers).
    pub async fn suppress_offers(&self) -> Result<(), CallRefused> {
        self.call(Say::Suppress(proto::Suppress {})).await.map(drop)
    }

    /// Asks for offers like this: sets the filter and forgets what was declined.
    pub async fn request_resources(&self, filter: Filter) -> Result<(), CallRefused> {
        self.set_filter(filter).await?;
        self.revive_offers().await
    }

    /// Changes what a node must have to be offered.
    pub async fn set_filter(&self, filter: Filter) -> Result<(), CallRefused> {
        let filter = Some(filter.0);
        self.call(Say::SetFilter(proto::SetFilter { filter })).await.map(drop)
    }

    /// Moves the work; none: everywhere.
    pub async fn set_position(&self, position: Option<Position>) -> Result<(), CallRefused> {
        let position = position.map(|position| position.0);
        self.call(Say::SetPosition(proto::SetPosition { position })).await.map(drop)
    }

    /// Moves the work along with a source, until the source ends or a position is refused.
    pub async fn follow(&self, mut source: impl PositionSource) -> Result<(), CallRefused> {
        while let Some(position) = source.next().await {
            self.set_position(Some(position)).await?;
        }
        Ok(())
    }

    /// Ends a task, by its uid. Without a grace period the task's own holds.
    pub async fn kill_task(&self, task: &str, grace: Option<Duration>) -> Result<(), CallRefused> {
        // Rounded up: a task that was given some time is not killed at once.
        let seconds = |grace: Duration| {
            let whole = grace.as_secs() + u64::from(grace.subsec_nanos() > 0);
            u32::try_from(whole).unwrap_or(u32::MAX)
        };
        let grace_period_seconds = grace.map(seconds);
        self.call(Say::Kill(proto::Kill { task: task.to_owned(), grace_period_seconds }))
            .await
            .map(drop)
    }

    /// The update was taken care of: the controller need not repeat it. A [`SchedulerDriver`](crate::SchedulerDriver)
    /// does this by itself.
    pub async fn acknowledge_status_update(&self, update: &proto::Update) {
        let command = Command::Acknowledge { task: update.task.clone(), version: update.version };
        // After the framework's end there is nobody to tell.
        drop(self.commands.send(command).await);
    }

    /// Asks for the state of these tasks, by uid, or of all when none is named; the answers are updates.
    pub async fn reconcile_tasks(
        &self,
        tasks: impl IntoIterator<Item = String>,
    ) -> Result<(), CallRefused> {
        let tasks = tasks.into_iter().collect();
        self.call(Say::Reconcile(proto::Reconcile { tasks })).await.map(drop)
    }

    /// To one of the framework's executors, by its task's uid: at most once, in order, up to 4 MiB. The first messages pass the
    /// controller; meanwhile a connection to the executor's agent is made, which the following ones go over, also while
    /// the controller is away. Where that cannot be made or breaks, messages pass the controller again.
    ///
    /// `Ok`: the agent, or the controller on the way to it, has the message. With
    /// [`Reason::Disconnected`](crate::Reason::Disconnected) it may have come, or not.
    pub async fn send_framework_message(
        &self,
        executor: &str,
        data: impl Into<Bytes>,
    ) -> Result<(), CallRefused> {
        self.lanes.send(executor, data.into()).await
    }

    /// Ends the framework here and waits until its session is over. With `failover` its tasks go on until the failover
    /// timeout, for whoever comes back with its id. Without, they are killed and the framework is forgotten; the
    /// controller has to be reached for that, and the call waits for it.
    pub async fn stop(&self, failover: bool) -> Result<(), CallRefused> {
        if !failover {
            self.call(Say::Teardown(proto::Teardown {})).await?;
        }
        self.stop.cancel();
        self.commands.closed().await;
        Ok(())
    }
}
