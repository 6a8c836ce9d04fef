"""Frameworks and executors for muster, an operating system for robots.

A framework subscribes with a ``SchedulerDriver``, is offered the robots and cloud servers that suit it, and launches
its tasks on them. The names are those of the Avalon paper's Table I and of Mesos.
"""

from concurrent.futures import Future

from muster import program
from muster._calls import Result
from muster._life import DriverState
from muster.driver import SchedulerDriver
from muster.errors import (
    CallRefused,
    Cause,
    ConfigError,
    Disconnected,
    DriverNotRunning,
    FrameworkError,
    MusterError,
    Overloaded,
    RefusalReason,
    WireError,
)
from muster.executor_driver import ExecutorDriver
from muster.executors import Executor, ExecutorInfo, ExecutorTask, ExecutorTaskState, Lease
from muster.gate import Gate, GateAnswer, Verdict
from muster.model import (
    Compute,
    Cost,
    Filter,
    FrameworkInfo,
    Launched,
    LaunchResult,
    NodeKind,
    Offer,
    OfferedExecutor,
    Pose,
    Position,
    RescindReason,
    TaskState,
    TaskStatus,
)
from muster.position import ClickedPoint, PositionSource, position_from_clicked_point
from muster.scheduler import Scheduler
from muster.sensor import Frame, Sensor, SourceState
from muster.task import TaskInfo, container, executor, process

#: What ``launch_tasks`` gives its done-callbacks, for annotations.
Launching = Future[LaunchResult]

__all__ = [
    "CallRefused",
    "Cause",
    "ClickedPoint",
    "Compute",
    "ConfigError",
    "Cost",
    "Disconnected",
    "DriverNotRunning",
    "DriverState",
    "Executor",
    "ExecutorDriver",
    "ExecutorInfo",
    "ExecutorTask",
    "ExecutorTaskState",
    "Filter",
    "Frame",
    "FrameworkError",
    "FrameworkInfo",
    "Gate",
    "GateAnswer",
    "LaunchResult",
    "Launched",
    "Launching",
    "Lease",
    "MusterError",
    "NodeKind",
    "Offer",
    "OfferedExecutor",
    "Overloaded",
    "Pose",
    "Position",
    "PositionSource",
    "RefusalReason",
    "RescindReason",
    "Result",
    "Scheduler",
    "SchedulerDriver",
    "Sensor",
    "SourceState",
    "TaskInfo",
    "TaskState",
    "TaskStatus",
    "Verdict",
    "WireError",
    "container",
    "executor",
    "position_from_clicked_point",
    "process",
    "program",
]
