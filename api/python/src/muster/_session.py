"""Keeps a framework in session with the controller: connects, subscribes, reads, and begins again when that breaks.

Threads: the driver's session thread runs ``run``; gRPC's own thread sends what ``Calls`` has; each stream has a watch.
None of them calls the framework's code: events go to the ``Inbox``, answers to their ``Result``.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NoReturn, Optional

from muster import _inbox as inbox
from muster import _wire
from muster._backoff import Backoff
from muster._calls import Calls, Result
from muster._inbox import Inbox
from muster._pb import framework as pb
from muster._seen import Seen, Verdict
from muster._state_file import StateFile
from muster._stream import Stream
from muster.errors import ConfigError, Disconnected, FrameworkError, MusterError, WireError
from muster.kubeconfig import Target
from muster.model import FrameworkInfo, Offer

log = logging.getLogger("muster")

#: Until Subscribed; a controller that is there answers in milliseconds, over bad radio in seconds.
CONNECT_SECONDS = 20.0
#: A session without any event for so many heartbeat intervals is dead, as Mesos' clients count it.
MISSED_HEARTBEATS = 5
DEFAULT_HEARTBEAT_SECONDS = 15.0
#: Refusals of a Subscribe that a later one does not meet: the store is busy, an older framework of the name is ending.
_PASSING = ("Unavailable", "Ending")
_FORGOTTEN = "UnknownFramework"


@dataclass
class Books:
    """What outlives a session. ``info`` is what the next Subscribe says."""

    info: FrameworkInfo
    calls: Calls
    inbox: Inbox
    state_file: Optional[StateFile] = None
    seen: Seen = field(default_factory=Seen)
    #: Guards ``info``: framework threads move the position, the session thread writes the id.
    lock: threading.Lock = field(default_factory=threading.Lock)
    #: By which the controller knows this run again when its first Subscribed was lost.
    nonce: str = field(default_factory=lambda: str(uuid.uuid4()))

    def change(self, change: Callable[[FrameworkInfo], FrameworkInfo]) -> FrameworkInfo:
        with self.lock:
            self.info = change(self.info)
            return self.info


class Session:
    def __init__(self, books: Books, load: Callable[[], Target], backoff: Optional[Backoff] = None) -> None:
        self._books = books
        self._load = load
        self._backoff = backoff or Backoff()
        self._lock = threading.Lock()
        self._stream: Optional[Stream] = None
        self._end_by: Optional[float] = None
        self._teardown: Optional[Result[None]] = None
        self._woken = threading.Event()

    def run(self) -> None:
        """Until ``finish`` or ``abort``, or until the session ends for good."""
        try:
            while self._wanted():
                try:
                    self._once()
                except FrameworkError as error:
                    self._books.inbox.put(inbox.Failed(error))
                    return
                except Disconnected as lost:
                    if not self._ending():
                        log.warning("no session with the controller: %s", lost)
                if self._wanted():
                    self._woken.wait(self._pause())
        finally:
            self._books.calls.end()

    def finish(self, teardown: Optional[Result[None]], seconds: float) -> None:
        """Ends when all is said, or after ``seconds``. What ``teardown`` stands for is tried until then."""
        with self._lock:
            self._teardown = teardown
            self._end_by = time.monotonic() + seconds
            if self._stream is not None:
                self._stream.watch.end_at(self._end_by)
        self._books.calls.finish()
        self._woken.set()

    def abort(self) -> None:
        with self._lock:
            self._teardown = None
            self._end_by = time.monotonic()
            if self._stream is not None:
                self._stream.cancel("aborted")
        self._woken.set()

    def _ending(self) -> bool:
        with self._lock:
            return self._end_by is not None

    def _wanted(self) -> bool:
        with self._lock:
            if self._end_by is None:
                return True
            if self._teardown is None or self._teardown.done():
                return False
            if time.monotonic() < self._end_by:
                # `finish` woke the wait of a session that was to go on; these attempts have waits of their own.
                self._woken.clear()
                return True
            log.warning("the framework could not be torn down; its tasks end after its failover timeout")
            self._teardown = None
            return False

    def _pause(self) -> float:
        wait = self._backoff.next()
        with self._lock:
            return wait if self._end_by is None else min(wait, max(0.0, self._end_by - time.monotonic()))

    def _once(self) -> NoReturn:
        """One session, which ends with an exception in any case."""
        books = self._books
        try:
            target = self._load()
        except ConfigError as error:  # It was good at the start; it may be just being renewed.
            raise Disconnected(str(error)) from error
        with books.lock:
            subscribe = _wire.subscribe(books.info, books.nonce)
        stream = Stream(target, books.calls.open(subscribe), CONNECT_SECONDS)
        with self._lock:
            self._stream = stream
            if self._end_by is not None:
                stream.watch.end_at(self._end_by)
        subscribed = False
        try:
            for event in stream:
                if not subscribed:
                    self._subscribed(event, stream)
                    subscribed = True
                else:
                    self._event(event)
            raise Disconnected("the controller ended the session")
        except Disconnected:
            if subscribed:
                books.inbox.put(inbox.Lost())
            raise
        finally:
            with self._lock:
                self._stream = None
            stream.close()
            books.calls.lost()

    def _subscribed(self, event: pb.Event, stream: Stream) -> None:
        kind = event.WhichOneof("event")
        if kind == "error":
            raise self._refused(event.error)
        if kind != "subscribed" or not event.subscribed.framework_id:
            raise Disconnected(f"the session began with {kind}")
        answer = event.subscribed
        seconds = answer.heartbeat_interval_ms / 1000 or DEFAULT_HEARTBEAT_SECONDS
        stream.watch.allow(MISSED_HEARTBEATS * seconds)
        before = self._books.info.framework_id
        info = self._books.change(lambda info: replace(info, framework_id=answer.framework_id))
        if self._books.state_file is not None and not self._ending():
            self._books.state_file.write(info, answer.framework_id)
        if answer.reregistered:
            self._books.inbox.put(inbox.Reregistered())
        else:
            if before:
                log.warning("framework %s is gone; it begins anew as %s", before, answer.framework_id)
            self._books.seen.forget()
            self._books.inbox.put(inbox.Registered(answer.framework_id))
        self._books.calls.ready()

    def _refused(self, error: pb.Error) -> MusterError:
        """Of a Subscribe: whether to say it again."""
        why = FrameworkError(error.reason, error.message)
        if error.reason in _PASSING:
            return Disconnected(str(why))
        if error.reason == _FORGOTTEN and self._books.info.framework_id and not self._ending():
            # Away for longer than its failover timeout: its tasks are gone, and the work is still wanted.
            log.warning("the framework begins anew: %s", why)
            self._books.change(lambda info: replace(info, framework_id=""))
            return Disconnected(str(why))
        return why

    def _event(self, event: pb.Event) -> None:
        kind = event.WhichOneof("event")
        if kind == "answer":
            self._books.calls.answer(event.answer)
        elif kind == "heartbeat":
            # Only a session that lasted takes the blame off the connection.
            self._backoff.reset()
        elif kind == "error":
            raise FrameworkError(event.error.reason, event.error.message)
        elif kind == "update":
            self._update(event.update)
        elif kind == "rescind":
            for offer_id in event.rescind.offers:
                reason = _wire.rescind_reason(event.rescind.reason)
                self._books.inbox.put(inbox.Rescinded(offer_id, reason))
        elif kind is not None:
            self._tell(kind, event)

    def _tell(self, kind: str, event: pb.Event) -> None:
        put = self._books.inbox.put
        if kind == "offers":
            offers = _readable(event.offers)
            if offers:
                put(inbox.Offered(offers))
        elif kind == "message":
            said = event.message
            # A mark is for the session before, which exchanged messages with the agent directly.
            if not said.mark:
                put(inbox.Message(said.executor, said.node, said.data))
        elif kind == "node_lost":
            put(inbox.NodeLost(event.node_lost.node, event.node_lost.message))
        elif kind == "moved":
            self._moved(event.moved)
        elif kind == "executor_lost":
            lost = event.executor_lost
            code = lost.exit_code if lost.HasField("exit_code") else None
            put(inbox.ExecutorLost(lost.executor, lost.node, code, lost.message))

    def _moved(self, moved: pb.Moved) -> None:
        """The next session says it as well."""
        position = _wire.moved_to(moved)

        def change(info: FrameworkInfo) -> FrameworkInfo:
            anywhere = position is not None and position.radius is None
            return replace(info, position=position, radius=None if anywhere else info.radius)

        self._books.change(change)
        self._books.inbox.put(inbox.Moved(position, moved.by))

    def _update(self, update: pb.Update) -> None:
        try:
            status = _wire.task_status(update)
        except WireError as error:
            log.error("an update of task %s is left unacknowledged: %s", update.task, error)
            return
        verdict = self._books.seen.judge(status.task_id, status.version)
        if verdict is Verdict.DELIVER:
            self._books.inbox.put(inbox.Updated(status))
        elif verdict is Verdict.ACKNOWLEDGE_AGAIN:
            self._books.calls.acknowledge(status.task_id, status.version)


def _readable(offers: pb.Offers) -> tuple[Offer, ...]:
    """An offer of a kind that only newer controllers know is left to expire."""
    found = []
    for one in offers.offers:
        try:
            found.append(_wire.offer(one))
        except WireError as error:
            log.warning("an offer of %s is not understood: %s", one.node, error)
    return tuple(found)
