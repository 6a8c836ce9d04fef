"""What goes to the controller: calls that wait to be sent, calls that wait for their answer, acknowledgements.

A call that may be said twice (kill, set_filter, teardown, ...) survives a broken session and is sent again in the next
one. The others (launches, declines, messages) mean something in their session only, and fail with it.
"""

from __future__ import annotations

import itertools
import logging
import threading
from collections import OrderedDict, deque
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Callable, Optional, TypeVar

from muster import _wire
from muster._pb import framework as pb
from muster.errors import Disconnected, DriverNotRunning, MusterError, Overloaded

T = TypeVar("T")

log = logging.getLogger("muster")

MOST_CALLS = 4096
MOST_BYTES = 64 * 1024 * 1024


class Result(Future[T]):
    """What becomes of a call. ``result(timeout)`` waits for the controller's answer, and raises ``CallRefused`` or
    ``Disconnected``; it may be called in a callback. Nobody has to look at it.

    Functions of ``add_done_callback`` run on the callback thread.
    """

    def __init__(self, defer: Callable[[Callable[[], None]], None]) -> None:
        super().__init__()
        self._defer = defer
        # From here on it cannot be cancelled: it may be on its way.
        self.set_running_or_notify_cancel()

    def add_done_callback(self, fn: Callable[[Future[T]], object]) -> None:
        def later(done: Future[T]) -> None:
            self._defer(lambda: _ignore(fn(done)))

        super().add_done_callback(later)

    def on_done(self, fn: Callable[[Future[T]], object]) -> None:
        """For the driver itself: on the thread that brings the answer."""
        super().add_done_callback(fn)


def _ignore(_: object) -> None:
    """A done-callback's value means nothing."""


@dataclass
class _Waiting:
    call: pb.Call
    result: Result[Any]
    read: Callable[[pb.Answer], Any]
    repeatable: bool


class Calls:
    def __init__(self, defer: Callable[[Callable[[], None]], None]) -> None:
        self._changed = threading.Condition()
        self._defer = defer
        self._ids = itertools.count(1)
        self._session = 0
        self._ready = False
        self._finishing = False
        self._ended: Optional[MusterError] = None
        self._unsent: deque[pb.Call] = deque()
        self._unsent_bytes = 0
        self._acknowledgements: OrderedDict[str, int] = OrderedDict()
        #: No offers are wanted; the controller forgets this with the session.
        self._suppressed = False
        self._waiting: OrderedDict[str, _Waiting] = OrderedDict()

    def submit(self, call: pb.Call, read: Callable[[pb.Answer], T], *, repeatable: bool = True) -> Result[T]:
        """Never waits. What cannot be sent is a failed result."""
        result: Result[T] = Result(self._defer)
        with self._changed:
            overtaken = None if self._ready else self._overtaken(call)
            refused = self._refuse(call, repeatable)
            if refused is None:
                call.id = str(next(self._ids))
                self._waiting[call.id] = _Waiting(call, result, read, repeatable)
                if self._ready:
                    self._push(call)
        if overtaken is not None:
            overtaken.result.set_result(None)
        if refused is not None:
            result.set_exception(refused)
        return result

    def _overtaken(self, call: pb.Call) -> Optional[_Waiting]:
        """While there is no session, a newer wish takes an older one's place: a robot's goal may move for hours."""
        wish = _wish(call)
        if wish is None:
            return None
        older = next((id for id, waiting in self._waiting.items() if _wish(waiting.call) == wish), None)
        return None if older is None else self._waiting.pop(older)

    def _refuse(self, call: pb.Call, repeatable: bool) -> Optional[MusterError]:
        if self._ended is not None or self._finishing:
            return self._ended or DriverNotRunning("the driver is being stopped")
        if not self._ready and not repeatable:
            return Disconnected("there is no session")
        if len(self._waiting) >= MOST_CALLS or self._unsent_bytes + call.ByteSize() > MOST_BYTES:
            calls, unsent = len(self._waiting), self._unsent_bytes
            return Overloaded(f"{calls} calls wait for the controller, {unsent} bytes for the wire")
        return None

    def _push(self, call: pb.Call) -> None:
        self._unsent.append(call)
        self._unsent_bytes += call.ByteSize()
        self._changed.notify_all()

    def acknowledge(self, task_id: str, version: int) -> None:
        """Without a session it is forgotten: the update comes again."""
        with self._changed:
            if self._ready:
                self._acknowledgements[task_id] = max(version, self._acknowledgements.get(task_id, 0))
                self._changed.notify_all()

    def answer(self, answer: pb.Answer) -> None:
        with self._changed:
            waiting = self._waiting.pop(answer.id, None)
            if waiting is not None and not answer.HasField("refusal") and _wish(waiting.call) == "offers":
                self._suppressed = waiting.call.HasField("suppress")
            self._changed.notify_all()
        if waiting is None:
            return
        if answer.HasField("refusal"):
            refused = _wire.refusal(answer.refusal)
            log.info("%s is refused: %s", waiting.call.WhichOneof("call"), refused)
            waiting.result.set_exception(refused)
        else:
            waiting.result.set_result(waiting.read(answer))

    def open(self, subscribe: pb.Call) -> Iterator[pb.Call]:
        """Begins a session: what is to be sent in it."""
        with self._changed:
            self._session += 1
            self._unsent.clear()
            self._unsent_bytes = 0
            self._push(subscribe)
            return self._sending(self._session)

    def ready(self) -> None:
        """The session stands; calls from before it are said again."""
        with self._changed:
            self._ready = True
            if self._suppressed:
                # Without an id: nobody waits for it.
                self._push(pb.Call(suppress=pb.Suppress()))
            for waiting in self._waiting.values():
                self._push(waiting.call)

    def lost(self) -> None:
        with self._changed:
            self._session += 1
            self._ready = False
            self._acknowledgements.clear()
            failed = [id for id, waiting in self._waiting.items() if not waiting.repeatable]
            results = [self._waiting.pop(id).result for id in failed]
            self._changed.notify_all()
        for result in results:
            result.set_exception(Disconnected("the session broke; the call may have been done"))

    def finish(self) -> None:
        """No more calls; the session is half-closed when what waits is sent and answered."""
        with self._changed:
            self._finishing = True
            self._changed.notify_all()

    def end(self) -> None:
        """There will be no session any more."""
        with self._changed:
            self._session += 1
            self._ended = DriverNotRunning("the driver has ended")
            results = [waiting.result for waiting in self._waiting.values()]
            self._waiting.clear()
            self._changed.notify_all()
        for result in results:
            result.set_exception(DriverNotRunning("the driver ended before the answer came"))

    def _sending(self, session: int) -> Iterator[pb.Call]:
        """Runs on gRPC's thread, and ends when its session does."""
        while True:
            call = self._next(session)
            if call is None:
                return
            yield call

    def _next(self, session: int) -> Optional[pb.Call]:
        with self._changed:
            while session == self._session:
                # Acknowledgements first: what they let go of makes room at the controller.
                if self._acknowledgements and self._ready:
                    task_id, version = self._acknowledgements.popitem(last=False)
                    return pb.Call(acknowledge=pb.Acknowledge(task=task_id, version=version))
                if self._unsent:
                    call = self._unsent.popleft()
                    self._unsent_bytes -= call.ByteSize()
                    return call
                if self._finishing and not self._waiting:
                    return None
                self._changed.wait()
            return None


def _wish(call: pb.Call) -> Optional[str]:
    kind = call.WhichOneof("call")
    if kind in ("revive", "suppress"):
        return "offers"
    return kind if kind in ("set_position", "set_filter") else None
