#!/usr/bin/env python3
"""A framework on strings, for tests: does what its standard input says, and says on standard output what it holds and hears.

One JSON object a line, both ways. In: {"do": "launch" | "decline" | "suppress" | "revive" | "position" | "filter" |
"kill" | "reconcile" | "message" | "leave" | "stop", …}. Out: {"event": …}; "holding" is every offer that is out, by node.
"""

import json
import sys
import threading

import muster


class Puppet(muster.Scheduler):
    def __init__(self):
        self.held = {}
        self.lock = threading.Lock()
        self.voice = threading.Lock()

    def say(self, **event):
        # Two threads say things: callbacks and orders.
        with self.voice:
            print(json.dumps(event), flush=True)

    def say_held(self):
        self.say(
            event="holding",
            offers={
                offer.node: {
                    "score": offer.score,
                    "cpu": offer.free.cpu_millis,
                    "memory": offer.free.memory_bytes,
                    "sensors": sorted(offer.sensors),
                    "actuators": sorted(offer.actuators),
                    "kind": offer.kind.name,
                    "executors": {executor.name: executor.task_id for executor in offer.executors},
                }
                for offer in self.held.values()
            },
        )

    def registered(self, driver, framework_id):
        self.say(event="registered", id=framework_id)

    def reregistered(self, driver):
        self.say(event="reregistered")

    def disconnected(self, driver):
        with self.lock:
            self.held.clear()
        self.say(event="disconnected")

    def resource_offers(self, driver, offers):
        with self.lock:
            self.held.update((offer.id, offer) for offer in offers)
            self.say_held()

    def offer_rescinded(self, driver, offer_id, reason):
        with self.lock:
            self.held.pop(offer_id, None)
            self.say_held()

    def status_update(self, driver, update):
        self.say(
            event="update", task=update.task_id, name=update.name, node=update.node, state=update.state.name,
            reason=update.reason, exit_code=update.exit_code,
        )

    def framework_message(self, driver, executor, node, data):
        self.say(event="message", executor=executor, node=node, data=data.decode())

    def node_lost(self, driver, node, message):
        self.say(event="node_lost", node=node)

    def executor_lost(self, driver, executor, node, exit_code, message):
        self.say(event="executor_lost", executor=executor, node=node)

    def error(self, driver, reason, message):
        self.say(event="error", reason=reason, message=message)

    def offer_of(self, node):
        with self.lock:
            return next((offer for offer in self.held.values() if offer.node == node), None)

    def launch(self, driver, tasks):
        """All in one call: each is {"node": …, "name": …, "spec": …}."""
        offers = [self.offer_of(task["node"]) for task in tasks]
        if None in offers:
            return self.say(event="refused", reason="NO_SUCH_OFFER", message="not held")
        infos = [
            muster.TaskInfo(name=task.get("name"), spec=task["spec"], offer=offer.id)
            for task, offer in zip(tasks, offers)
        ]
        with self.lock:
            for offer in offers:
                self.held.pop(offer.id, None)
        try:
            launched = driver.launch_tasks(list(dict.fromkeys(offers_ids(offers))), infos).result(60)
            self.say(event="launched", tasks={one.name: one.task_id for one in launched.launched})
        except muster.CallRefused as refused:
            # What a refused call named is still out, unless it is rescinded.
            with self.lock:
                self.held.update((offer.id, offer) for offer in offers)
            self.say(event="refused", reason=refused.reason.name, message=refused.message)


def offers_ids(offers):
    return [offer.id for offer in offers]


def obey(puppet, driver, order):
    what = order.pop("do")
    if what == "launch":
        puppet.launch(driver, order["tasks"])
    elif what == "decline":
        offer = puppet.offer_of(order["node"])
        with puppet.lock:
            puppet.held.pop(offer.id, None)
        driver.decline_offer(offer, refuse_seconds=order.get("seconds", 5))
    elif what == "suppress":
        driver.suppress_offers()
    elif what == "revive":
        driver.revive_offers()
    elif what == "position":
        driver.set_position(muster.Position(x=order["x"], y=order["y"], radius=order.get("radius")))
    elif what == "kill":
        driver.kill_task(order["task"], grace_seconds=order.get("grace"))
    elif what == "reconcile":
        driver.reconcile_tasks(order.get("tasks", []))
    elif what == "message":
        driver.send_framework_message(order["executor"], order["data"].encode())
    elif what == "leave":
        driver.stop(failover=True)
        return False
    elif what == "stop":
        driver.stop()
        return False
    return True


def main():
    info = json.loads(sys.argv[1])
    position = info.get("position")
    cost = muster.Cost[info.get("cost", "DISTANCE")]
    puppet = Puppet()
    driver = muster.SchedulerDriver(
        puppet,
        muster.FrameworkInfo(
            name=info["name"],
            namespace=info.get("namespace", "default"),
            position=muster.Position(x=position[0], y=position[1], cost=cost) if position else None,
            radius=info.get("radius"),
            failover_timeout=info.get("failover_timeout"),
            framework_id=info.get("id", ""),
        ),
        kubeconfig=sys.argv[2],
    )
    driver.start()
    for line in sys.stdin:
        if not obey(puppet, driver, json.loads(line)):
            break
    else:
        driver.stop(failover=True)
    driver.join()
    puppet.say(event="ended")


if __name__ == "__main__":
    main()
