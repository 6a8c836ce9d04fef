"""A framework's session, against a controller that the test plays."""

from __future__ import annotations

import gc
import threading
import weakref

import grpc
import pytest

import muster
from fake_controller import PATIENCE
from muster._pb import framework as pb
from muster._stream import Stream
from recorder import Heard, Recorder


def an_offer(id="o-1", node="turtlebot-1", **more):
    fields = {
        "kind": pb.NODE_KIND_ROBOT,
        "score": 2.5,
        "pose": pb.Pose(map="hall", x=1, y=2, yaw=0.5),
        "free": pb.Compute(cpu_millis=1500, memory_bytes=1 << 30, extended={"gpu": 1}),
        "sensors": ["kinect:ImageGen"],
        "actuators": ["base:Drive"],
        **more,
    }
    return pb.Offer(id=id, node=node, **fields)


def an_update(version, state="RUNNING", task="t-1"):
    return pb.Update(task=task, name="drive", node="turtlebot-1", state=f"TASK_STATE_{state}", version=version)


def registered(controller, start, **options):
    driver, scheduler = start(**options)
    session = controller.accept()
    session.subscribed()
    assert scheduler.heard.expect("registered") == ("f-1",)
    return driver, scheduler, session


def test_subscribe_says_everything_about_the_framework(controller, start):
    info = muster.FrameworkInfo(
        name="deliver",
        namespace="hall",
        position=muster.Position(3, 4, map="hall", cost=muster.Cost.TRAVEL_TIME),
        radius=20,
        filter=muster.Filter(
            kind=muster.NodeKind.ROBOT, minimum=muster.Compute.of(cpu="500m", memory="64Mi"), any_actuator=True
        ),
        failover_timeout=90,
        framework_id="f-0",
    )
    driver, scheduler = start(info=info)
    session = controller.accept()
    subscribe = session.subscribed("f-0", reregistered=True)
    scheduler.heard.expect("reregistered")
    assert (subscribe.name, subscribe.namespace, subscribe.framework_id) == ("deliver", "hall", "f-0")
    assert subscribe.position == pb.Position(map="hall", x=3, y=4, radius=20, cost=pb.COST_TRAVEL_TIME)
    assert subscribe.filter.kind == pb.NODE_KIND_ROBOT and subscribe.filter.any_actuator
    assert subscribe.filter.minimum == pb.Compute(cpu_millis=500, memory_bytes=64 << 20)
    assert subscribe.failover_timeout_seconds == 90


def test_offer_launch_answer(controller, start):
    class Launching(Recorder):
        def resource_offers(self, driver, offers):
            (offer,) = offers
            task = muster.process(["drive", "--to", "3,4"], cpu="500m", memory="64Mi", actuators=["base:Drive"])
            # A callback may wait for the answer: it does not come on its thread.
            result = driver.launch_tasks(offer, task.named("drive"), refuse_seconds=1).result(PATIENCE)
            self.heard.tell("launched", offer, result)

    _, scheduler, session = registered(controller, start, scheduler=Launching())
    session.send(offers=pb.Offers(offers=[an_offer()]))
    accept = session.expect("accept")
    assert list(accept.offers) == ["o-1"] and accept.refuse_seconds == 1
    assert accept.launches[0].name == "drive"
    spec = accept.launches[0].spec
    assert spec["resources"]["cpu"] == "500m" and spec["resources"]["memory"] == str(64 << 20)
    assert list(spec["resources"]["actuators"]) == ["base:Drive"]
    assert list(spec["run"]["process"]["command"]) == ["drive", "--to", "3,4"]
    session.answer(launched=[pb.Launched(name="drive", task="t-1", node="turtlebot-1")])
    offer, result = scheduler.heard.expect("launched")
    assert offer.kind is muster.NodeKind.ROBOT and offer.score == 2.5
    assert offer.pose.map == "hall" and offer.free.extended == {"gpu": 1}
    assert offer.free.covers(muster.Compute.of("1.5", "1Gi", gpu=1))
    assert list(result) == [muster.Launched("drive", "t-1", "turtlebot-1")]


