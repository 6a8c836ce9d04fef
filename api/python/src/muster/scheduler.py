"""The half of two-level scheduling that a framework writes: which of the offered robots does what (Avalon, IV-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Optional

from muster._names import Foreign, adopt
from muster.model import Offer, Position, RescindReason, TaskStatus

if TYPE_CHECKING:
    from muster.driver import SchedulerDriver

_CALLBACKS: Mapping[str, Foreign] = {
    "registered": Foreign((), lambda driver, framework_id: (driver, framework_id, None)),
    "reregistered": Foreign((), lambda driver: (driver, None)),
    "resource_offers": Foreign(("resourceOffers",)),
    "offer_rescinded": Foreign(("offerRescinded",), lambda driver, offer_id, reason: (driver, offer_id)),
    "status_update": Foreign(("statusUpdate",)),
    "framework_message": Foreign(("frameworkMessage",)),
    "node_lost": Foreign(("nodeLost", "slaveLost"), lambda driver, node, message: (driver, node)),
    "executor_lost": Foreign(
        ("executorLost",), lambda driver, executor, node, exit_code, message: (driver, executor, node, exit_code)
    ),
    "error": Foreign((), lambda driver, reason, message: (driver, f"{reason}: {message}")),
}


class Scheduler:
    """Callbacks; override what you need.

    The driver calls them one after the other, in the order of what happened, on one thread of its own. A slow callback
    delays the next one and nothing else. An exception ends the driver, and ``join`` raises it.

    The names of the paper and of Mesos (``resourceOffers``, ``slaveLost``) may be used instead, with Mesos' arguments
    as well.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        adopt(cls, _CALLBACKS)

    def registered(self, driver: SchedulerDriver, framework_id: str) -> None:
        """The controller knows this framework from now on. It has no tasks yet."""

    def reregistered(self, driver: SchedulerDriver) -> None:
        """The framework is back, after a broken connection or a restart, and its tasks went on.

        Offers from before are void. A restarted framework calls ``driver.reconcile_tasks()`` to hear of its tasks.
        """

    def disconnected(self, driver: SchedulerDriver) -> None:
        """The connection broke; the driver connects again by itself. Offers are void."""

    def resource_offers(self, driver: SchedulerDriver, offers: Sequence[Offer]) -> None:
        """What nodes could give now, the best score first. Launch on them or decline them."""

    def offer_rescinded(self, driver: SchedulerDriver, offer_id: str, reason: RescindReason) -> None:
        """An offer of an earlier ``resource_offers`` is void."""

    def status_update(self, driver: SchedulerDriver, update: TaskStatus) -> None:
        """A task has another state. It is repeated until it is acknowledged, by default when this returns."""

    def framework_message(self, driver: SchedulerDriver, executor: str, node: str, data: bytes) -> None:
        """An executor says something. At most once, in order."""

    def node_lost(self, driver: SchedulerDriver, node: str, message: str) -> None:
        """A node with tasks of this framework cannot be reached."""

    def moved(self, driver: SchedulerDriver, position: Optional[Position], by: str) -> None:
        """Somebody else has set where the framework works (None: everywhere). Offers for the old position are void."""

    def executor_lost(
        self, driver: SchedulerDriver, executor: str, node: str, exit_code: Optional[int], message: str
    ) -> None:
        """An executor has ended; its tasks get updates of their own."""

    def error(self, driver: SchedulerDriver, reason: str, message: str) -> None:
        """The session has ended for good, and the driver with it."""
