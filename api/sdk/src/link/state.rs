//! The file that keeps a framework's id, so that its next run comes back to its tasks.

use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use tokio::io::AsyncWriteExt as _;

use crate::ConnectError;

/// The file; none: the id is forgotten with the program.
#[derive(Debug)]
pub(crate) struct StateFile(Option<PathBuf>);

impl StateFile {
    pub(crate) fn new(path: Option<PathBuf>) -> Self {
        StateFile(path)
    }

    /// The id of an earlier run.
    pub(crate) async fn read(&self) -> Result<Option<String>, ConnectError> {
        let Some(path) = &self.0 else { return Ok(None) };
        match tokio::fs::read_to_string(path).await {
            Ok(text) => Ok(Some(text.trim().to_owned()).filter(|id| !id.is_empty())),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(source) => Err(ConnectError::StateFile { path: path.clone(), source }),
        }
    }

    /// Keeps the id. Whole or not at all: half an id would be an unknown framework's.
    pub(crate) async fn write(&self, id: &str) {
        let Some(path) = &self.0 else { return };
        let mut beside = path.clone().into_os_string();
        beside.push(".new");
        let written = async {
            let mut file = tokio::fs::File::create(&beside).await?;
            file.write_all(format!("{id}\n").as_bytes()).await?;
            // Before it has the name: after a power cut there would be a name and nothing in it.
            file.sync_all().await?;
            tokio::fs::rename(&beside, path).await?;
            let dir = path.parent().filter(|dir| !dir.as_os_str().is_empty());
            tokio::fs::File::open(dir.unwrap_or_else(|| Path::new("."))).await?.sync_all().await
        };
        self.warn(written.await);
    }

    /// The framework was torn down: nobody comes back.
    pub(crate) async fn remove(&self) {
        let Some(path) = &self.0 else { return };
        match tokio::fs::remove_file(path).await {
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            removed => self.warn(removed),
        }
    }

    /// The framework works without the file; only its next run does not know it.
    fn warn(&self, done: io::Result<()>) {
        if let (Err(error), Some(path)) = (done, &self.0) {
            tracing::warn!(%error, path = %path.display(), "the framework's id is not kept");
        }
    }
}
