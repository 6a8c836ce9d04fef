//! The audit log: who changed what, when, and what came of it.
//!
//! ```text
//!   REST write ──▶ ready? ──no──▶ 503                       DIR/audit/audit.jsonl      the newest lines
//!                    │yes                                   DIR/audit/audit.jsonl.1 …  the ones before, FILES in all
//!                    ▼
//!            carried out ──▶ a line ──▶ the answer
//! ```
//!
//! A line is written after a write was carried out and before it is answered: what was acknowledged has its line, also when
//! the controller is killed the next moment. (A power loss may take the lines of the last moments, which the operating system
//! had not written yet; the objects are synced, the lines are not.) A line that cannot be written makes the answer a 503 that says so,
//! and until lines can be written again nothing is written: every write is refused before it is carried out. The first line
//! after that says how many are missing.
//!
//! What a framework's session launches and ends has its lines as well, under the name of who opened the session; what agents tell
//! of their nodes and tasks has none, and neither has what the controller does by itself.
//!
//! A line has no bodies of objects, no query and no secrets. Reads have no lines, and neither have requests of those who did
//! not say who they are, unless they were let in.

pub(crate) mod entry;

use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use jiff::Timestamp;
use muster_controller_core::access::Verb;
use serde::Serialize;

use crate::auth::Identity;

/// Bytes of a file, about: with eight files half a gigabyte, some two million writes.
const BYTES: u64 = 64 << 20;
/// Files that are kept, the present one included.
const FILES: u32 = 8;
const NAME: &str = "audit.jsonl";

/// Something that was done, or refused.
#[derive(Debug, Clone, Default, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Line {
    /// When it was answered.
    pub(crate) time: Timestamp,
    /// The answer's `Audit-Id`.
    pub(crate) request_id: String,
    pub(crate) user: String,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) groups: Vec<String>,
    /// The id of the token that was shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) token: Option<String>,
    /// The other end of the connection.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) from: Option<String>,
    pub(crate) verb: &'static str,
    pub(crate) group: &'static str,
    pub(crate) resource: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) subresource: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) namespace: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) uid: Option<String>,
    /// The objects of a write of several; whom a token is for, who joined, from whom a lease was taken.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) objects: Vec<Named>,
    /// HTTP status; none: the client left before the answer, and it may have been carried out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) code: Option<u16>,
    /// Why it was refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) reason: Option<String>,
}

impl Line {
    /// Of something that this identity does.
    pub(crate) fn of(identity: &Identity, verb: Verb, resource: &'static str) -> Self {
        Self {
            request_id: uuid::Uuid::new_v4().to_string(),
            user: identity.name(),
            groups: identity.groups(),
            token: match identity {
                Identity::User { token, .. } => token.clone(),
                Identity::Admin { .. } | Identity::Node { .. } | Identity::Anonymous => None,
            },
            verb: verb.as_str(),
            group: muster_api::GROUP,
            resource,
            ..Self::default()
        }
    }
}

/// One of several objects. In the extensions of an answer: one that the answer itself does not name.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Named {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) kind: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) namespace: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) uid: Option<String>,
}

/// Lines that are missing before this one.
#[derive(Serialize)]
struct Gap {
    time: Timestamp,
    missing: u64,
}

/// The log of one controller.
#[derive(Debug)]
pub struct Audit {
    dir: PathBuf,
    bytes: u64,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// None: it was not opened yet, or a line could not be written.
    open: Option<Open>,
    /// Lines that could not be written.
    missing: u64,
}

#[derive(Debug)]
struct Open {
    file: File,
    size: u64,
}

impl Audit {
    /// A log in `dir`, which is made with its first line.
    #[must_use]
    pub fn in_dir(dir: PathBuf) -> Self {
        Self { dir, bytes: BYTES, state: Mutex::default() }
    }

