"""An executor's connection to its agent, and what outlives one."""

from __future__ import annotations

import contextlib
import itertools
import logging
import socket
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import NoReturn, Optional

from google.protobuf.message import DecodeError

from muster import _frames
from muster._backoff import Backoff
from muster._pb import executor as pb
from muster.errors import Disconnected, Overloaded, WireError

log = logging.getLogger("muster")

#: Messages that wait for the socket.
MOST_UNSENT_BYTES = 64 * 1024 * 1024
#: The agent is on the same machine, and a restart of it takes a second.
LONGEST_PAUSE_SECONDS = 2.0


class Outbox:
    """Updates that the agent has not acknowledged, and messages.

    Of each task only the newest update is kept: it says the whole state, so there are never more of them than tasks.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._sequence = itertools.count(1)
        self._tasks: set[str] = set()
        self._unacknowledged: OrderedDict[str, pb.StatusUpdate] = OrderedDict()
        self._unsent: OrderedDict[str, None] = OrderedDict()
        self._messages: deque[bytes] = deque()
        self._message_bytes = 0
        self._connection = 0
        self._ready = False

    def launched(self, task_id: str) -> bool:
        """False: the agent says it again, and hears again what it may have missed."""
        with self._changed:
            if task_id in self._unacknowledged:
                self._unsent[task_id] = None
                self._changed.notify_all()
                return False
            if task_id in self._tasks:
                return False
            self._tasks.add(task_id)
            return True

    def update(self, update: pb.StatusUpdate, ends: bool) -> bool:
        """False: the task has ended already, or never was; its first end counts."""
        with self._changed:
            if update.task not in self._tasks:
                return False
            update.sequence = next(self._sequence)
            # Behind the others in both, so that what is said has growing sequences.
            self._unacknowledged[update.task] = update
            self._unacknowledged.move_to_end(update.task)
            self._unsent[update.task] = None
            self._unsent.move_to_end(update.task)
            if ends:
                self._tasks.discard(update.task)
            self._changed.notify_all()
            return True

    def acknowledged(self, sequence: int) -> None:
        with self._changed:
            done = next((task for task, update in self._unacknowledged.items() if update.sequence == sequence), None)
            if done is not None:
                del self._unacknowledged[done]
                self._unsent.pop(done, None)
                self._changed.notify_all()

    def message(self, data: bytes) -> None:
        with self._changed:
            if not self._ready:
                raise Disconnected("the agent is away")
            if self._message_bytes + len(data) > MOST_UNSENT_BYTES:
                raise Overloaded(f"{self._message_bytes} bytes of messages wait for the agent")
            self._messages.append(data)
            self._message_bytes += len(data)
            self._changed.notify_all()

    def register(self, token: str) -> pb.Call:
        """The first frame of a connection."""
        with self._changed:
            register = pb.Register(
                token=token, tasks=sorted(self._tasks), unacknowledged=list(self._unacknowledged.values())
            )
            self._unsent.clear()
            return pb.Call(register=register)

    def ready(self) -> int:
        """The agent has registered us: the connection's number, for ``take``."""
        with self._changed:
            self._ready = True
            self._connection += 1
            return self._connection

    def lost(self) -> None:
        with self._changed:
            self._ready = False
            self._connection += 1
            self._messages.clear()
            self._message_bytes = 0
            self._changed.notify_all()

    def take(self, connection: int) -> Optional[pb.Call]:
        """What is to be written next, waiting for it; None when the connection is over."""
        with self._changed:
            while connection == self._connection:
                if self._unsent:
                    task_id, _ = self._unsent.popitem(last=False)
                    return pb.Call(status_update=self._unacknowledged[task_id])
                if self._messages:
                    data = self._messages.popleft()
                    self._message_bytes -= len(data)
                    return pb.Call(message=pb.Message(data=data))
                self._changed.wait()
            return None

    def settle(self, deadline: float) -> bool:
        """Waits until the agent has every update."""
        with self._changed:
            while self._unacknowledged or self._messages:
                left = deadline - time.monotonic()
                if left <= 0:
                    return False
                self._changed.wait(left)
            return True


class Link:
    """Dials, registers and reads until it is closed. ``received`` may wait: the agent then waits as well."""

    def __init__(self, path: str, token: str, outbox: Outbox, received: Callable[[Optional[pb.Event]], None]) -> None:
        self._path = path
        self._token = token
        self._outbox = outbox
        #: Each event after registration included; None: the connection broke.
        self._received = received
        self._backoff = Backoff(first=0.05, most=LONGEST_PAUSE_SECONDS)
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._connection: Optional[socket.socket] = None

    def run(self) -> None:
        """WireError: the agent does not speak our protocol."""
        while not self._closed.is_set():
            try:
                with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
                    self._once(connection)
            except OSError as error:
                if not self._closed.is_set():
                    log.warning("the agent is away: %s", error)
            self._closed.wait(self._backoff.next())

    def close(self) -> None:
        self._closed.set()
        with self._lock:
            if self._connection is not None:
                with contextlib.suppress(OSError):  # It may be gone already.
                    self._connection.shutdown(socket.SHUT_RDWR)

    def _once(self, connection: socket.socket) -> None:
        connection.connect(self._path)
        with self._lock:
            if self._closed.is_set():
                return
            self._connection = connection
        writer: Optional[threading.Thread] = None
        try:
            _frames.write(connection, self._outbox.register(self._token).SerializeToString())
            first = self._read(connection)
            if first is None:
                raise ConnectionResetError("it closed the connection before it registered us")
            if not first.HasField("registered"):
                raise WireError(f"the connection began with {first.WhichOneof('event')}")
            self._backoff.reset()
            number = self._outbox.ready()
            writer = threading.Thread(
                target=self._write_all, args=(connection, number), name="muster-agent-send", daemon=True
            )
            writer.start()
            self._receive(connection, first)
        finally:
            with self._lock:
                self._connection = None
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            self._outbox.lost()
            if writer is not None:
                writer.join()
                self._received(None)

    def _receive(self, connection: socket.socket, event: Optional[pb.Event]) -> NoReturn:
        while event is not None:
            if event.HasField("acknowledged"):
                self._outbox.acknowledged(event.acknowledged.sequence)
            else:
                self._received(event)
            event = self._read(connection)
        raise ConnectionResetError("it closed the connection")

    def _read(self, connection: socket.socket) -> Optional[pb.Event]:
        frame = _frames.read(connection)
        if frame is None:
            return None
        try:
            return pb.Event.FromString(frame)
        except DecodeError as error:
            raise WireError(f"a frame that is no event: {error}") from error

    def _write_all(self, connection: socket.socket, number: int) -> None:
        try:
            while True:
                call = self._outbox.take(number)
                if call is None:
                    return
                _frames.write(connection, call.SerializeToString())
        except OSError:
            # The reader sees the end of the same connection, and says so.
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
