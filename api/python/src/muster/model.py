"""What a framework sees: offers, positions, updates. Lengths are metres, angles radians, in the frame of ``map``.

The values of the enums are the wire's; a test holds them to the contract.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Optional

from muster.quantity import Cpu, Memory, cpu_millis, memory_bytes

DEFAULT_MAP = "map"


class NodeKind(enum.Enum):
    ROBOT = 1
    CLOUD = 2


class Cost(enum.Enum):
    """What an offer's score is."""

    #: Metres.
    DISTANCE = 1
    #: Seconds at the robot's speed, over the floor of the map's Site, or in a straight line where it has none.
    TRAVEL_TIME = 2


class RescindReason(enum.Enum):
    UNSPECIFIED = 0
    #: The node has more, less or other things; a fresh offer follows when it still fits.
    CHANGED = 1
    #: A launch used it, or came too late for it.
    TAKEN = 2
    OUT_OF_RANGE = 3
    #: The filter or the position was changed.
    FILTERED = 4
    #: Not ready, cordoned, tainted or gone.
    NODE_LOST = 5
    #: No answer in time.
    EXPIRED = 6
    SUPPRESSED = 7
    #: A closer robot takes its place.
    CLOSER = 8
    #: What the namespace's quota leaves is all used, or not any more; a fresh offer follows where something is left.
    QUOTA = 9


class TaskState(enum.Enum):
    PENDING = 1
    BOUND = 2
    STARTING = 3
    RUNNING = 4
    STOPPING = 5
    SUCCEEDED = 6
    FAILED = 7
    #: The node cannot be reached; the task may well be running.
    UNKNOWN = 8
    #: There is no such task of this framework.
    GONE = 9

    @property
    def is_terminal(self) -> bool:
        """Nothing follows."""
        return self in (TaskState.SUCCEEDED, TaskState.FAILED, TaskState.GONE)


@dataclass(frozen=True)
class Position:
    """Where the framework works (the operation position; Avalon, III-C)."""

    x: float
    y: float
    z: float = 0.0
    map: str = DEFAULT_MAP
    #: How far a robot may be from there; the rim is inside. None: as ``FrameworkInfo.radius`` says.
    radius: Optional[float] = None
    cost: Cost = Cost.DISTANCE


@dataclass(frozen=True)
class Pose:
    """Where a robot was at ``stamp``."""

    x: float
    y: float
    z: float
    yaw: float
    map: str = DEFAULT_MAP
    stamp: Optional[datetime] = None


@dataclass(frozen=True)
class Compute:
    """CR: computation resources."""

    cpu_millis: int = 0
    memory_bytes: int = 0
    extended: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, cpu: Cpu = 0, memory: Memory = 0, **extended: int) -> Compute:
        """``Compute.of(cpu="500m", memory="64Mi", gpu=1)``"""
        return cls(cpu_millis(cpu), memory_bytes(memory), extended)

    def covers(self, other: Compute) -> bool:
        """Whether ``other`` fits into this."""
        return (
            self.cpu_millis >= other.cpu_millis
            and self.memory_bytes >= other.memory_bytes
            and all(self.extended.get(name, 0) >= amount for name, amount in other.extended.items())
        )


@dataclass(frozen=True)
class Filter:
    """What a node must have to be offered at all."""

    #: None: robots and cloud nodes.
    kind: Optional[NodeKind] = None
    #: Label selector, Kubernetes' grammar: ``"arch=amd64,floor in (1,2)"``.
    selector: str = ""
    #: Least free CR.
    minimum: Compute = Compute()
    #: Each of these SR functions.
    sensors: tuple[str, ...] = ()
    #: Each of these AR functions, free.
    actuators: tuple[str, ...] = ()
    #: Some free AR.
    any_actuator: bool = False
    #: At most so many offers at once, the closest first; 0: the controller's default. No more than 1000.
    most: int = 0


@dataclass(frozen=True)
class FrameworkInfo:
    """Who the framework is and what it wants to be offered."""

    #: An RFC 1123 label.
    name: str
    namespace: str = "default"
    #: None: everywhere; offers have no score.
    position: Optional[Position] = None
    #: For every position that names none, now and by ``set_position``.
    radius: Optional[float] = None
    filter: Filter = Filter()
    #: Seconds that the framework may be away until its tasks are killed. None: the controller's default, 60.
    failover_timeout: Optional[float] = None
    #: The id that an earlier ``registered`` gave: the framework comes back and keeps its tasks.
    framework_id: str = ""


@dataclass(frozen=True)
class OfferedExecutor:
    """An executor that has registered, and takes tasks: ``muster.executor(name, …)`` is work for it."""

    task_id: str
    name: str


@dataclass(frozen=True)
class Offer:
    """What one node could give now. Others may hold an offer of the same."""

    id: str
    node: str
    kind: NodeKind
    labels: Mapping[str, str]
    #: Metres or seconds, as the position's cost says; None for a cloud node, or without a position.
    score: Optional[float]
    pose: Optional[Pose]
    free: Compute
    #: All SR functions of the node: they are shared.
    sensors: tuple[str, ...]
    #: AR functions; empty while they are held.
    actuators: tuple[str, ...]
    runtimes: tuple[str, ...]
    #: This framework's executors there.
    executors: tuple[OfferedExecutor, ...]
    made_at: Optional[datetime] = None


@dataclass(frozen=True)
class TaskStatus:
    """The whole present state of one task. States in between may be skipped, the end never."""

    task_id: str
    name: str
    node: str
    state: TaskState
    #: One CamelCase word, and a sentence.
    reason: str
    message: str
    exit_code: Optional[int]
    attempt: int
    #: Grows; for ``acknowledge_status_update``.
    version: int
    started_at: Optional[datetime] = None
    finished_at: Optional[datetime] = None


@dataclass(frozen=True)
class Launched:
    """One task of a launch: a Task object, placed."""

    name: str
    task_id: str
    node: str


@dataclass(frozen=True)
class LaunchResult:
    """The tasks of one launch, in the order in which they were given."""

    launched: tuple[Launched, ...]

    def __iter__(self) -> Iterator[Launched]:
        return iter(self.launched)

    def __len__(self) -> int:
        return len(self.launched)

    def __getitem__(self, index: int) -> Launched:
        return self.launched[index]
