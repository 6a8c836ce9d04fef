#!/usr/bin/env python3
"""Delivers to one goal after the other, each time with the robot that is nearest to it.

    deliver.py --goal 3,4 --goal=-2,7 --radius 20
    deliver.py --goal 3,4 -- /opt/bin/drive --x '$GOAL_X' --y '$GOAL_Y'

The command runs on the robot, with GOAL_X, GOAL_Y and GOAL_MAP in its environment and the robot's actuators for itself.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Optional

import muster
from muster import program

#: A stand-in for a robot's own way to drive.
DRIVE = ("sh", "-c", 'echo "driving to $GOAL_X,$GOAL_Y with $MUSTER_LEASE"; sleep 5; echo arrived')
#: A goal that fails so often is given up.
MOST_ATTEMPTS = 3


class Deliver(muster.Scheduler):
    def __init__(self, goals: Sequence[muster.Position], command: Sequence[str]) -> None:
        self.undelivered: list[muster.Position] = []
        self._goals = list(goals)
        self._command = command
        self._attempts = 0
        self._launching = False
        self._task_id: Optional[str] = None

    def registered(self, driver: muster.SchedulerDriver, framework_id: str) -> None:
        print(f"registered as {framework_id}", flush=True)
        # A framework that the controller had forgotten has lost its task as well.
        self._task_id = None

    def reregistered(self, driver: muster.SchedulerDriver) -> None:
        print("reregistered", flush=True)
        driver.reconcile_tasks([self._task_id] if self._task_id else [])

    def resource_offers(self, driver: muster.SchedulerDriver, offers: Sequence[muster.Offer]) -> None:
        able = [offer for offer in offers if offer.actuators]
        if self._task_id or self._launching or not self._goals or not able:
            driver.decline_offer(offers)
            return
        nearest = min(able, key=lambda offer: float("inf") if offer.score is None else offer.score)
        others = [offer for offer in offers if offer is not nearest]
        if others:
            driver.decline_offer(others)
        self._launch(driver, nearest)

    def _launch(self, driver: muster.SchedulerDriver, offer: muster.Offer) -> None:
        goal = self._goals[0]
        task = muster.process(
            self._command,
            cpu="200m",
            memory="64Mi",
            actuators=offer.actuators[:1],
            env={"GOAL_X": str(goal.x), "GOAL_Y": str(goal.y), "GOAL_MAP": goal.map},
        )
        distance = "" if offer.score is None else f", {offer.score:.2f} m away"
        print(f"goal {goal.x},{goal.y}: {offer.node}{distance}", flush=True)
        self._launching = True
        driver.launch_tasks(offer, task).add_done_callback(lambda done: self._launched(driver, done))

    def _launched(self, driver: muster.SchedulerDriver, done: muster.Launching) -> None:
        self._launching = False
        try:
            (launched,) = done.result()
        except muster.CallRefused as refused:
            # Somebody else was first, most often. Fresh offers follow.
            print(f"not launched: {refused}", flush=True)
            if refused.reason is muster.RefusalReason.INVALID:
                self._failed(driver)
            return
        except muster.MusterError as error:
            # Whether it runs is not known; reregistered asks, and status_update takes it up.
            print(f"not known whether launched: {error}", flush=True)
            return
        self._task_id = launched.task_id
        driver.suppress_offers()

    def status_update(self, driver: muster.SchedulerDriver, update: muster.TaskStatus) -> None:
        if self._task_id is None and not update.state.is_terminal:
            self._task_id = update.task_id
        if update.task_id != self._task_id:
            if not update.state.is_terminal:  # Of a launch whose answer was lost, and which was done again.
                driver.kill_task(update.task_id)
            return
        why = f" ({update.reason}: {update.message})" if update.reason else ""
        print(f"{update.name} on {update.node}: {update.state.name}{why}", flush=True)
        if update.state is muster.TaskState.SUCCEEDED:
            self._task_id = None
            self._next(driver)
        elif update.state.is_terminal:
            self._task_id = None
            self._failed(driver)

    def _failed(self, driver: muster.SchedulerDriver) -> None:
        self._attempts += 1
        if self._attempts < MOST_ATTEMPTS:
            driver.revive_offers()
            return
        self.undelivered.append(self._goals[0])
        self._next(driver)

    def _next(self, driver: muster.SchedulerDriver) -> None:
        self._attempts = 0
        self._goals.pop(0)
        if not self._goals:
            driver.stop()
            return
        driver.set_position(self._goals[0])
        driver.revive_offers()

    def error(self, driver: muster.SchedulerDriver, reason: str, message: str) -> None:
        print(f"error: {reason}: {message}", file=sys.stderr)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    program.add_arguments(parser, "deliver")
    parser.add_argument("--goal", type=program.position, action="append", required=True, metavar="X,Y", dest="goals")
    parser.add_argument("--radius", type=float, help="how far from a goal its robot may be, metres")
    parser.add_argument("command", nargs="*", default=DRIVE, help="what drives, after --; default: a stand-in")
    arguments = parser.parse_args()
    scheduler = Deliver(arguments.goals, arguments.command)
    framework = muster.FrameworkInfo(
        name=arguments.name,
        namespace=arguments.namespace,
        position=arguments.goals[0],
        radius=arguments.radius,
        filter=muster.Filter(kind=muster.NodeKind.ROBOT, any_actuator=True),
    )
    code = program.run(muster.SchedulerDriver(scheduler, framework, arguments.kubeconfig))
    for goal in scheduler.undelivered:
        print(f"error: nothing was delivered to {goal.x},{goal.y}", file=sys.stderr)
    return code or int(bool(scheduler.undelivered))


if __name__ == "__main__":
    sys.exit(main())
