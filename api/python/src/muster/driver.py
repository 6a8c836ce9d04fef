"""The driver: what a framework does, and who calls its scheduler.

Threads: ``muster-session`` reads the session (see ``_session``), ``muster-callbacks`` calls the scheduler. Actions may
be called from any thread, callbacks included, and never wait for the network.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Callable, Optional, Union

from muster import _inbox as inbox
from muster import _wire, kubeconfig
from muster._calls import Calls, Result
from muster._inbox import Inbox
from muster._life import MOST_MESSAGE_BYTES, STOP_SECONDS, DriverState, Life
from muster._pb import framework as pb
from muster._session import Books, Session
from muster._state_file import StateFile
from muster.errors import FrameworkError
from muster.kubeconfig import AnyPath
from muster.model import Filter, FrameworkInfo, LaunchResult, Offer, Position, TaskStatus
from muster.position import PositionSource
from muster.scheduler import Scheduler
from muster.task import TaskInfo

log = logging.getLogger("muster")


class SchedulerDriver(Life):
    """A framework's session with the controller.

    ``state_file`` keeps the framework's id, so that the program, started again, comes back to its tasks. With
    ``implicit_acknowledgements=False`` the scheduler calls ``acknowledge_status_update`` itself.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        framework: FrameworkInfo,
        kubeconfig: Optional[AnyPath] = None,
        *,
        implicit_acknowledgements: bool = True,
        state_file: Optional[AnyPath] = None,
    ) -> None:
        super().__init__()
        self._scheduler = scheduler
        self._kubeconfig = kubeconfig
        self._implicit = implicit_acknowledgements
        self._failover = False
        self._sources: list[PositionSource] = []
        kept = None if state_file is None else StateFile(Path(state_file))
        self._books = Books(framework, Calls(self._defer), Inbox(), kept)
        self._session = Session(self._books, self._target)

    # Life.

    @property
    def framework_id(self) -> str:
        """Empty until registered."""
        return self._books.info.framework_id

    def follow(self, source: PositionSource) -> None:
        """Takes operation positions from ``source`` while the driver runs. Before ``start``."""
        self._must_be_new()
        self._sources.append(source)

    def start(self) -> DriverState:
        """Connects in the background. ConfigError, now, when kubeconfig or state file cannot be used."""
        self._must_be_new()
        self._target()
        if self._books.state_file is not None and not self.framework_id:
            framework_id = self._books.state_file.read(self._books.info)
            self._books.change(lambda info: replace(info, framework_id=framework_id))
        self._begin(
            {
                "muster-session": lambda: self._guarded(self._session.run),
                "muster-callbacks": self._call_back,
            }
        )
        for source in self._sources:
            source.start(self._moved)
        return self.state

    def stop(self, failover: bool = False) -> DriverState:
        """Ends the driver after the callback that runs; does not wait (``join`` does).

        ``stop()`` ends the framework: its tasks are killed. ``stop(failover=True)`` only disconnects; the tasks go on
        for the failover timeout, until a framework with this id comes back.
        """
        with self._changed:
            if self._turn(DriverState.STOPPING):
                self._failover = failover
        self._close()
        return self.state

    def abort(self) -> DriverState:
        """Disconnects at once, as if the program had been killed. No callback begins after this."""
        self._turn(DriverState.ABORTED)
        self._close()
        self._session.abort()
        return self.state

    # Actions. What the controller answers is in the result; nobody has to look at it.

    def launch_tasks(
        self,
        offer_ids: Union[str, Offer, Iterable[Union[str, Offer]]],
        tasks: Union[TaskInfo, Sequence[TaskInfo]],
        refuse_seconds: float = 0.0,
    ) -> Result[LaunchResult]:
        """Launches on what was offered: all of the tasks, or none. What is left is offered again.

        Of several offers, ``task.on(offer)`` says which.
        """
        wanted = [tasks] if isinstance(tasks, TaskInfo) else tasks
        call = _wire.accept(_ids(offer_ids), wanted, refuse_seconds)
        return self._books.calls.submit(call, _wire.launch_result, repeatable=False)

    def decline_offer(
        self, offer_ids: Union[str, Offer, Iterable[Union[str, Offer]]], refuse_seconds: Optional[float] = None
    ) -> Result[None]:
        """Not offered again for ``refuse_seconds`` (None: 5), unless what was refused has changed."""
        decline = pb.Decline(offers=_ids(offer_ids), refuse_seconds=refuse_seconds)
        return self._books.calls.submit(pb.Call(decline=decline), _wire.nothing, repeatable=False)

    def revive_offers(self) -> Result[None]:
        """Offers are wanted again, of everything: forgets what was declined, ends ``suppress_offers``."""
        return self._submit(pb.Call(revive=pb.Revive()))

    def suppress_offers(self) -> Result[None]:
        """No offers until ``revive_offers``; those outstanding are rescinded."""
        return self._submit(pb.Call(suppress=pb.Suppress()))

    def set_filter(self, filter: Filter) -> Result[None]:
        """What a node must have to be offered, from now on."""
        call = pb.Call(set_filter=pb.SetFilter(filter=_wire.offer_filter(filter)))
        return self._change(call, lambda info: replace(info, filter=filter))

    def request_resources(self, request: Filter) -> Result[None]:
        """``set_filter`` and ``revive_offers``: offers of nodes that have this much."""
        filtered = self.set_filter(request)
        revived = self.revive_offers()
        result: Result[None] = Result(self._defer)

        # Answers come in order: the filter's is there when the other's is.
        def both(_: object) -> None:
            failure = filtered.exception() or revived.exception()
            if failure is None:
                result.set_result(None)
            else:
                result.set_exception(failure)

        # At once, and not on the callback thread, which may be waiting for the result.
        revived.on_done(both)
        return result

    def set_position(self, position: Optional[Position]) -> Result[None]:
        """Where the framework works from now on; None: everywhere."""
        wire = None if position is None else _wire.position(position, self._books.info.radius)
        call = pb.Call(set_position=pb.SetPosition(position=wire))
        return self._change(call, lambda info: replace(info, position=position))

    def kill_task(self, task_id: str, grace_seconds: Optional[int] = None) -> Result[None]:
        """Is said again after a broken session, until the controller has heard it."""
        return self._submit(pb.Call(kill=pb.Kill(task=task_id, grace_period_seconds=grace_seconds)))

    def acknowledge_status_update(self, update: TaskStatus) -> None:
        """With ``implicit_acknowledgements=False``: the update is done with, and not repeated."""
        if self._implicit:
            raise RuntimeError("this driver acknowledges updates itself when status_update returns")
        self._acknowledge(update)

    def reconcile_tasks(self, task_ids: Collection[str] = ()) -> Result[None]:
        """Asks for an update of each of these tasks, or of all; it comes even if its state is no news."""
        self._books.seen.forget(task_ids)
        return self._submit(pb.Call(reconcile=pb.Reconcile(tasks=task_ids)))

    def send_framework_message(self, executor_id: str, data: bytes) -> Result[None]:
        """To one of this framework's executors: at most once, in order, up to 4 MiB."""
        if len(data) > MOST_MESSAGE_BYTES:
            raise ValueError(f"{len(data)} bytes are more than a message holds ({MOST_MESSAGE_BYTES})")
        message = pb.Message(executor=executor_id, data=data)
        return self._books.calls.submit(pb.Call(message=message), _wire.nothing, repeatable=False)

    # The paper's and Mesos' names.
    launchTasks = launch_tasks
    declineOffer = decline_offer
    reviveOffers = revive_offers
    suppressOffers = suppress_offers
    requestResources = request_resources
    setFilter = set_filter
    setPosition = set_position
    killTask = kill_task
    acknowledgeStatusUpdate = acknowledge_status_update
    reconcileTasks = reconcile_tasks
    sendFrameworkMessage = send_framework_message

    # Inside.

    def _target(self) -> kubeconfig.Target:
        # Read for every session: certificates are renewed while frameworks run.
        return kubeconfig.load(self._kubeconfig)

    def _submit(self, call: pb.Call) -> Result[None]:
        return self._books.calls.submit(call, _wire.nothing)

    def _change(self, call: pb.Call, change: Callable[[FrameworkInfo], FrameworkInfo]) -> Result[None]:
        """The next session says it as well, once the controller has agreed: a refused filter must not end us there."""

        def agreed(_: pb.Answer) -> None:
            self._books.change(change)

        return self._books.calls.submit(call, agreed)

    def _acknowledge(self, update: TaskStatus) -> None:
        self._books.seen.acknowledged(update.task_id, update.version)
        self._books.calls.acknowledge(update.task_id, update.version)

    def _moved(self, position: Position) -> None:
        self.set_position(position)

    def _close(self) -> None:
        for deferred in self._books.inbox.close():
            deferred.run()

    def _defer(self, run: Callable[[], None]) -> None:
        if not self._books.inbox.put(inbox.Deferred(run)):
            run()

    def _call_back(self) -> None:
        self._guarded(self._deliver_all)
        self._guarded(self._last_words)

    def _deliver_all(self) -> None:
        while True:
            event = self._books.inbox.take()
            if event is None:
                return
            self._deliver(event)

    def _last_words(self) -> None:
        """On the callback thread, so that the last callback's own calls and acknowledgement come before."""
        if self.state is DriverState.STOPPING:
            torn: Optional[Result[None]] = None
            if not self._failover and self.framework_id:
                torn = self._submit(pb.Call(teardown=pb.Teardown()))
            self._session.finish(torn, STOP_SECONDS)
            self._threads[0].join()
            if torn is not None and torn.exception() is None and self._books.state_file is not None:
                self._books.state_file.remove()
        for source in self._sources:
            source.stop()
        self._stopped()

    def _deliver(self, event: inbox.Event) -> None:
        scheduler = self._scheduler
        if isinstance(event, inbox.Updated):
            scheduler.status_update(self, event.status)
            if self._implicit:
                self._acknowledge(event.status)
        elif isinstance(event, inbox.Offered):
            scheduler.resource_offers(self, list(event.offers))
        elif isinstance(event, inbox.Rescinded):
            scheduler.offer_rescinded(self, event.offer_id, event.reason)
        elif isinstance(event, inbox.Message):
            scheduler.framework_message(self, event.executor, event.node, event.data)
        elif isinstance(event, inbox.NodeLost):
            scheduler.node_lost(self, event.node, event.message)
        elif isinstance(event, inbox.ExecutorLost):
            scheduler.executor_lost(self, event.executor, event.node, event.exit_code, event.message)
        elif isinstance(event, inbox.Moved):
            scheduler.moved(self, event.position, event.by)
        elif isinstance(event, inbox.Deferred):
            event.run()
        else:
            self._deliver_life(event)

    def _deliver_life(
        self, event: Union[inbox.Registered, inbox.Reregistered, inbox.Lost, inbox.Failed]
    ) -> None:
        if isinstance(event, inbox.Registered):
            self._scheduler.registered(self, event.framework_id)
        elif isinstance(event, inbox.Reregistered):
            self._scheduler.reregistered(self)
        elif isinstance(event, inbox.Lost):
            self._scheduler.disconnected(self)
        else:
            self._failed(event.error)

    def _failed(self, error: FrameworkError) -> None:
        log.error("the framework's session has ended for good: %s", error)
        self._scheduler.error(self, error.reason, error.message)
        self.abort()


def _ids(offers: Union[str, Offer, Iterable[Union[str, Offer]]]) -> list[str]:
    several = [offers] if isinstance(offers, (str, Offer)) else offers
    return [offer if isinstance(offer, str) else offer.id for offer in several]