    /// Whether lines can be written.
    ///
    /// # Errors
    /// Why not.
    pub(crate) fn ready(&self, now: Timestamp) -> io::Result<()> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if state.open.is_some() {
            return Ok(());
        }
        let mut open = Open::at(&self.dir)?;
        if state.missing > 0 {
            open.append(&bytes_of(&Gap { time: now, missing: state.missing })?)?;
        }
        *state = State { open: Some(open), missing: 0 };
        Ok(())
    }

    /// Writes a line.
    ///
    /// # Errors
    /// When it is not written. Nothing of it is in the file then.
    pub(crate) fn write(&self, line: &Line) -> io::Result<()> {
        let written = bytes_of(line).and_then(|bytes| self.append(line.time, &bytes));
        if let Err(error) = &written {
            metrics::counter!("muster_audit_failures_total").increment(1);
            tracing::error!(error = error as &dyn std::error::Error, dir = %self.dir.display(), "the audit log cannot be written: nothing is written until it can");
        }
        written
    }

    fn append(&self, now: Timestamp, bytes: &[u8]) -> io::Result<()> {
        let opened = self.ready(now);
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let written = opened.and_then(|()| {
            let open = state.open.as_mut().ok_or(io::ErrorKind::BrokenPipe)?;
            if open.size > 0 && open.size + bytes.len() as u64 > self.bytes {
                *open = self.rotate(open)?;
            }
            open.append(bytes)
        });
        if written.is_err() {
            *state = State { open: None, missing: state.missing + 1 };
        }
        written
    }

    /// Gives every file the next number; the last one goes.
    fn rotate(&self, full: &Open) -> io::Result<Open> {
        full.file.sync_data()?;
        for number in (0..FILES - 1).rev() {
            match std::fs::rename(
                self.dir.join(numbered(number)),
                self.dir.join(numbered(number + 1)),
            ) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        Open::at(&self.dir)
    }
}

fn numbered(number: u32) -> String {
    match number {
        0 => NAME.to_owned(),
        _ => format!("{NAME}.{number}"),
    }
}

fn bytes_of<T: Serialize>(line: &T) -> io::Result<Vec<u8>> {
    let mut bytes = serde_json::to_vec(line)?;
    bytes.push(b'\n');
    Ok(bytes)
}

impl Open {
    fn at(dir: &Path) -> io::Result<Self> {
        DirBuilder::new().recursive(true).mode(0o700).create(dir)?;
        let mut options = OpenOptions::new();
        options.read(true).append(true).create(true).mode(0o600);
        let mut file = options.open(dir.join(NAME))?;
        let size = file.seek(SeekFrom::End(0))?;
        let mut open = Self { file, size };
        if !open.ends_whole()? {
            // The machine stopped in the middle of a line; the next one begins anew.
            open.append(b"\n")?;
        }
        Ok(open)
    }

    fn ends_whole(&mut self) -> io::Result<bool> {
        if self.size == 0 {
            return Ok(true);
        }
        let mut last = [0];
        self.file.seek(SeekFrom::End(-1))?;
        self.file.read_exact(&mut last)?;
        Ok(last == *b"\n")
    }

    /// All of it, or nothing.
    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        if let Err(error) = self.file.write_all(bytes) {
            // What is left of the line would be taken for one; should that fail too, opening it again ends the line.
            drop(self.file.set_len(self.size));
            return Err(error);
        }
        self.size += bytes.len() as u64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    fn line(name: &str) -> Line {
        Line { user: "ada".to_owned(), name: Some(name.to_owned()), ..Line::default() }
    }

    fn lines(path: &Path) -> Vec<Value> {
        let text = std::fs::read_to_string(path).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap_or(Value::Null)).collect()
    }

    #[test]
    fn the_oldest_of_eight_files_goes() {
        let dir = tempfile::tempdir().unwrap();
        let audit = Audit { bytes: 1, ..Audit::in_dir(dir.path().join("audit")) };
        for number in 0..FILES + 2 {
            audit.write(&line(&number.to_string())).unwrap();
        }
        let mut kept: Vec<String> = std::fs::read_dir(dir.path().join("audit"))
            .unwrap()
            .map(|file| file.unwrap().file_name().into_string().unwrap())
            .collect();
        kept.sort();
        assert_eq!((kept.len(), kept[0].as_str()), (8, NAME));
        let name = |file: &str| lines(&dir.path().join("audit").join(file))[0]["name"].clone();
        assert_eq!((name(NAME), name("audit.jsonl.7")), ("9".into(), "2".into()));
    }

    #[test]
    fn a_torn_line_does_not_swallow_the_next() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(NAME), "{\"user\":\"a").unwrap();
        let audit = Audit::in_dir(dir.path().to_owned());
        audit.write(&line("x")).unwrap();
        let lines = lines(&dir.path().join(NAME));
        assert_eq!((lines.len(), &lines[1]["name"]), (2, &"x".into()));
    }

    #[test]
    fn what_is_missing_is_said_when_lines_can_be_written_again() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("audit");
        // A file in the directory's place.
        std::fs::write(&place, "").unwrap();
        let audit = Audit::in_dir(place.clone());
        assert!(audit.ready(Timestamp::UNIX_EPOCH).is_err());
        assert!(audit.write(&line("lost")).is_err());
        std::fs::remove_file(&place).unwrap();
        audit.ready(Timestamp::UNIX_EPOCH).unwrap();
        audit.write(&line("kept")).unwrap();
        let lines = lines(&place.join(NAME));
        assert_eq!((&lines[0]["missing"], &lines[1]["name"]), (&1.into(), &"kept".into()));
    }
}
