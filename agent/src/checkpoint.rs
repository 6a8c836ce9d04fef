//! What survives the agent: one small file a task, `tasks/<uid>/task.json`, whole and synced.

use std::fs;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use muster_agent_core::workload::Workload;
use muster_api::id::TaskUid;
use muster_api::kind::task::TaskSpec;
use serde::{Deserialize, Serialize};

use crate::durable::{self, FileError, Keep};

/// What the controller assigned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Assignment {
    pub(crate) namespace: String,
    pub(crate) name: String,
    pub(crate) spec: TaskSpec,
    /// `<node>.<group>:<epoch>[,sequence…]`, when the task has the right to the actuators.
    pub(crate) lease: Option<String>,
    /// Who launched it; none: a declared task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) framework: Option<Framework>,
}

/// An outside scheduler.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Framework {
    pub(crate) id: String,
    pub(crate) name: String,
}

/// One task's file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Record {
    /// The boot that the workload's times belong to.
    pub(crate) boot_id: String,
    /// What the task shows at its executor socket. Records of before executors have none, and
    /// neither do their processes.
    #[serde(default = "token")]
    pub(crate) token: String,
    pub(crate) assignment: Assignment,
    pub(crate) workload: Workload,
}

impl Record {
    pub(crate) fn new(boot_id: &str, assignment: Assignment, workload: Workload) -> Record {
        Record { boot_id: boot_id.to_owned(), token: token(), assignment, workload }
    }
}

/// One that nobody guesses.
pub(crate) fn token() -> String {
    uuid::Uuid::new_v4().simple().to_string()
}

/// The directory of all tasks.
#[derive(Debug, Clone)]
pub(crate) struct Checkpoint {
    tasks: PathBuf,
}

impl Checkpoint {
    pub(crate) fn open(data_dir: &Path) -> Result<Checkpoint, FileError> {
        let tasks = data_dir.join("tasks");
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o711)
            .create(&tasks)
            .map_err(FileError::at("make", &tasks))?;
        durable::sync_dir(data_dir)?;
        Ok(Checkpoint { tasks })
    }

    pub(crate) fn tasks(&self) -> &Path {
        &self.tasks
    }

    pub(crate) fn task_dir(&self, uid: &TaskUid) -> PathBuf {
        self.tasks.join(uid.as_str())
    }

    pub(crate) fn write(&self, record: &Record) -> Result<(), FileError> {
        let dir = self.task_dir(&record.workload.uid);
        if !dir.exists() {
            fs::DirBuilder::new().mode(0o711).create(&dir).map_err(FileError::at("make", &dir))?;
            durable::sync_dir(&self.tasks)?;
        }
        durable::write_json(&dir.join("task.json"), record, Keep::PowerCut)
    }

    /// Drops a task whole. Its record goes first: a directory without one is swept at the next start.
    pub(crate) fn drop_task(&self, uid: &TaskUid) -> Result<(), FileError> {
        let dir = self.task_dir(uid);
        let record = dir.join("task.json");
        match fs::remove_file(&record) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(FileError::at("remove", &record)(error));
            }
            _ => {}
        }
        match fs::remove_dir_all(&dir) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(FileError::at("remove", &dir)(error))
            }
            _ => Ok(()),
        }
    }

    /// Every task of an earlier life. A directory without a record is removed; a record that cannot
    /// be read is an error that names it: going on without would start its task a second time.
    pub(crate) fn read_all(&self) -> Result<Vec<Record>, FileError> {
        let mut records = Vec::new();
        let entries = fs::read_dir(&self.tasks).map_err(FileError::at("list", &self.tasks))?;
        for entry in entries {
            let dir = entry.map_err(FileError::at("list", &self.tasks))?.path();
            match durable::read_json(&dir.join("task.json"))? {
                Some(record) => records.push(record),
                None => {
                    tracing::info!(dir = %dir.display(), "a directory of no task is removed");
                    let _ = fs::remove_dir_all(&dir);
                }
            }
        }
        Ok(records)
    }
}