def test_a_refusal_is_raised_with_its_causes(controller, start):
    driver, _, session = registered(controller, start)
    result = driver.launch_tasks("o-1", [muster.TaskInfo(spec={"resources": {"cpu": "2core"}})])
    session.expect("accept")
    session.answer(
        refusal=pb.Refusal(
            reason=pb.REFUSAL_REASON_INVALID,
            message="a task is refused",
            causes=[pb.Cause(field="launches[0].spec.resources.cpu", message='"2core" is not a quantity')],
        )
    )
    with pytest.raises(muster.CallRefused) as refused:
        result.result(PATIENCE)
    assert refused.value.reason is muster.RefusalReason.INVALID
    assert refused.value.causes[0].field == "launches[0].spec.resources.cpu"
    assert "2core" in str(refused.value)


def test_done_callbacks_run_on_the_callback_thread(controller, start):
    driver, scheduler, session = registered(controller, start)
    heard = Heard()
    result = driver.kill_task("t-1", grace_seconds=3)
    result.add_done_callback(lambda done: heard.tell("done", done.result(), threading.current_thread().name))
    kill = session.expect("kill")
    assert (kill.task, kill.grace_period_seconds) == ("t-1", 3)
    session.answer()
    assert heard.expect("done") == (None, "muster-callbacks")


def test_every_action_has_its_call(controller, start):
    driver, _, session = registered(controller, start, info=muster.FrameworkInfo(name="deliver", radius=7))
    results = [driver.decline_offer(["o-1", "o-2"], refuse_seconds=0)]
    decline = session.expect("decline")
    assert list(decline.offers) == ["o-1", "o-2"] and decline.HasField("refuse_seconds")
    session.answer()
    results.append(driver.suppress_offers())
    session.expect("suppress")
    session.answer()
    results.append(driver.set_position(muster.Position(1, 2)))
    assert session.expect("set_position").position.radius == 7
    session.answer()
    results.append(driver.set_position(None))
    assert not session.expect("set_position").HasField("position")
    session.answer()
    results.append(driver.request_resources(muster.Filter(sensors=("kinect:ImageGen",))))
    assert list(session.expect("set_filter").filter.sensors) == ["kinect:ImageGen"]
    session.answer()
    session.expect("revive")
    session.answer()
    results.append(driver.reconcile_tasks(["t-1"]))
    assert list(session.expect("reconcile").tasks) == ["t-1"]
    session.answer()
    for result in results:
        assert result.result(PATIENCE) is None


def test_a_rescind_is_told_once_the_offer_was(controller, start):
    _, scheduler, session = registered(controller, start)
    session.send(offers=pb.Offers(offers=[an_offer()]))
    scheduler.heard.expect("resource_offers")
    session.send(rescind=pb.Rescind(offers=["o-1"], reason=pb.RESCIND_REASON_CLOSER))
    assert scheduler.heard.expect("offer_rescinded") == ("o-1", muster.RescindReason.CLOSER)


class Slow(Recorder):
    """Stays in its first resource_offers until it is let go."""

    def __init__(self):
        super().__init__()
        self.go_on = threading.Event()
        self.first = True

    def resource_offers(self, driver, offers):
        super().resource_offers(driver, offers)
        if self.first:
            self.first = False
            assert self.go_on.wait(PATIENCE)


def test_a_slow_callback_holds_up_neither_answers_nor_heartbeats_and_finds_only_what_still_counts(controller, start):
    driver, scheduler = start(scheduler=Slow())
    session = controller.accept()
    session.subscribed(heartbeat_ms=60_000)
    scheduler.heard.expect("registered")
    session.send(offers=pb.Offers(offers=[an_offer("o-1")]))
    scheduler.heard.expect("resource_offers")
    session.send(offers=pb.Offers(offers=[an_offer("o-2"), an_offer("o-3")]))
    session.send(rescind=pb.Rescind(offers=["o-2"], reason=pb.RESCIND_REASON_TAKEN))
    for version in range(1, 1000):
        session.send(update=an_update(version))
        session.send(heartbeat=pb.Heartbeat())
    session.send(update=an_update(1000, "SUCCEEDED"))
    result = driver.kill_task("t-9")
    session.expect("kill")
    session.answer()
    result.result(PATIENCE)
    scheduler.go_on.set()
    (offers,) = scheduler.heard.expect("resource_offers")
    assert [offer.id for offer in offers] == ["o-3"]
    (update,) = scheduler.heard.expect("status_update")
    assert (update.version, update.state) == (1000, muster.TaskState.SUCCEEDED)
    assert session.expect("acknowledge").version == 1000
    assert scheduler.heard.nothing()


