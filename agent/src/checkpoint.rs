//! What survives the agent: one small file a task, `tasks/<uid>/task.json`, whole and synced, and beside it
//! `config.sealed` for a task that was given values of ConfigMaps and Secrets.

use std::fs;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use muster_agent_core::workload::Workload;
use muster_api::id::TaskUid;
use muster_api::kind::task::TaskSpec;
use muster_failpoint::{Failpoint, Step, reach};
use serde::{Deserialize, Serialize};

use crate::durable::{self, FileError, Keep};
use crate::given::Given;
use crate::given::vault::Vault;

/// The file with what a task is given.
const SEALED: &str = "config.sealed";

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
    /// Values of ConfigMaps and Secrets for the next attempt: sealed, in a file of their own.
    #[serde(skip)]
    pub(crate) given: Given,
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
    vault: Arc<Vault>,
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
        Ok(Checkpoint { tasks, vault: Arc::new(Vault::open(data_dir)?) })
    }

    pub(crate) fn tasks(&self) -> &Path {
        &self.tasks
    }

    pub(crate) fn task_dir(&self, uid: &TaskUid) -> PathBuf {
        self.tasks.join(uid.as_str())
    }

    fn make_dir(&self, uid: &TaskUid) -> Result<PathBuf, FileError> {
        let dir = self.task_dir(uid);
        if !dir.exists() {
            reach(Failpoint::TaskDir, Step::Before);
            fs::DirBuilder::new().mode(0o711).create(&dir).map_err(FileError::at("make", &dir))?;
            durable::sync_dir(&self.tasks)?;
            reach(Failpoint::TaskDir, Step::After);
        }
        Ok(dir)
    }

    /// Keeps what the task is given, before its record may name an attempt that needs it.
    pub(crate) fn write_given(&self, uid: &TaskUid, given: &Given) -> Result<(), FileError> {
        let path = self.make_dir(uid)?.join(SEALED);
        let Some(given) = given else {
            return durable::remove_file(&path);
        };
        let sealed = self.vault.seal(uid, given).map_err(FileError::at("seal", &path))?;
        durable::write(Failpoint::TaskGiven, &path, &sealed, 0o600, Keep::PowerCut)
    }

    /// None: there is nothing, or nothing that this agent can open. The controller sends it again.
    fn read_given(&self, uid: &TaskUid) -> Given {
        let path = self.task_dir(uid).join(SEALED);
        let given = self.vault.unseal(uid, fs::read(&path).ok()?);
        if given.is_none() {
            tracing::error!(%uid, path = %path.display(), "what the task was given cannot be opened");
        }
        given.map(Arc::new)
    }

    pub(crate) fn write(&self, record: &Record) -> Result<(), FileError> {
        let dir = self.make_dir(&record.workload.uid)?;
        durable::write_json(Failpoint::TaskRecord, &dir.join("task.json"), record, Keep::PowerCut)
    }

    /// Drops a task whole. Its record goes first: a directory without one is swept at the next start.
    pub(crate) fn drop_task(&self, uid: &TaskUid) -> Result<(), FileError> {
        let dir = self.task_dir(uid);
        reach(Failpoint::TaskRemoval, Step::Before);
        durable::remove_file(&dir.join("task.json"))?;
        reach(Failpoint::TaskRemoval, Step::Half);
        durable::remove_dir_all(&dir)?;
        reach(Failpoint::TaskRemoval, Step::After);
        Ok(())
    }

    /// Every task of an earlier life. A directory without a record is removed; a record that cannot
    /// be read is an error that names it: going on without would start its task a second time.
    pub(crate) fn read_all(&self) -> Result<Vec<Record>, FileError> {
        let mut records = Vec::new();
        let entries = fs::read_dir(&self.tasks).map_err(FileError::at("list", &self.tasks))?;
        for entry in entries {
            let dir = entry.map_err(FileError::at("list", &self.tasks))?.path();
            match durable::read_json::<Record>(&dir.join("task.json"))? {
                Some(mut record) => {
                    record.assignment.given = self.read_given(&record.workload.uid);
                    records.push(record);
                }
                None => {
                    tracing::info!(dir = %dir.display(), "a directory of no task is removed");
                    let _ = fs::remove_dir_all(&dir);
                }
            }
        }
        Ok(records)
    }
}
