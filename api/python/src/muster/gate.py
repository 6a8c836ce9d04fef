"""Commands for a robot's actuators, through the gate that stands before its drivers.

Every command shows a lease and is answered. Whoever gave the last command and is gone or silent (200 ms, unless the
robot's operator says otherwise) leaves a robot that stands: command it as long as it is to move. ::

    with muster.Gate() as gate:
        while gate.command("base:Drive", b'{"linear": 0.2}').verdict is not muster.Verdict.REVOKED:
            time.sleep(0.05)
"""

from __future__ import annotations

import enum
import os
import socket
from dataclasses import dataclass
from types import TracebackType
from typing import Optional, Tuple, Type

from muster import _frames
from muster._pb import gate as _pb
from muster.errors import ConfigError, Disconnected

SOCKET = "MUSTER_GATE_SOCKET"
TOKEN = "MUSTER_GATE_TOKEN"
LEASE = "MUSTER_LEASE"


class Verdict(enum.Enum):
    """What is said to a command."""

    OK = 1  #: handed to the driver
    OLDER = 2  #: a newer lease was used or delegated
    REVOKED = 3  #: it was this task's and was taken back
    NOT_HOLDER = 4  #: it is not this task's
    UNKNOWN = 5  #: the gate has not heard of it, or does not know whether it still counts; try again
    STOPPED = 6  #: an emergency stop is in force
    NO_DRIVER = 7  #: no driver for this actuator, or it does not take more now


@dataclass(frozen=True)
class GateAnswer:
    verdict: Verdict
    holder: Optional[str]  #: uid of the task that holds the actuators now, as far as the gate knows
    newest: Tuple[int, ...]  #: the newest lease that was granted or used: epoch, then what delegates appended


class Gate:
    """A connection to the gate, as the task that this program runs in. Closed: the robot stands, if this drove it.

    Raises ConfigError when the environment does not say where the gate is, Disconnected when it does not take the task
    in or goes away.
    """

    def __init__(
        self, path: Optional[str] = None, token: Optional[str] = None, lease: Optional[Tuple[int, ...]] = None
    ) -> None:
        #: What commands show: the epoch, then what was appended. A longer one of one's own outranks a delegate.
        self.lease = lease if lease is not None else _lease(_environment(LEASE))
        self._id = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(path if path is not None else _environment(SOCKET))
            register = _pb.Register(token=token if token is not None else _environment(TOKEN))
            self._say(_pb.Call(register=register))
            if not self._hear().HasField("registered"):
                raise Disconnected("the gate did not take this task in")
        except BaseException as error:
            self._socket.close()
            if isinstance(error, OSError):
                raise Disconnected(f"the gate: {error}") from error
            raise

    def command(self, actuator: str, data: bytes) -> GateAnswer:
        """Returns when the driver has it, or why it has not."""
        self._id += 1
        command = _pb.Command(id=self._id, lease=_wire(self.lease), actuator=actuator, data=data)
        return self._ask(_pb.Call(command=command))

    def retain(self) -> None:
        """A sign of life without a command. It does not keep a robot moving."""
        self._say(_pb.Call(retain=_pb.Retain()))

    def delegate(self, lease: Tuple[int, ...], task: str) -> GateAnswer:
        """Lets another task (by its uid) drive with a lease under this one's, newer than what was used before."""
        self._id += 1
        return self._ask(_pb.Call(delegate=_pb.Delegate(id=self._id, lease=_wire(lease), task=task)))

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Gate:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        traceback: Optional[TracebackType],
    ) -> None:
        self.close()

    def _ask(self, call: _pb.Call) -> GateAnswer:
        self._say(call)
        while True:
            event = self._hear()
            if event.HasField("answer") and event.answer.id == self._id:
                break
        answer = event.answer
        return GateAnswer(
            verdict=Verdict(answer.verdict),
            holder=answer.holder.task if answer.HasField("holder") else None,
            newest=(answer.newest.epoch, *answer.newest.sequence),
        )

    def _say(self, call: _pb.Call) -> None:
        try:
            _frames.write(self._socket, call.SerializeToString())
        except OSError as error:
            raise Disconnected(f"the gate: {error}") from error

    def _hear(self) -> _pb.Event:
        try:
            frame = _frames.read(self._socket)
        except OSError as error:
            raise Disconnected(f"the gate: {error}") from error
        if frame is None:
            raise Disconnected("the gate closed the connection")
        return _pb.Event.FromString(frame)


def _environment(name: str) -> str:
    value = os.environ.get(name)
    if not value:
        raise ConfigError(f"{name} is not set; no gate stands before this robot's drivers, or this is no task")
    return value


def _lease(text: str) -> Tuple[int, ...]:
    """From NODE.GROUP:EPOCH[,NUMBER…]."""
    try:
        return tuple(int(number) for number in text.rsplit(":", 1)[1].split(","))
    except (IndexError, ValueError):
        raise ConfigError(f"{LEASE}={text!r} is no lease; NODE.GROUP:EPOCH") from None


def _wire(lease: Tuple[int, ...]) -> _pb.Lease:
    return _pb.Lease(epoch=lease[0], sequence=lease[1:])