def test_an_update_is_delivered_once_and_acknowledged_as_often_as_it_comes(controller, start):
    _, scheduler, session = registered(controller, start)
    session.send(update=an_update(3))
    (update,) = scheduler.heard.expect("status_update")
    assert (update.task_id, update.state, update.exit_code) == ("t-1", muster.TaskState.RUNNING, None)
    assert session.expect("acknowledge") == pb.Acknowledge(task="t-1", version=3)
    for version in (3, 2):
        session.send(update=an_update(version))
        session.expect("acknowledge")
    session.send(update=an_update(4, "FAILED"))
    (update,) = scheduler.heard.expect("status_update")
    assert update.version == 4 and update.state.is_terminal


def test_updates_are_acknowledged_after_the_callback(controller, start):
    class Holding(Recorder):
        def __init__(self):
            super().__init__()
            self.go_on = threading.Event()

        def status_update(self, driver, update):
            super().status_update(driver, update)
            assert self.go_on.wait(PATIENCE)

    driver, scheduler, session = registered(controller, start, scheduler=Holding())
    session.send(update=an_update(1))
    scheduler.heard.expect("status_update")
    session.send(update=an_update(1))
    # Calls are sent in order, and this one is first though the update came before.
    driver.kill_task("t-1")
    session.expect("kill")
    session.answer()
    scheduler.go_on.set()
    assert session.expect("acknowledge").version == 1


def test_explicit_acknowledgement(controller, start):
    driver, scheduler, session = registered(controller, start, implicit_acknowledgements=False)
    session.send(update=an_update(1))
    (update,) = scheduler.heard.expect("status_update")
    driver.kill_task("t-1")
    session.expect("kill")
    driver.acknowledge_status_update(update)
    assert session.expect("acknowledge") == pb.Acknowledge(task="t-1", version=1)


def test_reconciling_brings_what_was_told_before(controller, start):
    driver, scheduler, session = registered(controller, start)
    session.send(update=an_update(1))
    scheduler.heard.expect("status_update")
    session.expect("acknowledge")
    driver.reconcile_tasks()
    session.expect("reconcile")
    session.send(update=an_update(1))
    (update,) = scheduler.heard.expect("status_update")
    assert update.version == 1


def test_a_broken_session_is_resumed_with_the_id(controller, start):
    driver, scheduler, session = registered(controller, start)
    launch = driver.launch_tasks("o-1", muster.process(["true"]))
    session.expect("accept")
    kill = driver.kill_task("t-1")
    session.expect("kill")
    session.end((grpc.StatusCode.UNAVAILABLE, "restarting"))
    scheduler.heard.expect("disconnected")
    with pytest.raises(muster.Disconnected):
        launch.result(PATIENCE)
    again = controller.accept()
    assert again.subscribed(reregistered=True).framework_id == "f-1"
    scheduler.heard.expect("reregistered")
    # What may be said twice is said again.
    assert again.expect("kill").task == "t-1"
    again.answer()
    kill.result(PATIENCE)
    again.send(update=an_update(1))
    scheduler.heard.expect("status_update")


def test_suppressed_offers_stay_so_in_the_next_session(controller, start):
    driver, scheduler, session = registered(controller, start)
    suppressed = driver.suppress_offers()
    session.expect("suppress")
    session.answer()
    suppressed.result(PATIENCE)
    session.end()
    scheduler.heard.expect("disconnected")
    again = controller.accept()
    again.subscribed(reregistered=True)
    scheduler.heard.expect("reregistered")
    again.expect("suppress")
    revived = driver.revive_offers()
    again.expect("revive")
    again.answer()
    revived.result(PATIENCE)
    again.end()
    third = controller.accept()
    third.subscribed(reregistered=True)
    driver.kill_task("t-1")
    third.expect("kill")  # And nothing before it.


