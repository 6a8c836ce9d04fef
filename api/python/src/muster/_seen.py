"""Which updates were delivered and acknowledged: updates are repeated until they are, and delivered once."""

from __future__ import annotations

import enum
import threading
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass

#: Tasks that are remembered. An update of one that was forgotten would be delivered twice, which Mesos allows always;
#: the ones that were longest silent go first.
MOST_TASKS = 65_536


class Verdict(enum.Enum):
    DELIVER = 1
    #: Delivered, and not acknowledged yet.
    DROP = 2
    #: Acknowledged; that acknowledgement was lost.
    ACKNOWLEDGE_AGAIN = 3


@dataclass
class _Task:
    delivered: int = -1
    acknowledged: int = -1


class Seen:
    def __init__(self, most: int = MOST_TASKS) -> None:
        self._lock = threading.Lock()
        self._tasks: OrderedDict[str, _Task] = OrderedDict()
        self._most = most

    def judge(self, task_id: str, version: int) -> Verdict:
        with self._lock:
            task = self._tasks.setdefault(task_id, _Task())
            self._tasks.move_to_end(task_id)
            while len(self._tasks) > self._most:
                self._tasks.popitem(last=False)
            if version > task.delivered:
                task.delivered = version
                return Verdict.DELIVER
            return Verdict.ACKNOWLEDGE_AGAIN if version <= task.acknowledged else Verdict.DROP

    def acknowledged(self, task_id: str, version: int) -> None:
        with self._lock:
            task = self._tasks.get(task_id)
            if task is not None:
                task.acknowledged = max(task.acknowledged, version)

    def forget(self, task_ids: Collection[str] = ()) -> None:
        """The next update of these, or of all when none is named, is delivered whatever its version: somebody asked."""
        with self._lock:
            if not task_ids:
                self._tasks.clear()
            for task_id in task_ids:
                self._tasks.pop(task_id, None)
