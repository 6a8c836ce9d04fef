//! When this agent was last in contact with the controller: kept in memory for the core, and in a
//! file for the shims, who must act when the agent cannot.

use std::path::Path;
use std::sync::Mutex;
use std::sync::PoisonError;

use muster_agent_core::time::Boot;

use crate::durable::FileError;
use crate::runtime::contact::ContactFile;

/// The last contact of this boot.
#[derive(Debug)]
pub(crate) struct Contact {
    file: ContactFile,
    last: Mutex<Option<Boot>>,
}

impl Contact {
    pub(crate) fn open(path: &Path, boot_id: &str) -> Result<Contact, FileError> {
        let file = ContactFile::open(path, boot_id).map_err(FileError::at("open", path))?;
        let last = Mutex::new(file.read());
        Ok(Contact { file, last })
    }

    pub(crate) fn last(&self) -> Option<Boot> {
        *self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A message that was sent at `sent` has been answered.
    pub(crate) fn made(&self, sent: Boot) {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if last.is_none_or(|last| last < sent) {
            *last = Some(sent);
            if let Err(error) = self.file.write(sent) {
                // The shims will end their tasks: the safe side.
                tracing::error!(%error, "contact cannot be recorded for the shims");
            }
        }
    }
}