def test_a_run_is_known_by_its_nonce_until_it_has_an_id(controller, start):
    start()
    first = controller.accept()
    lost = first.expect("subscribe")
    first.end()  # Its Subscribed does not arrive.
    again = controller.accept().subscribed()
    assert lost.nonce and again.nonce == lost.nonce
    assert (lost.framework_id, again.framework_id) == ("", "")


def test_wishes_said_while_away_are_said_after_and_only_the_last_of_each(controller, start):
    driver, scheduler, session = registered(controller, start)
    session.end()
    scheduler.heard.expect("disconnected")
    again = controller.accept()  # Not answered yet: there is no session.
    with pytest.raises(muster.Disconnected):
        driver.decline_offer("o-1").result(PATIENCE)
    overtaken = driver.set_position(muster.Position(1, 1))
    driver.set_position(muster.Position(2, 2))
    driver.suppress_offers()
    driver.revive_offers()
    assert overtaken.result(PATIENCE) is None
    again.subscribed(reregistered=True)
    assert again.expect("set_position").position.x == 2
    again.expect("revive")


def test_the_next_session_subscribes_with_the_position_that_was_set(controller, start):
    driver, scheduler, session = registered(controller, start)
    result = driver.set_position(muster.Position(5, 6))
    session.expect("set_position")
    session.answer()
    result.result(PATIENCE)
    refused = driver.set_filter(muster.Filter(selector="("))
    session.expect("set_filter")
    session.answer(refusal=pb.Refusal(reason=pb.REFUSAL_REASON_INVALID, message="no selector"))
    with pytest.raises(muster.CallRefused):
        refused.result(PATIENCE)
    session.end()
    again = controller.accept()
    subscribe = again.subscribed(reregistered=True)
    assert subscribe.position.x == 5
    assert subscribe.filter.selector == "", "what was refused would end the framework here"


def test_where_somebody_else_sets_it_to_work_is_said_and_remembered(controller, start):
    info = muster.FrameworkInfo(name="deliver", position=muster.Position(1, 1), radius=7)
    driver, scheduler, session = registered(controller, start, info=info)
    there = pb.Position(map="hall", x=5, y=6, radius=3, cost=pb.COST_TRAVEL_TIME)
    session.send(moved=pb.Moved(position=there, by="ada"))
    position = muster.Position(5, 6, map="hall", radius=3, cost=muster.Cost.TRAVEL_TIME)
    assert scheduler.heard.expect("moved") == (position, "ada")
    session.end()
    again = controller.accept()
    assert again.subscribed(reregistered=True).position == there
    assert (scheduler.heard.expect("disconnected"), scheduler.heard.expect("reregistered")) == ((), ())
    anywhere = pb.Position(map="map", x=8, y=9, cost=pb.COST_DISTANCE)
    again.send(moved=pb.Moved(position=anywhere, by="ada"))
    assert scheduler.heard.expect("moved") == (muster.Position(8, 9), "ada")
    again.send(moved=pb.Moved(by="ada"))
    assert scheduler.heard.expect("moved") == (None, "ada")
    again.send(moved=pb.Moved(position=anywhere, by="ada"))
    scheduler.heard.expect("moved")
    again.end()
    last = controller.accept()
    assert last.subscribed(reregistered=True).position == anywhere, "at any distance"


def test_a_silent_connection_is_given_up_after_five_heartbeats(controller, start):
    driver, scheduler = start()
    session = controller.accept()
    session.subscribed(heartbeat_ms=40)
    scheduler.heard.expect("registered")
    scheduler.heard.expect("disconnected")
    session.expect_end()
    controller.accept().subscribed(reregistered=True)
    scheduler.heard.expect("reregistered")


def test_a_framework_that_was_forgotten_begins_anew(controller, start):
    driver, scheduler, session = registered(controller, start)
    session.send(update=an_update(7))
    scheduler.heard.expect("status_update")
    session.end()
    scheduler.heard.expect("disconnected")
    again = controller.accept()
    again.subscribed("f-2", reregistered=False)
    assert scheduler.heard.expect("registered") == ("f-2",)
    assert driver.framework_id == "f-2"


