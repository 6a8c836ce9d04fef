"""Wire messages <-> what a framework sees. Wire types stop here."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from typing import Any, Optional, TypeVar

from google.protobuf import json_format
from google.protobuf.struct_pb2 import Struct
from google.protobuf.timestamp_pb2 import Timestamp

from muster._pb import framework as pb
from muster.errors import CallRefused, Cause, RefusalReason, WireError
from muster.model import (
    DEFAULT_MAP,
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
from muster.task import TaskInfo, plain

E = TypeVar("E", bound=enum.Enum)


def _member(kind: type[E], number: int, field: str) -> E:
    try:
        return kind(number)
    except ValueError:
        raise WireError(f"{number} is not a {kind.__name__}", field) from None


def rescind_reason(number: int) -> RescindReason:
    """A reason that only newer controllers know does not make the offer any less gone."""
    try:
        return RescindReason(number)
    except ValueError:
        return RescindReason.UNSPECIFIED


def _time(stamp: Timestamp) -> datetime:
    return stamp.ToDatetime(tzinfo=timezone.utc)


def struct(value: Mapping[str, Any], path: str) -> Struct:
    made = Struct()
    json_format.ParseDict(plain(value, path), made)
    return made


def position(value: Position, default_radius: Optional[float]) -> pb.Position:
    radius = default_radius if value.radius is None else value.radius
    made = pb.Position(map=value.map, x=value.x, y=value.y, z=value.z, cost=pb.Cost.Name(value.cost.value))
    if radius is not None:
        made.radius = radius
    return made


def moved_to(value: pb.Moved) -> Optional[Position]:
    if not value.HasField("position"):
        return None
    said = value.position
    return Position(
        x=said.x,
        y=said.y,
        z=said.z,
        map=said.map or DEFAULT_MAP,
        radius=said.radius if said.HasField("radius") else None,
        cost=Cost(said.cost or Cost.DISTANCE.value),
    )


def _compute(value: Compute) -> pb.Compute:
    return pb.Compute(cpu_millis=value.cpu_millis, memory_bytes=value.memory_bytes, extended=value.extended)


def offer_filter(value: Filter) -> pb.Filter:
    return pb.Filter(
        kind=pb.NodeKind.Name(0 if value.kind is None else value.kind.value),
        selector=value.selector,
        minimum=_compute(value.minimum),
        sensors=value.sensors,
        actuators=value.actuators,
        any_actuator=value.any_actuator,
        most=value.most,
    )


def subscribe(info: FrameworkInfo, nonce: str) -> pb.Call:
    call = pb.Subscribe(
        name=info.name,
        namespace=info.namespace,
        framework_id=info.framework_id,
        filter=offer_filter(info.filter),
        nonce=nonce,
    )
    if info.position is not None:
        call.position.CopyFrom(position(info.position, info.radius))
    if info.failover_timeout is not None:
        call.failover_timeout_seconds = info.failover_timeout
    return pb.Call(subscribe=call)


def accept(offers: Sequence[str], tasks: Sequence[TaskInfo], refuse_seconds: float) -> pb.Call:
    launches = [
        pb.Launch(
            offer=task.offer,
            name=task.name or "",
            labels=task.labels,
            annotations=task.annotations,
            spec=struct(task.spec, f"tasks[{index}].spec"),
        )
        for index, task in enumerate(tasks)
    ]
    return pb.Call(accept=pb.Accept(offers=offers, launches=launches, refuse_seconds=refuse_seconds))


def _pose(value: pb.Pose) -> Pose:
    stamp = _time(value.stamp) if value.HasField("stamp") else None
    return Pose(value.x, value.y, value.z, value.yaw, value.map or DEFAULT_MAP, stamp)


def offer(value: pb.Offer) -> Offer:
    free = value.free
    return Offer(
        id=value.id,
        node=value.node,
        kind=_member(NodeKind, value.kind, "offer.kind"),
        labels=dict(value.labels),
        score=value.score if value.HasField("score") else None,
        pose=_pose(value.pose) if value.HasField("pose") else None,
        free=Compute(free.cpu_millis, free.memory_bytes, dict(free.extended)),
        sensors=tuple(value.sensors),
        actuators=tuple(value.actuators),
        runtimes=tuple(value.runtimes),
        executors=tuple(OfferedExecutor(one.task, one.name) for one in value.executors),
        made_at=_time(value.made_at) if value.HasField("made_at") else None,
    )


def task_status(value: pb.Update) -> TaskStatus:
    return TaskStatus(
        task_id=value.task,
        name=value.name,
        node=value.node,
        state=_member(TaskState, value.state, "update.state"),
        reason=value.reason,
        message=value.message,
        exit_code=value.exit_code if value.HasField("exit_code") else None,
        attempt=value.attempt,
        version=value.version,
        started_at=_time(value.started_at) if value.HasField("started_at") else None,
        finished_at=_time(value.finished_at) if value.HasField("finished_at") else None,
    )


def launch_result(value: pb.Answer) -> LaunchResult:
    return LaunchResult(tuple(Launched(one.name, one.task, one.node) for one in value.launched))


def nothing(_: pb.Answer) -> None:
    """Of calls whose answer says only that they were done."""


def refusal(value: pb.Refusal) -> CallRefused:
    try:
        reason = RefusalReason(value.reason)
    except ValueError:
        reason = RefusalReason.UNSPECIFIED
    return CallRefused(reason, value.message, tuple(Cause(cause.field, cause.message) for cause in value.causes))
