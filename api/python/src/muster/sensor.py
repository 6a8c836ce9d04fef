"""Frames of a robot's sensors, for the tasks that asked for them (``resources.sensors``).

One reader of each source serves every task: a long frame lies once in memory that all of them see. A frame is this
program's until it asks for the next one; what it is too slow for is dropped for it alone, and counted. ::

    with muster.Sensor("kinect:ImageGen") as camera:
        for frame in camera:
            print(frame.sequence, len(frame.data), frame.dropped)

An agent that is started again is connected to again; so is a source that fails, which ``Sensor.state`` tells of.
"""

from __future__ import annotations

import array
import contextlib
import enum
import mmap
import os
import socket
import struct
import time
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Deque, Dict, Iterable, Iterator, Optional, Type

from muster._backoff import Backoff
from muster._pb import sensor as _pb
from muster.errors import ConfigError, Disconnected, WireError

DIR = "MUSTER_SENSORS_DIR"
TOKEN = "MUSTER_SENSORS_TOKEN"

_VERSION = 1
_LENGTH = struct.Struct(">I")
#: A path that the kernel takes for a socket, bytes.
_LONGEST_PATH = 107


class SourceState(enum.Enum):
    """How it stands with what a sensor's frames come from."""

    STARTING = 1  #: nothing has come yet
    DELIVERING = 2
    FAILING = 3  #: ``Sensor.why`` says why; it is tried again


@dataclass(frozen=True)
class Frame:
    """What a source said, until the next one is asked for: ``bytes(frame.data)`` keeps it."""

    sequence: int  #: among the source's frames, in one life of the agent
    dropped: int  #: frames between this one and the one before that this program did not get
    stamp_ns: int  #: when the agent had it whole, since the Unix epoch
    boot_ns: int  #: the same since the machine's boot (``time.CLOCK_BOOTTIME``)
    data: memoryview  #: read-only; of a ROS topic, a serialised message


class Sensor:
    """A reader of one function of a sensor, as the task that this program runs in.

    ``queue``: how many frames wait while this program is busy with one, 1 to 16; the oldest goes. With 1 it is the latest
    value, and a reader begins with the newest that there is.

    Raises ConfigError when the task did not ask for it or it has no source, Disconnected when the agent refuses.
    """

    def __init__(self, function: str, queue: int = 1, dir: Optional[str] = None, token: Optional[str] = None) -> None:
        device, _, name = function.partition(":")
        directory = dir if dir is not None else _environment(DIR)
        self.function = function
        self.state = SourceState.STARTING
        self.why = ""  #: why the source fails
        self.format = ""  #: what frames are, as far as the source says it: ros1:sensor_msgs/Image
        self.life = ""  #: of the agent: sequences of another one are not comparable
        self._path = os.path.join(directory, device.replace("/", "_"), name.replace("/", "_"))
        self._token = token if token is not None else _environment(TOKEN)
        self._queue = queue
        self._backoff = Backoff()
        self._line: Optional[_Line] = None
        self._slots: Dict[int, mmap.mmap] = {}
        self._held: Optional[int] = None
        if not os.path.exists(self._path):
            raise ConfigError(
                f"{function}: there is no {self._path}; the task did not ask for it, or it has no source on this node"
            )

    def next(self, timeout: Optional[float] = None) -> Frame:
        """The next frame; the one before is given back. Waits for the source and for the agent as long as it takes, or raises
        TimeoutError after ``timeout`` seconds."""
        until = None if timeout is None else time.monotonic() + timeout
        if self._held is not None and self._line is not None:
            self._line.say(_pb.Call(done=_pb.Done(sequence=self._held)))
        self._held = None
        while True:
            if self._line is None:
                self._reach(until)
            frame = self._hear(until)
            if frame is not None:
                self._backoff.reset()
                return frame

    def close(self) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None
        self._forget(list(self._slots))

    def __iter__(self) -> Iterator[Frame]:
        while True:
            yield self.next()

    def __enter__(self) -> Sensor:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        traceback: Optional[TracebackType],
    ) -> None:
        self.close()

    def _hear(self, until: Optional[float]) -> Optional[Frame]:
        """The next frame of this connection; None: it has ended, and another one may come about."""
        while self._line is not None:
            event = self._line.hear(until)
            if event is None:
                self.close()
            elif event.HasField("frame"):
                return self._frame(event.frame)
            elif event.HasField("opened"):
                self.life = event.opened.life
            elif event.HasField("source"):
                with contextlib.suppress(ValueError):
                    self.state = SourceState(event.source.state)
                self.why, self.format = event.source.why, event.source.format
            elif event.HasField("closed"):
                self.close()
                if event.closed.reason != _pb.REASON_TOO_SLOW:
                    raise Disconnected(f"the agent refuses: {event.closed.message}")
        return None

    def _frame(self, frame: _pb.Frame) -> Frame:
        data = memoryview(frame.data)
        if frame.HasField("shared"):
            shared = frame.shared
            self._forget(shared.retired)
            if shared.attached and self._line is not None:
                self._slots[shared.slot] = self._line.map(shared.capacity)
            data = memoryview(self._slots[shared.slot])[: shared.length]
        self._held = frame.sequence
        return Frame(frame.sequence, frame.dropped, frame.stamp_ns, frame.boot_ns, data)

    def _forget(self, slots: Iterable[int]) -> None:
        for slot in slots:
            mapping = self._slots.pop(slot, None)
            # Somebody still looks at a frame: it goes with that.
            with contextlib.suppress(BufferError):
                if mapping is not None:
                    mapping.close()

    def _reach(self, until: Optional[float]) -> None:
        while True:
            try:
                line = _Line(self._path)
            except (ConnectionRefusedError, FileNotFoundError, BlockingIOError):
                # The agent is being started again.
                wait = self._backoff.next()
                if until is not None and time.monotonic() + wait > until:
                    raise TimeoutError(f"{self.function}: the agent does not answer") from None
                time.sleep(wait)
                continue
            line.say(_pb.Call(open=_pb.Open(version=_VERSION, token=self._token, queue=self._queue)))
            self._line = line
            return