@pytest.mark.parametrize(("reason", "next_id"), [("Unavailable", "f-0"), ("Ending", "f-0"), ("UnknownFramework", "")])
def test_a_subscribe_is_said_again_where_that_is_of_use(controller, start, reason, next_id):
    _, scheduler = start(info=muster.FrameworkInfo(name="deliver", framework_id="f-0"))
    session = controller.accept()
    session.expect("subscribe")
    session.send(error=pb.Error(reason=reason, message="no"))
    session.end()
    again = controller.accept()
    assert again.subscribed("f-2").framework_id == next_id
    assert scheduler.heard.expect("registered") == ("f-2",)


def test_a_subscribe_that_stays_refused_is_an_error(controller, start):
    driver, scheduler = start()
    session = controller.accept()
    session.expect("subscribe")
    session.send(error=pb.Error(reason="AlreadyExists", message="no"))
    assert scheduler.heard.expect("error") == ("AlreadyExists", "no")
    assert driver.join(PATIENCE) is muster.DriverState.ABORTED


def test_stop_tears_the_framework_down(controller, start, tmp_path):
    state = tmp_path / "state"
    driver, scheduler, session = registered(controller, start, state_file=state)
    assert state.exists()
    driver.stop()
    session.expect("teardown")
    session.answer()
    session.expect_end()
    session.end()
    assert driver.join(PATIENCE) is muster.DriverState.STOPPED
    assert not state.exists(), "there is nothing to come back to"
    with pytest.raises(muster.DriverNotRunning):
        driver.kill_task("t-1").result(PATIENCE)


def test_stop_with_failover_only_leaves_and_the_state_file_brings_the_next_one_back(controller, start, tmp_path):
    state = tmp_path / "state"

    class Stopping(Recorder):
        def status_update(self, driver, update):
            driver.stop(failover=True)

    driver, scheduler, session = registered(controller, start, scheduler=Stopping(), state_file=state)
    session.send(update=an_update(1))
    session.expect("acknowledge")
    session.expect_end()
    session.end()
    assert driver.join(PATIENCE) is muster.DriverState.STOPPED

    driver, scheduler = start(state_file=state)
    session = controller.accept()
    assert session.subscribed(reregistered=True).framework_id == "f-1"
    scheduler.heard.expect("reregistered")
    with pytest.raises(muster.ConfigError, match="default/deliver"):
        start(info=muster.FrameworkInfo(name="patrol"), state_file=state)


def test_a_teardown_outlives_a_broken_session(controller, start):
    driver, scheduler, session = registered(controller, start)
    driver.stop()
    session.expect("teardown")
    session.end((grpc.StatusCode.UNAVAILABLE, "restarting"))
    again = controller.accept()
    again.subscribed(reregistered=True)
    again.expect("teardown")
    again.answer()
    again.expect_end()
    again.end()
    assert driver.join(PATIENCE) is muster.DriverState.STOPPED


@pytest.fixture
def calls(monkeypatch):
    """Weak references to gRPC's calls. With one alive at its end, Python may hang."""
    made = []
    begin = Stream.__init__

    def watched(stream, *arguments):
        begin(stream, *arguments)
        made.append(weakref.ref(stream._call))

    monkeypatch.setattr(Stream, "__init__", watched)
    gc.disable()
    yield made
    gc.enable()


@pytest.mark.parametrize("last", [None, (grpc.StatusCode.UNAVAILABLE, "down"), (grpc.StatusCode.UNAUTHENTICATED, "who?")])
def test_no_call_of_grpc_outlives_its_driver(controller, start, calls, last):
    driver, scheduler, session = registered(controller, start)
    session.end((grpc.StatusCode.UNAVAILABLE, "broken"))
    session = controller.accept()
    session.subscribed(reregistered=True)
    scheduler.heard.expect("disconnected")
    scheduler.heard.expect("reregistered")
    if last is None:
        driver.stop()
        session.expect("teardown")
        session.answer()
        session.expect_end()
    session.end(last)
    if last is not None and last[0] is grpc.StatusCode.UNAVAILABLE:
        controller.accept()
        driver.abort()
    driver.join(PATIENCE)
    assert len(calls) in (2, 3) and [call() for call in calls] == [None] * len(calls)


