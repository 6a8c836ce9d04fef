"""The driver of an executor: who calls it, and what it says to the agent of its node.

Threads: ``muster-agent`` connects and reads, ``muster-agent-send`` (one a connection) writes (see ``_agent``);
``muster-callbacks`` calls the executor.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Optional

from google.protobuf import json_format

from muster._agent import Link, Outbox
from muster._life import MOST_MESSAGE_BYTES, STOP_SECONDS, DriverState, Life
from muster._pb import executor as pb
from muster.errors import ConfigError, WireError
from muster.executors import Executor, ExecutorInfo, ExecutorTask, ExecutorTaskState, Lease

log = logging.getLogger("muster")

SOCKET = "MUSTER_EXECUTOR_SOCKET"
TOKEN = "MUSTER_EXECUTOR_TOKEN"
#: Events that wait for a callback. There are no heartbeats here to be kept up: when it is full, the agent waits.
MOST_WAITING = 64


class ExecutorDriver(Life):
    """An executor's connection to the agent of its node, found by the environment that the agent gave it."""

    def __init__(self, executor: Executor, environ: Optional[Mapping[str, str]] = None) -> None:
        super().__init__()
        env = os.environ if environ is None else environ
        missing = [name for name in (SOCKET, TOKEN) if not env.get(name)]
        if missing:
            raise ConfigError(f"{' and '.join(missing)} not set: an executor is started by an agent, as a task")
        self._executor = executor
        self._outbox = Outbox()
        self._events = _Events()
        self._link = Link(env[SOCKET], env[TOKEN], self._outbox, self._events.put)
        self._grace = STOP_SECONDS

    def start(self) -> DriverState:
        """Connects in the background."""
        self._begin(
            {
                "muster-agent": lambda: self._guarded(self._read_all),
                "muster-callbacks": self._call_back,
            }
        )
        return self.state

    def stop(self) -> DriverState:
        """Ends after the callback that runs, when the agent has the last updates; does not wait (``join`` does)."""
        self._turn(DriverState.STOPPING)
        self._events.close()
        return self.state

    def abort(self) -> DriverState:
        """Disconnects at once. No callback begins after this."""
        self._turn(DriverState.ABORTED)
        self._events.close()
        self._link.close()
        return self.state

    def send_status_update(
        self, task_id: str, state: ExecutorTaskState, message: str = "", exit_code: Optional[int] = None
    ) -> bool:
        """Said until the agent has it on its disk; from any thread. False: the task has ended already, or never was."""
        update = pb.StatusUpdate(
            task=task_id, state=pb.TaskState.Name(state.value), message=message, exit_code=exit_code
        )
        return self._outbox.update(update, ends=state.is_terminal)

    def send_framework_message(self, data: bytes) -> None:
        """To the framework: at most once, in order, up to 4 MiB. Raises Disconnected while the agent is away."""
        if len(data) > MOST_MESSAGE_BYTES:
            raise ValueError(f"{len(data)} bytes are more than a message holds ({MOST_MESSAGE_BYTES})")
        self._outbox.message(data)

    # Mesos' names.
    sendStatusUpdate = send_status_update
    sendFrameworkMessage = send_framework_message

    def _read_all(self) -> None:
        try:
            self._link.run()
        except WireError as error:
            log.error("the agent does not speak our protocol: %s", error)
            self._events.fail(error)

    def _call_back(self) -> None:
        self._guarded(self._deliver_all)
        if self.state is DriverState.STOPPING:
            if not self._outbox.settle(time.monotonic() + self._grace):
                log.warning("the agent did not take the last updates")
            self._link.close()
            self._threads[0].join()
        self._stopped()

    def _deliver_all(self) -> None:
        while True:
            kind, event = self._events.take()
            if kind == "closed":
                return
            if kind == "failed":
                self._executor.error(self, str(self._events.failure))
                self.abort()
            elif event is None:
                self._executor.disconnected(self)
            else:
                self._deliver(event)

    def _deliver(self, event: pb.Event) -> None:
        kind = event.WhichOneof("event")
        if kind == "registered":
            self._registered(event.registered)
        elif kind == "launch":
            # The agent says a launch again when it cannot know whether it was heard.
            if self._outbox.launched(event.launch.task):
                self._executor.launch_task(self, _task(event.launch))
        elif kind == "kill":
            self._executor.kill_task(self, event.kill.task, event.kill.grace_period_ms / 1000)
        elif kind == "message":
            self._executor.framework_message(self, event.message.data)
        elif kind == "shutdown":
            self._grace = event.shutdown.grace_period_ms / 1000
            self._executor.shutdown(self, self._grace)
            self.stop()

    def _registered(self, answer: pb.Registered) -> None:
        info = ExecutorInfo(
            answer.executor, answer.namespace, answer.framework, answer.node, answer.framework_id
        )
        if answer.reregistered:
            self._executor.reregistered(self, info)
        else:
            self._executor.registered(self, info)


def _task(launch: pb.Launch) -> ExecutorTask:
    lease = None
    if launch.HasField("lease"):
        lease = Lease(launch.lease.node, launch.lease.group, launch.lease.epoch, launch.lease.gate_token)
    return ExecutorTask(launch.task, launch.name, json_format.MessageToDict(launch.data), lease)


class _Events:
    """From the reader to the callbacks."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[Optional[pb.Event]] = deque()
        self._closed = False
        self.failure: Optional[WireError] = None

    def put(self, event: Optional[pb.Event]) -> None:
        """None: the connection broke. Waits for room."""
        with self._changed:
            while len(self._waiting) >= MOST_WAITING and not self._closed:
                self._changed.wait()
            if not self._closed:
                self._waiting.append(event)
            self._changed.notify_all()

    def fail(self, failure: WireError) -> None:
        """After what waits."""
        with self._changed:
            self.failure = failure
            self._changed.notify_all()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()

    def take(self) -> tuple[str, Optional[pb.Event]]:
        with self._changed:
            while not self._closed:
                if self._waiting:
                    event = self._waiting.popleft()
                    self._changed.notify_all()
                    return "event", event
                if self.failure is not None:
                    return "failed", None
                self._changed.wait()
            return "closed", None
