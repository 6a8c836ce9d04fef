#!/usr/bin/env python3
"""An executor on strings, for tests: runs its tasks by doing nothing, ends one when it is told `finish NAME`, and echoes
every other message."""

import muster


class Worker(muster.Executor):
    def __init__(self):
        self.tasks = {}

    def registered(self, driver, info):
        driver.send_framework_message(f"ready {info.framework} {info.framework_id}".encode())

    def launch_task(self, driver, task):
        self.tasks[task.name] = task.task_id
        driver.send_status_update(task.task_id, muster.ExecutorTaskState.RUNNING)

    def kill_task(self, driver, task_id, grace_seconds):
        driver.send_status_update(task_id, muster.ExecutorTaskState.KILLED)

    def framework_message(self, driver, data):
        word, _, name = data.decode().partition(" ")
        if word == "finish":
            driver.send_status_update(self.tasks.pop(name), muster.ExecutorTaskState.SUCCEEDED)
        else:
            driver.send_framework_message(data)


muster.ExecutorDriver(Worker()).run()
