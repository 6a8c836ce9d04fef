//! Callbacks instead of a stream, named as in the paper's Table I and in Mesos.

use std::future::Future;

use muster_api::wire::framework::v1 as proto;

use crate::{Event, EventStream, FrameworkError, FrameworkHandle};

/// A framework's scheduler. Callbacks run one after another, in the order in which things happened; each may call and
/// await any action of the handle. What is not implemented does nothing.
pub trait Scheduler: Send {
    /// The controller knows the framework now, under this id.
    fn registered(
        &mut self,
        _handle: &FrameworkHandle,
        _framework_id: &str,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// The framework is back and its tasks are still its own.
    fn reregistered(&mut self, _handle: &FrameworkHandle) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// The session broke; it is being made again. Every outstanding offer is gone.
    fn disconnected(&mut self, _handle: &FrameworkHandle) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// Nodes with room, the closest first.
    fn resource_offers(
        &mut self,
        _handle: &FrameworkHandle,
        _offers: Vec<proto::Offer>,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// An offer holds no more.
    fn offer_rescinded(
        &mut self,
        _handle: &FrameworkHandle,
        _offer: &str,
        _reason: proto::RescindReason,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// A task's state. Acknowledged when this returns, unless the driver was told otherwise.
    fn status_update(
        &mut self,
        _handle: &FrameworkHandle,
        _update: &proto::Update,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// From an executor; at most once.
    fn framework_message(
        &mut self,
        _handle: &FrameworkHandle,
        _message: proto::Message,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// A node does not answer. Its tasks' updates come by themselves.
    fn node_lost(
        &mut self,
        _handle: &FrameworkHandle,
        _lost: proto::NodeLost,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// Somebody else has set where the framework works. Offers for the old position are rescinded.
    fn moved(
        &mut self,
        _handle: &FrameworkHandle,
        _moved: &proto::Moved,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// An executor ended.
    fn executor_lost(
        &mut self,
        _handle: &FrameworkHandle,
        _lost: proto::ExecutorLost,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }

    /// The framework has ended; the driver returns after this.
    fn error(
        &mut self,
        _handle: &FrameworkHandle,
        _error: &FrameworkError,
    ) -> impl Future<Output = ()> + Send {
        async {}
    }
}

/// Calls a [`Scheduler`] back.
#[derive(Debug)]
pub struct SchedulerDriver {
    handle: FrameworkHandle,
    events: EventStream,
    acknowledge: bool,
}

impl SchedulerDriver {
    /// A driver of what [`connect`](crate::framework::Builder::connect) gave.
    #[must_use]
    pub fn new(handle: FrameworkHandle, events: EventStream) -> Self {
        SchedulerDriver { handle, events, acknowledge: true }
    }

    /// The scheduler acknowledges updates itself, for instance once they are on its disk.
    #[must_use]
    pub fn explicit_acknowledgement(mut self) -> Self {
        self.acknowledge = false;
        self
    }

    /// Runs until the framework is stopped.
    ///
    /// # Errors
    ///
    /// Why the framework ended by itself.
    pub async fn run(mut self, mut scheduler: impl Scheduler) -> Result<(), FrameworkError> {
        while let Some(event) = self.events.next().await {
            if let Event::Error(error) = event {
                scheduler.error(&self.handle, &error).await;
                return Err(error);
            }
            self.call_back(&mut scheduler, event).await;
        }
        Ok(())
    }

    async fn call_back(&self, scheduler: &mut impl Scheduler, event: Event) {
        let handle = &self.handle;
        match event {
            Event::Registered { framework_id } => scheduler.registered(handle, &framework_id).await,
            Event::Reregistered => scheduler.reregistered(handle).await,
            Event::Disconnected => scheduler.disconnected(handle).await,
            Event::Offers(offers) => scheduler.resource_offers(handle, offers).await,
            Event::Rescinded { offers, reason } => {
                for offer in &offers {
                    scheduler.offer_rescinded(handle, offer, reason).await;
                }
            }
            Event::Update(update) => {
                scheduler.status_update(handle, &update).await;
                if self.acknowledge {
                    handle.acknowledge_status_update(&update).await;
                }
            }
            Event::Message(message) => scheduler.framework_message(handle, message).await,
            Event::NodeLost(lost) => scheduler.node_lost(handle, lost).await,
            Event::Moved(moved) => scheduler.moved(handle, &moved).await,
            Event::ExecutorLost(lost) => scheduler.executor_lost(handle, lost).await,
            // Taken by the loop.
            Event::Error(_) => {}
        }
    }
}
