"""Executors: programs of a framework that stay alive on a node and run many tasks themselves (Avalon, IV-B)."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Optional

from muster._names import Foreign, adopt

if TYPE_CHECKING:
    from muster.executor_driver import ExecutorDriver


class ExecutorTaskState(enum.Enum):
    """What an executor says of its tasks. The values are the wire's."""

    STARTING = 1
    RUNNING = 2
    SUCCEEDED = 3
    FAILED = 4
    KILLED = 5

    @property
    def is_terminal(self) -> bool:
        return self not in (ExecutorTaskState.STARTING, ExecutorTaskState.RUNNING)


@dataclass(frozen=True)
class ExecutorInfo:
    """Who this executor is."""

    #: uid of its own task.
    executor_id: str
    namespace: str
    #: Empty: a declared task.
    framework: str
    node: str
    #: The framework's id; empty as well.
    framework_id: str = ""


@dataclass(frozen=True)
class Lease:
    """The right to the actuators of a group of a robot. Drivers of actuators refuse an older epoch."""

    node: str
    group: str
    epoch: int
    #: What is shown to the gate to drive for this task (``Gate(token=…)``); empty: no gate stands before the drivers.
    gate_token: str = field(default="", repr=False, compare=False)

    def __str__(self) -> str:
        """As ``MUSTER_LEASE`` has it for tasks that are processes."""
        return f"{self.node}.{self.group}:{self.epoch}"


@dataclass(frozen=True)
class ExecutorTask:
    """Work to do."""

    task_id: str
    name: str
    #: The task's ``spec.run.executor.data``. Numbers are floats.
    data: Mapping[str, Any]
    #: With the task's actuators, when it has some.
    lease: Optional[Lease] = None


_CALLBACKS: Mapping[str, Foreign] = {
    "registered": Foreign((), lambda driver, info: (driver, info, None, None)),
    "reregistered": Foreign(),
    "launch_task": Foreign(("launchTask",)),
    "kill_task": Foreign(("killTask",), lambda driver, task_id, grace: (driver, task_id)),
    "framework_message": Foreign(("frameworkMessage",)),
    "shutdown": Foreign((), lambda driver, grace: (driver,)),
}


class Executor:
    """Callbacks; override what you need.

    The driver calls them one after the other on one thread of its own: do long work on another, and tell of it with
    ``driver.send_status_update``. An exception ends the driver, and ``join`` raises it. The names of the paper and of
    Mesos (``launchTask``) may be used instead.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        adopt(cls, _CALLBACKS)

    def registered(self, driver: ExecutorDriver, info: ExecutorInfo) -> None:
        """The agent knows this executor from now on."""

    def reregistered(self, driver: ExecutorDriver, info: ExecutorInfo) -> None:
        """The agent is back."""

    def disconnected(self, driver: ExecutorDriver) -> None:
        """The agent is gone, for a restart or an upgrade. Go on; the driver connects again by itself."""

    def launch_task(self, driver: ExecutorDriver, task: ExecutorTask) -> None:
        """Begin this, and send a status update."""

    def kill_task(self, driver: ExecutorDriver, task_id: str, grace_seconds: float) -> None:
        """End this within the grace, and send its last status update."""

    def framework_message(self, driver: ExecutorDriver, data: bytes) -> None:
        """The framework says something. At most once, in order."""

    def shutdown(self, driver: ExecutorDriver, grace_seconds: float) -> None:
        """End every task; the driver ends when this returns and the agent has the last updates.

        The program should exit then: half way through the grace the agent sends SIGTERM, and at its end SIGKILL.
        """

    def error(self, driver: ExecutorDriver, message: str) -> None:
        """The agent does not speak our protocol; the driver ends."""
