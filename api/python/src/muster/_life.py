"""What the two drivers have in common: their states, their threads, and how somebody waits for their end."""

from __future__ import annotations

import enum
import logging
import threading
import time
from collections.abc import Callable
from typing import Optional

from muster.errors import DriverNotRunning

log = logging.getLogger("muster")

#: How long ``stop`` lets the last words take.
STOP_SECONDS = 10.0
#: Of one message between a framework and an executor.
MOST_MESSAGE_BYTES = 4 * 1024 * 1024

#: A signal that one of gRPC's threads gets does not wake the main thread, whose matter it is.
_LONGEST_WAIT = 0.5


class DriverState(enum.Enum):
    NOT_STARTED = 1
    RUNNING = 2
    #: ``stop`` was called; the last callback runs, or the last words are under way.
    STOPPING = 3
    STOPPED = 4
    #: By ``abort``, an error of the session, or an exception of a callback.
    ABORTED = 5


class Life:
    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._state = DriverState.NOT_STARTED
        self._failure: Optional[BaseException] = None
        self._threads: list[threading.Thread] = []
        # Counted here: Thread.join, once a KeyboardInterrupt has come out of it, takes the thread for dead (bpo-45274).
        self._alive = 0

    @property
    def state(self) -> DriverState:
        with self._changed:
            return self._state

    def start(self) -> DriverState:
        raise NotImplementedError

    def abort(self) -> DriverState:
        raise NotImplementedError

    def join(self, timeout: Optional[float] = None) -> DriverState:
        """Waits until the driver has ended, and raises what a callback raised. RUNNING or STOPPING: not in time."""
        if threading.current_thread() in self._threads:
            raise RuntimeError("a callback cannot wait for the end of its own driver")
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._changed:
            while self._alive:
                left = _LONGEST_WAIT if deadline is None else deadline - time.monotonic()
                if left <= 0:
                    return self._state
                self._changed.wait(min(left, _LONGEST_WAIT))
        if self._failure is not None:
            raise self._failure
        return self.state

    def run(self) -> DriverState:
        """``start`` and ``join``."""
        self.start()
        return self.join()

    def _begin(self, bodies: dict[str, Callable[[], None]]) -> None:
        """Each body has a thread; the driver lives until all have ended."""
        with self._changed:
            self._must_be_new()
            self._state = DriverState.RUNNING
            self._threads = [
                threading.Thread(target=self._counted, args=(body,), name=name, daemon=True)
                for name, body in bodies.items()
            ]
            self._alive = len(self._threads)
            for thread in self._threads:
                thread.start()

    def _counted(self, body: Callable[[], None]) -> None:
        try:
            body()
        finally:
            with self._changed:
                self._alive -= 1
                self._changed.notify_all()

    def _must_be_new(self) -> None:
        with self._changed:
            if self._state is not DriverState.NOT_STARTED:
                raise RuntimeError("a driver is started once")

    def _turn(self, state: DriverState) -> bool:
        """To STOPPING or ABORTED. False: it is there already, or further."""
        with self._changed:
            if self._state is DriverState.NOT_STARTED:
                raise DriverNotRunning("the driver was not started")
            if self._state in (state, DriverState.STOPPED, DriverState.ABORTED):
                return False
            self._state = state
            return True

    def _stopped(self) -> None:
        with self._changed:
            if self._state is DriverState.STOPPING:
                self._state = DriverState.STOPPED

    def _guarded(self, body: Callable[[], None]) -> None:
        """Runs a thread's body. What it raises ends the driver, and comes out of ``join``."""
        try:
            body()
        except BaseException as failure:
            log.exception("the driver ends")
            with self._changed:
                self._failure = self._failure or failure
            self.abort()