def test_an_error_is_the_last_thing_told(controller, start):
    driver, scheduler, session = registered(controller, start)
    session.send(update=an_update(1))
    session.send(error=pb.Error(reason="Displaced", message="another session has this framework"))
    scheduler.heard.expect("status_update")
    assert scheduler.heard.expect("error") == ("Displaced", "another session has this framework")
    assert driver.join(PATIENCE) is muster.DriverState.ABORTED


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (grpc.StatusCode.PERMISSION_DENIED, "PermissionDenied"),
        (grpc.StatusCode.UNAUTHENTICATED, "Unauthenticated"),
        (grpc.StatusCode.UNIMPLEMENTED, "Unimplemented"),
    ],
)
def test_who_may_not_is_not_to_try_again(controller, start, code, reason):
    driver, scheduler = start()
    session = controller.accept()
    session.expect("subscribe")
    session.end((code, "no"))
    assert scheduler.heard.expect("error") == (reason, "no")
    assert driver.join(PATIENCE) is muster.DriverState.ABORTED


def test_an_exception_of_a_callback_ends_the_driver_and_leaves_its_update_unacknowledged(controller, start):
    class Broken(Recorder):
        def status_update(self, driver, update):
            raise LookupError("a bug")

    driver, scheduler, session = registered(controller, start, scheduler=Broken())
    session.send(update=an_update(1))
    with pytest.raises(LookupError):
        driver.join(PATIENCE)
    session.expect_end()


def test_messages_of_four_mebibytes_both_ways_and_none_larger(controller, start):
    driver, scheduler, session = registered(controller, start)
    data = bytes(range(256)) * (4 << 12)
    assert len(data) == 4 << 20
    result = driver.send_framework_message("e-1", data)
    assert session.expect("message").data == data
    session.answer()
    result.result(PATIENCE)
    session.send(message=pb.Message(executor="e-1", node="turtlebot-1", data=data))
    assert scheduler.heard.expect("framework_message") == ("e-1", "turtlebot-1", data)
    with pytest.raises(ValueError, match="4194304"):
        driver.send_framework_message("e-1", data + b"x")


def test_unicode_goes_both_ways(controller, start):
    driver, scheduler, session = registered(controller, start)
    text = "Gänge 走廊 🤖\u0000"
    driver.launch_tasks("o-1", muster.process(["say", text], env={"WHERE": text}, name="say"))
    run = session.expect("accept").launches[0].spec["run"]["process"]
    assert list(run["command"]) == ["say", text] and run["env"][0]["value"] == text
    session.send(node_lost=pb.NodeLost(node="turtlebot-1", message=text))
    assert scheduler.heard.expect("node_lost") == ("turtlebot-1", text)
    session.send(executor_lost=pb.ExecutorLost(executor="e-1", node="n", exit_code=-9, message=text))
    assert scheduler.heard.expect("executor_lost") == ("e-1", "n", -9, text)


def test_positions_come_from_a_source(controller, start):
    class Source:
        def start(self, moved):
            self.moved = moved

        def stop(self):
            self.moved = None

    source = Source()
    driver = muster.SchedulerDriver(Recorder(), muster.FrameworkInfo(name="deliver"), controller.kubeconfig)
    driver.follow(source)
    driver.start()
    session = controller.accept()
    session.subscribed()
    source.moved(muster.Position(8, 9))
    assert session.expect("set_position").position.y == 9
    driver.abort()
    driver.join(PATIENCE)
    assert source.moved is None


def test_what_is_wrong_at_the_start_is_said_at_the_start(tmp_path):
    driver = muster.SchedulerDriver(Recorder(), muster.FrameworkInfo(name="deliver"), tmp_path / "none")
    with pytest.raises(muster.ConfigError, match="does not exist"):
        driver.start()
