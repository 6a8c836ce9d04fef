//! An executor for tests and benchmarks: says "ready", and from then on sends every message back.

use bytes::Bytes;
use muster_sdk::executor::{
    Executor, ExecutorDriver, ExecutorError, ExecutorHandle, Registration, Status, Task, TaskState,
};

struct Echo;

impl Echo {
    /// An executor whose driver has ended has nobody to tell.
    async fn send(&self, handle: &ExecutorHandle, data: Bytes) {
        let _ = handle.send_framework_message(data).await;
    }

    async fn update(&self, handle: &ExecutorHandle, task: &str, state: TaskState) {
        let _ = handle.send_status_update(Status::new(task, state)).await;
    }
}

impl Executor for Echo {
    async fn registered(&mut self, handle: &ExecutorHandle, _: Registration) {
        self.send(handle, "ready".into()).await;
    }

    async fn launch_task(&mut self, handle: &ExecutorHandle, task: Task) {
        self.update(handle, &task.uid, TaskState::Running).await;
    }

    async fn kill_task(&mut self, handle: &ExecutorHandle, task: &str, _: std::time::Duration) {
        self.update(handle, task, TaskState::Killed).await;
    }

    async fn framework_message(&mut self, handle: &ExecutorHandle, data: Bytes) {
        self.send(handle, data).await;
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), ExecutorError> {
    ExecutorDriver::from_env()?.run(Echo).await;
    Ok(())
}
