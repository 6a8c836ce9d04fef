"""Classes that are written with the names of the paper and of Mesos."""

from __future__ import annotations

import inspect

import muster
from muster.scheduler import _CALLBACKS


def test_a_scheduler_with_mesos_names_and_arguments():
    class Mesos(muster.Scheduler):
        def __init__(self):
            self.heard = []

        def registered(self, driver, frameworkId, masterInfo):
            self.heard.append((frameworkId, masterInfo))

        def resourceOffers(self, driver, offers):
            self.heard.append(offers)

        def offerRescinded(self, driver, offerId):
            self.heard.append(offerId)

        def slaveLost(self, driver, slaveId):
            self.heard.append(slaveId)

        def executorLost(self, driver, executorId, slaveId, status):
            self.heard.append((executorId, slaveId, status))

        def error(self, driver, message):
            self.heard.append(message)

    scheduler = Mesos()
    scheduler.registered(None, "f-1")
    scheduler.resource_offers(None, [])
    scheduler.offer_rescinded(None, "o-1", muster.RescindReason.TAKEN)
    scheduler.node_lost(None, "n-1", "away")
    scheduler.executor_lost(None, "e-1", "n-1", 1, "fell")
    scheduler.error(None, "Displaced", "by another")
    scheduler.status_update(None, None)  # Not overridden: ours.
    assert scheduler.heard == [("f-1", None), [], "o-1", "n-1", ("e-1", "n-1", 1), "Displaced: by another"]


def test_the_papers_names_with_our_arguments():
    class Paper(muster.Scheduler):
        def nodeLost(self, driver, node, message):
            self.lost = (node, message)

        def statusUpdate(self, *everything):
            self.update = everything

    scheduler = Paper()
    scheduler.node_lost(None, "n-1", "away")
    scheduler.status_update(None, "u")
    assert (scheduler.lost, scheduler.update) == (("n-1", "away"), (None, "u"))


def test_the_newest_class_wins_whatever_name_it_uses():
    class Older(muster.Scheduler):
        def resourceOffers(self, driver, offers):
            self.told = "older"

    class Newer(Older):
        def resource_offers(self, driver, offers):
            super().resource_offers(driver, offers)
            self.told += ", newer"

    class Newest(Newer):
        def resourceOffers(self, driver, offers):
            super().resource_offers(driver, offers)
            self.told += ", newest"

    scheduler = Newest()
    scheduler.resource_offers(None, [])
    assert scheduler.told == "older, newer, newest"


def test_an_executor_with_mesos_names():
    class Mesos(muster.Executor):
        def launchTask(self, driver, task):
            self.task = task

        def killTask(self, driver, taskId):
            self.killed = taskId

        def shutdown(self, driver):
            self.down = True

    executor = Mesos()
    executor.launch_task(None, "t")
    executor.kill_task(None, "t-1", 2.0)
    executor.shutdown(None, 1.0)
    assert (executor.task, executor.killed, executor.down) == ("t", "t-1", True)


def test_every_callback_can_be_written_in_camel_case():
    ours = [name for name, member in vars(muster.Scheduler).items() if inspect.isfunction(member) and name[0] != "_"]
    for name in ours:
        first, *rest = name.split("_")
        camel = first + "".join(word.capitalize() for word in rest)
        assert camel == name or camel in _CALLBACKS[name].names


def test_the_actions_have_the_papers_names():
    for name in ("launchTasks", "killTask", "declineOffer", "reviveOffers", "requestResources", "setFilter"):
        assert callable(getattr(muster.SchedulerDriver, name))
    for name in ("setPosition", "sendFrameworkMessage", "suppressOffers", "reconcileTasks"):
        assert callable(getattr(muster.SchedulerDriver, name))
    assert callable(muster.ExecutorDriver.sendStatusUpdate)
