"""A scheduler and an executor that write down what they are told, for tests to wait for."""

from __future__ import annotations

import queue
from typing import Any

import muster
from fake_controller import PATIENCE


class Heard:
    def __init__(self) -> None:
        self._heard: queue.Queue[tuple[Any, ...]] = queue.Queue()

    def tell(self, *what: Any) -> None:
        self._heard.put(what)

    def expect(self, name: str) -> tuple[Any, ...]:
        """The arguments of the next callback, which is this one."""
        heard = self._heard.get(timeout=PATIENCE)
        assert heard[0] == name, heard
        return heard[1:]

    def nothing(self) -> bool:
        return self._heard.empty()


class Recorder(muster.Scheduler):
    def __init__(self) -> None:
        self.heard = Heard()

    def registered(self, driver, framework_id):
        self.heard.tell("registered", framework_id)

    def reregistered(self, driver):
        self.heard.tell("reregistered")

    def disconnected(self, driver):
        self.heard.tell("disconnected")

    def resource_offers(self, driver, offers):
        self.heard.tell("resource_offers", offers)

    def offer_rescinded(self, driver, offer_id, reason):
        self.heard.tell("offer_rescinded", offer_id, reason)

    def status_update(self, driver, update):
        self.heard.tell("status_update", update)

    def framework_message(self, driver, executor, node, data):
        self.heard.tell("framework_message", executor, node, data)

    def node_lost(self, driver, node, message):
        self.heard.tell("node_lost", node, message)

    def moved(self, driver, position, by):
        self.heard.tell("moved", position, by)

    def executor_lost(self, driver, executor, node, exit_code, message):
        self.heard.tell("executor_lost", executor, node, exit_code, message)

    def error(self, driver, reason, message):
        self.heard.tell("error", reason, message)


class ExecutorRecorder(muster.Executor):
    def __init__(self) -> None:
        self.heard = Heard()

    def registered(self, driver, info):
        self.heard.tell("registered", info)

    def reregistered(self, driver, info):
        self.heard.tell("reregistered", info)

    def disconnected(self, driver):
        self.heard.tell("disconnected")

    def launch_task(self, driver, task):
        self.heard.tell("launch_task", task)

    def kill_task(self, driver, task_id, grace_seconds):
        self.heard.tell("kill_task", task_id, grace_seconds)

    def framework_message(self, driver, data):
        self.heard.tell("framework_message", data)

    def shutdown(self, driver, grace_seconds):
        self.heard.tell("shutdown", grace_seconds)

    def error(self, driver, message):
        self.heard.tell("error", message)
