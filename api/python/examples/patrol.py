#!/usr/bin/env python3
"""Patrols with two robots, and recognises in the cloud what they see.

Three posts are kept filled: a driving task (AR) on each of two robots, and recognition (CR) on a cloud server. What
ends is launched again, on whichever node is offered then. With --state-file a restarted patrol takes its tasks up.

    patrol.py --at 0,0 --radius 50 --state-file /var/lib/patrol
"""

from __future__ import annotations

import argparse
import sys
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Optional

import muster
from muster import program

#: Stand-ins for real programs.
DRIVE = ("sh", "-c", 'echo "patrolling with $MUSTER_LEASE"; while :; do sleep 1; done')
RECOGNISE = ("sh", "-c", "echo recognising; while :; do sleep 1; done")
#: Cpu and memory.
NEEDS = {muster.NodeKind.ROBOT: ("200m", "64Mi"), muster.NodeKind.CLOUD: ("500m", "256Mi")}
#: Seconds that an offer without use is not made again.
REFUSE_SECONDS = 10.0


@dataclass
class Post:
    """A task that is always wanted."""

    role: str
    kind: muster.NodeKind
    #: Empty: vacant. Then the launch is under way, or ``task_id`` is known.
    node: str = ""
    task_name: str = ""
    task_id: str = ""
    failures: int = 0

    def task(self, offer: muster.Offer) -> muster.TaskInfo:
        cpu, memory = NEEDS[self.kind]
        if self.kind is muster.NodeKind.ROBOT:
            return muster.process(DRIVE, cpu=cpu, memory=memory, actuators=offer.actuators[:1])
        return muster.process(RECOGNISE, cpu=cpu, memory=memory, restart_policy="OnFailure")

    def suits(self, offer: muster.Offer) -> bool:
        able = self.kind is muster.NodeKind.CLOUD or bool(offer.actuators)
        return offer.kind is self.kind and able and offer.free.covers(muster.Compute.of(*NEEDS[self.kind]))

    def vacate(self) -> None:
        self.node = self.task_name = self.task_id = ""


class Patrol(muster.Scheduler):
    def __init__(self, name: str, most_failures: int) -> None:
        self.given_up: Optional[str] = None
        self._name = name
        self._most_failures = most_failures
        self._posts = [
            Post("drive-1", muster.NodeKind.ROBOT),
            Post("drive-2", muster.NodeKind.ROBOT),
            Post("recognise", muster.NodeKind.CLOUD),
        ]

    def registered(self, driver: muster.SchedulerDriver, framework_id: str) -> None:
        print(f"registered as {framework_id}", flush=True)
        for post in self._posts:
            post.vacate()

    def reregistered(self, driver: muster.SchedulerDriver) -> None:
        print("reregistered", flush=True)
        driver.reconcile_tasks()
        self._look(driver)

    def resource_offers(self, driver: muster.SchedulerDriver, offers: Sequence[muster.Offer]) -> None:
        unused = []
        for offer in offers:
            # Each robot has one post: a second driver would wait for its actuators for ever.
            busy = any(post.node == offer.node for post in self._posts)
            post = next((post for post in self._posts if not post.node and not busy and post.suits(offer)), None)
            if post is None:
                unused.append(offer)
            else:
                self._launch(driver, post, offer)
        if unused:
            driver.decline_offer(unused, refuse_seconds=REFUSE_SECONDS)

    def _launch(self, driver: muster.SchedulerDriver, post: Post, offer: muster.Offer) -> None:
        # The name says the role, so that a restarted patrol knows whose task it finds.
        name = f"{self._name}-{post.role}-{uuid.uuid4().hex[:8]}"
        post.node, post.task_name = offer.node, name
        print(f"{post.role}: {offer.node}", flush=True)
        result = driver.launch_tasks(offer, post.task(offer).named(name))
        result.add_done_callback(lambda done: self._launched(driver, post, name, done))

    def _launched(self, driver: muster.SchedulerDriver, post: Post, name: str, done: muster.Launching) -> None:
        if post.task_name != name:  # It has ended already.
            return
        try:
            (launched,) = done.result()
        except muster.CallRefused as refused:
            print(f"{post.role}: not launched: {refused}", flush=True)
            post.vacate()
            if refused.reason is muster.RefusalReason.INVALID:
                self._failed(driver, post)
            return
        except muster.MusterError as error:
            # If it runs after all, reconciliation finds it.
            print(f"{post.role}: not known whether launched: {error}", flush=True)
            post.vacate()
            return
        post.task_id = launched.task_id
        self._look(driver)

    def status_update(self, driver: muster.SchedulerDriver, update: muster.TaskStatus) -> None:
        # The first update of a task may come before the answer to its launch.
        post = next((p for p in self._posts if update.task_id == p.task_id or update.name == p.task_name), None)
        if post is None:
            self._found(driver, update)
            return
        post.task_id = update.task_id
        why = f" ({update.reason}: {update.message})" if update.reason else ""
        print(f"{post.role} on {update.node}: {update.state.name}{why}", flush=True)
        if update.state is muster.TaskState.RUNNING:
            post.failures = 0
        elif update.state.is_terminal:
            post.vacate()
            self._failed(driver, post)

    def _found(self, driver: muster.SchedulerDriver, update: muster.TaskStatus) -> None:
        """A task from before a restart or a lost answer."""
        if update.state.is_terminal:
            return
        post = next((post for post in self._posts if update.name.startswith(f"{self._name}-{post.role}-")), None)
        if post is None or post.node:
            driver.kill_task(update.task_id)
            return
        print(f"{post.role}: found on {update.node}", flush=True)
        post.node, post.task_name, post.task_id = update.node, update.name, update.task_id
        self._look(driver)

    def _failed(self, driver: muster.SchedulerDriver, post: Post) -> None:
        post.failures += 1
        if post.failures > self._most_failures:
            self.given_up = post.role
            driver.stop()
            return
        self._look(driver)

    def _look(self, driver: muster.SchedulerDriver) -> None:
        """Offers are wanted while a post is vacant."""
        if all(post.task_id for post in self._posts):
            driver.suppress_offers()
        elif not all(post.node for post in self._posts):
            driver.revive_offers()

    def node_lost(self, driver: muster.SchedulerDriver, node: str, message: str) -> None:
        # Its task may well go on driving; the controller says when it is over.
        print(f"{node} is lost: {message}", flush=True)

    def error(self, driver: muster.SchedulerDriver, reason: str, message: str) -> None:
        print(f"error: {reason}: {message}", file=sys.stderr)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    program.add_arguments(parser, "patrol")
    parser.add_argument("--at", type=program.position, metavar="X,Y", help="where to patrol; default: everywhere")
    parser.add_argument("--radius", type=float, help="how far from there the robots may be, metres")
    parser.add_argument("--state-file", help="keeps the framework's id: an interrupted patrol leaves its tasks running")
    parser.add_argument("--most-failures", type=int, default=5, help="in a row, of one post (default: %(default)s)")
    arguments = parser.parse_args()
    scheduler = Patrol(arguments.name, arguments.most_failures)
    framework = muster.FrameworkInfo(
        name=arguments.name, namespace=arguments.namespace, position=arguments.at, radius=arguments.radius
    )
    driver = muster.SchedulerDriver(scheduler, framework, arguments.kubeconfig, state_file=arguments.state_file)
    code = program.run(driver, failover=arguments.state_file is not None)
    if scheduler.given_up:
        print(f"error: {scheduler.given_up} fails again and again", file=sys.stderr)
        return 1
    return code


if __name__ == "__main__":
    sys.exit(main())
