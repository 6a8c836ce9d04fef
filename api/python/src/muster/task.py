"""Tasks to launch. A spec is a Task's spec as in a manifest, as a dict; the helpers write the usual ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Optional, Union

from muster.model import Offer
from muster.quantity import Cpu, Memory, cpu_millis, memory_bytes

#: Larger whole numbers lose digits on the way (the wire's numbers are doubles).
_MOST_EXACT = 2**53


@dataclass(frozen=True)
class TaskInfo:
    """One task to launch."""

    #: Of the Task object. None: made from the framework's name.
    name: Optional[str] = None
    #: ``{"resources": {...}, "run": {...}}``; the controller fills in the node.
    spec: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    annotations: Mapping[str, str] = field(default_factory=dict)
    #: Which of a launch's offers; may be empty when there is one.
    offer: str = ""

    def on(self, offer: Union[Offer, str]) -> TaskInfo:
        """The same task for this offer, where a launch names several."""
        return replace(self, offer=offer if isinstance(offer, str) else offer.id)

    def named(self, name: str) -> TaskInfo:
        return replace(self, name=name)


def process(
    command: Sequence[str],
    *,
    cpu: Optional[Cpu] = None,
    memory: Optional[Memory] = None,
    sensors: Sequence[str] = (),
    actuators: Sequence[str] = (),
    env: Optional[Mapping[str, str]] = None,
    name: Optional[str] = None,
    **more: Any,
) -> TaskInfo:
    """A process of the node itself; passed as it is, without a shell.

    ``more`` goes into the spec: ``grace_period_seconds=2``, ``restart_policy="OnFailure"``.
    """
    run: dict[str, Any] = {"command": list(command), **_env(env)}
    return TaskInfo(name, _spec({"process": run}, _resources(cpu, memory, sensors, actuators), more))


def container(
    image: str,
    command: Sequence[str] = (),
    *,
    cpu: Optional[Cpu] = None,
    memory: Optional[Memory] = None,
    sensors: Sequence[str] = (),
    actuators: Sequence[str] = (),
    env: Optional[Mapping[str, str]] = None,
    name: Optional[str] = None,
    **more: Any,
) -> TaskInfo:
    """A container of the node's Docker Engine."""
    run: dict[str, Any] = {"image": image, **_env(env)}
    if command:
        run["command"] = list(command)
    return TaskInfo(name, _spec({"container": run}, _resources(cpu, memory, sensors, actuators), more))


def executor(
    executor_task_name: str,
    *,
    data: Optional[Mapping[str, Any]] = None,
    cpu: Optional[Cpu] = None,
    memory: Optional[Memory] = None,
    sensors: Sequence[str] = (),
    actuators: Sequence[str] = (),
    name: Optional[str] = None,
    **more: Any,
) -> TaskInfo:
    """Work for an executor: a task of the same namespace that stays alive on the node and runs many tasks itself."""
    run = {"task": executor_task_name, "data": dict(data or {})}
    return TaskInfo(name, _spec({"executor": run}, _resources(cpu, memory, sensors, actuators), more))


def _env(env: Optional[Mapping[str, str]]) -> dict[str, Any]:
    return {"env": [{"name": name, "value": value} for name, value in env.items()]} if env else {}


def _resources(
    cpu: Optional[Cpu], memory: Optional[Memory], sensors: Sequence[str], actuators: Sequence[str]
) -> dict[str, Any]:
    resources: dict[str, Any] = {}
    if cpu is not None:
        resources["cpu"] = f"{cpu_millis(cpu)}m"
    if memory is not None:
        resources["memory"] = str(memory_bytes(memory))
    if sensors:
        resources["sensors"] = list(sensors)
    if actuators:
        resources["actuators"] = list(actuators)
    return resources


def _spec(run: dict[str, Any], resources: dict[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    spec: dict[str, Any] = {_camel(key): value for key, value in more.items()}
    # An explicit `resources=` adds what the helper has no word for: io, pids, extended.
    spec["resources"] = {**spec.get("resources", {}), **resources}
    spec["run"] = run
    return spec


def _camel(key: str) -> str:
    first, *rest = key.split("_")
    return first + "".join(word.capitalize() for word in rest)


def plain(value: Any, path: str = "spec") -> Any:
    """``value`` as JSON has it. ValueError names the place of what JSON has not."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, float)):
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{path}: {value} is not a number that JSON has")
        if isinstance(value, int) and abs(value) > _MOST_EXACT:
            raise ValueError(f"{path}: {value} is too large to arrive exactly; write it as a string")
        return value
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ValueError(f"{path}: the key {key!r} is not a string")
        return {key: plain(item, f"{path}.{key}") for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray)):
        return [plain(item, f"{path}[{index}]") for index, item in enumerate(value)]
    raise ValueError(f"{path}: a {type(value).__name__} is not a value that JSON has")