class _Line:
    """A connection: messages behind their lengths, and the descriptors of memory that come with them."""

    def __init__(self, path: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._heard = bytearray()
        self._descriptors: Deque[int] = deque()
        try:
            if len(os.fsencode(path)) <= _LONGEST_PATH:
                self._socket.connect(path)
            else:
                directory = os.open(os.path.dirname(path), os.O_PATH)
                try:
                    self._socket.connect(f"/proc/self/fd/{directory}/{os.path.basename(path)}")
                finally:
                    os.close(directory)
        except BaseException:
            self._socket.close()
            raise

    def say(self, call: _pb.Call) -> None:
        message = call.SerializeToString()
        self._socket.settimeout(None)
        # What was said before it closed is heard first.
        with contextlib.suppress(OSError):
            self._socket.sendall(_LENGTH.pack(len(message)) + message)

    def hear(self, until: Optional[float]) -> Optional[_pb.Event]:
        """None: the other side closed."""
        while True:
            if len(self._heard) >= _LENGTH.size:
                end = _LENGTH.size + _LENGTH.unpack_from(self._heard)[0]
                if len(self._heard) >= end:
                    event = _pb.Event.FromString(bytes(self._heard[_LENGTH.size : end]))
                    del self._heard[:end]
                    return event
            if not self._read(until):
                return None

    def map(self, capacity: int) -> mmap.mmap:
        if not self._descriptors:
            raise WireError("no descriptor came with a frame")
        descriptor = self._descriptors.popleft()
        try:
            return mmap.mmap(descriptor, capacity, flags=mmap.MAP_SHARED, prot=mmap.PROT_READ)
        finally:
            os.close(descriptor)

    def close(self) -> None:
        self._socket.close()
        while self._descriptors:
            os.close(self._descriptors.popleft())

    def _read(self, until: Optional[float]) -> bool:
        left = None if until is None else max(until - time.monotonic(), 1e-6)
        self._socket.settimeout(left)
        room = socket.CMSG_SPACE(4 * array.array("i").itemsize)
        try:
            part, control, _, _ = self._socket.recvmsg(1 << 16, room, socket.MSG_CMSG_CLOEXEC)
        except socket.timeout:
            raise TimeoutError("no frame in time") from None
        except OSError:
            return False
        for level, kind, data in control:
            if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
                descriptors = array.array("i")
                descriptors.frombytes(data[: len(data) - len(data) % descriptors.itemsize])
                self._descriptors.extend(descriptors)
        self._heard += part
        return bool(part)


def _environment(name: str) -> str:
    value = os.environ.get(name)
    if not value:
        raise ConfigError(
            f"{name} is not set; the task asks for no sensor that has a source on this node, or this is no task"
        )
    return value
