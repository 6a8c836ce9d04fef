"""Where operation positions come from: the command line, a clicked point in rviz (Avalon, IV-A3), a queue of orders.

Nothing here knows ROS. ``position_from_clicked_point`` takes any object of the shape of ``geometry_msgs/PointStamped``,
and a ``PositionSource`` can be a ROS subscription or anything else that knows when the goal has moved.
"""

from __future__ import annotations

from typing import Callable, Optional, Protocol

from muster.model import DEFAULT_MAP, Cost, Position


class Header(Protocol):
    @property
    def frame_id(self) -> str: ...


class Point(Protocol):
    @property
    def x(self) -> float: ...
    @property
    def y(self) -> float: ...
    @property
    def z(self) -> float: ...


class ClickedPoint(Protocol):
    """``geometry_msgs/PointStamped``, as rviz publishes it on ``/clicked_point``."""

    @property
    def header(self) -> Header: ...
    @property
    def point(self) -> Point: ...


class PositionSource(Protocol):
    """Tells the driver that owns it where the framework works next."""

    def start(self, moved: Callable[[Position], None]) -> None:
        """Called once, when the driver starts. ``moved`` may be called from any thread, until ``stop``."""

    def stop(self) -> None:
        """Called once, when the driver has ended."""


def position_from_clicked_point(
    clicked: ClickedPoint, radius: Optional[float] = None, cost: Cost = Cost.DISTANCE
) -> Position:
    """The operation position that somebody clicked, in the map that the message names.

    ROS 1 wrote frames with a leading slash; ROS 2 and muster's maps do not.
    """
    point = clicked.point
    return Position(
        x=float(point.x),
        y=float(point.y),
        z=float(point.z),
        map=clicked.header.frame_id.lstrip("/") or DEFAULT_MAP,
        radius=radius,
        cost=cost,
    )
