from __future__ import annotations

import contextlib

import pytest

import muster
from fake_controller import PATIENCE, FakeController, Pki
from recorder import Recorder


@pytest.fixture(scope="session")
def pki():
    return Pki()


@pytest.fixture
def controller(pki, tmp_path):
    controller = FakeController(pki, tmp_path)
    yield controller
    controller.close()


@pytest.fixture
def start(controller):
    """Starts a driver and gives it with its recorder; drivers that a test leaves running are aborted."""
    drivers = []

    def start(scheduler=None, info=None, **options):
        scheduler = scheduler or Recorder()
        info = info or muster.FrameworkInfo(name="deliver")
        driver = muster.SchedulerDriver(scheduler, info, controller.kubeconfig, **options)
        driver.start()
        drivers.append(driver)
        return driver, scheduler

    yield start
    for driver in drivers:
        driver.abort()
        with contextlib.suppress(Exception):  # The test that provoked it has looked at it.
            driver.join(PATIENCE)
        assert driver.state in (muster.DriverState.STOPPED, muster.DriverState.ABORTED)
