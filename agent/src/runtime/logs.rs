//! Reading what shims wrote (`shim::output` has the format), across rotations, and following it.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use futures::stream::{self, BoxStream, StreamExt};

use super::LogQuery;

/// How soon a follower sees new output. Nobody pays for it but who follows.
const LOOK_AGAIN: Duration = Duration::from_millis(100);

/// What is read, and sent, at once.
const CHUNK: usize = 64 << 10;

/// Whether the writer is done; asked before the last look at the file, so that nothing is missed.
type Ended = Box<dyn Fn() -> bool + Send>;

/// The output in `log`, `log.1` …, oldest first. With `follow`, to the end of the attempt.
pub(crate) fn read(
    log: PathBuf,
    query: LogQuery,
    ended: Ended,
) -> BoxStream<'static, io::Result<Bytes>> {
    let reader = Reader {
        since: query.since.map(|since| format!("{since:.9}").into_bytes()),
        log,
        query,
        ended,
        at: None,
        rest: Vec::new(),
        begun: false,
        in_line: false,
    };
    stream::try_unfold(Some(reader), |reader| async move {
        let Some(mut reader) = reader else { return Ok(None) };
        loop {
            let (back, step) = tokio::task::spawn_blocking(move || {
                let step = reader.step();
                (reader, step)
            })
            .await
            .map_err(io::Error::other)?;
            reader = back;
            match step? {
                Step::Data(bytes) => return Ok(Some((bytes, Some(reader)))),
                Step::Again => {}
                Step::Wait => tokio::time::sleep(LOOK_AGAIN).await,
                Step::End => return Ok(None),
            }
        }
    })
    .boxed()
}

enum Step {
    Data(Bytes),
    Again,
    Wait,
    End,
}

struct Reader {
    log: PathBuf,
    query: LogQuery,
    since: Option<Vec<u8>>,
    ended: Ended,
    at: Option<File>,
    /// The beginning of a record whose end is not written yet.
    rest: Vec<u8>,
    begun: bool,
    /// The last record was a part: the next one continues its line.
    in_line: bool,
}

impl Reader {
    fn step(&mut self) -> io::Result<Step> {
        if !self.begun {
            self.begun = true;
            self.at = self.first()?;
        }
        let ended = (self.ended)();
        let mut chunk = vec![0; CHUNK];
        let size = match &mut self.at {
            Some(file) => file.read(&mut chunk)?,
            None => 0,
        };
        if size > 0 {
            self.rest.extend_from_slice(&chunk[..size]);
            let out = self.records();
            return Ok(if out.is_empty() { Step::Again } else { Step::Data(out.into()) });
        }
        if let Some(next) = self.newer()? {
            self.at = Some(next);
            self.rest.clear();
            return Ok(Step::Again);
        }
        Ok(if self.query.follow && !ended { Step::Wait } else { Step::End })
    }

    /// Where to begin: at the oldest file, or where the last `tail` lines do.
    fn first(&self) -> io::Result<Option<File>> {
        let files = files(&self.log);
        let Some(tail) = self.query.tail else {
            return files.last_key_value().map(|(_, path)| File::open(path)).transpose();
        };
        let mut wanted = tail;
        let mut oldest = None;
        for path in files.values() {
            let mut text = Vec::new();
            File::open(path)?.read_to_end(&mut text)?;
            let mut end = text.len();
            // From the end: each full record is one line.
            while end > 0 {
                let start =
                    text[..end - 1].iter().rposition(|b| *b == b'\n').map_or(0, |at| at + 1);
                if is_full(&text[start..end]) {
                    if wanted == 0 {
                        break;
                    }
                    wanted -= 1;
                }
                end = start;
            }
            let mut file = File::open(path)?;
            file.seek(SeekFrom::Start(end as u64))?;
            oldest = Some(file);
            if end > 0 {
                break;
            }
        }
        Ok(oldest)
    }

    /// The file after the present one; `None`: the present one is the newest.
    fn newer(&self) -> io::Result<Option<File>> {
        let files = files(&self.log);
        let Some(at) = &self.at else {
            return files.last_key_value().map(|(_, path)| File::open(path)).transpose();
        };
        let inode = at.metadata()?.ino();
        let place = files
            .iter()
            .find(|(_, path)| fs::metadata(path).is_ok_and(|metadata| metadata.ino() == inode))
            .map(|(n, _)| *n);
        match place {
            Some(0) => Ok(None),
            Some(n) => files.range(..n).next_back().map(|(_, path)| File::open(path)).transpose(),
            // Rotated away while it was read.
            None => files.last_key_value().map(|(_, path)| File::open(path)).transpose(),
        }
    }

    /// Takes the whole records out of `rest`, as the reader wants to see them.
    fn records(&mut self) -> Vec<u8> {
        let Some(end) = self.rest.iter().rposition(|byte| *byte == b'\n') else {
            return Vec::new();
        };
        let rest = self.rest.split_off(end + 1);
        let whole = std::mem::replace(&mut self.rest, rest);
        let mut out = Vec::with_capacity(whole.len());
        for record in whole[..end].split(|byte| *byte == b'\n') {
            let mut fields = record.splitn(4, |byte| *byte == b' ');
            let (Some(time), Some(_), Some(tag), Some(text)) =
                (fields.next(), fields.next(), fields.next(), fields.next())
            else {
                continue;
            };
            // Fixed width and UTC: the order of the texts is the order of the times.
            if self.since.as_deref().is_some_and(|since| time < since) {
                continue;
            }
            if self.query.timestamps && !self.in_line {
                out.extend_from_slice(time);
                out.push(b' ');
            }
            out.extend_from_slice(text);
            self.in_line = tag == b"P";
            if !self.in_line {
                out.push(b'\n');
            }
        }
        out
    }
}

fn is_full(record: &[u8]) -> bool {
    record.splitn(4, |byte| *byte == b' ').nth(2) == Some(b"F")
}

/// The files that exist, 0 the newest.
fn files(log: &Path) -> BTreeMap<u32, PathBuf> {
    let mut found = BTreeMap::new();
    if log.exists() {
        found.insert(0, log.to_owned());
    }
    for n in 1.. {
        let path = log.with_extension(n.to_string());
        if !path.exists() {
            break;
        }
        found.insert(n, path);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn text(log: &Path, query: LogQuery) -> String {
        let mut out = Vec::new();
        let mut stream = read(log.to_owned(), query, Box::new(|| true));
        while let Some(part) = stream.next().await {
            out.extend_from_slice(&part.unwrap());
        }
        String::from_utf8(out).unwrap()
    }

    #[tokio::test]
    async fn across_rotations_with_tail_since_and_times() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let line = |s: u32, tag: &str, text: &str| {
            format!("2026-01-31T12:00:{s:02}.000000000Z stdout {tag} {text}\n")
        };
        fs::write(dir.path().join("log.2"), line(1, "F", "a")).unwrap();
        fs::write(dir.path().join("log.1"), line(2, "F", "b") + &line(3, "P", "c")).unwrap();
        fs::write(&log, line(4, "F", "c") + &line(5, "F", "d d")).unwrap();
        assert_eq!(text(&log, LogQuery::default()).await, "a\nb\ncc\nd d\n");
        let tail = |n| LogQuery { tail: Some(n), ..LogQuery::default() };
        assert_eq!(text(&log, tail(1)).await, "d d\n");
        assert_eq!(text(&log, tail(2)).await, "cc\nd d\n");
        assert_eq!(text(&log, tail(9)).await, "a\nb\ncc\nd d\n");
        assert_eq!(text(&log, tail(0)).await, "");
        let since = "2026-01-31T12:00:05Z".parse().unwrap();
        let query = LogQuery { since: Some(since), timestamps: true, ..LogQuery::default() };
        assert_eq!(text(&log, query).await, "2026-01-31T12:00:05.000000000Z d d\n");
        assert_eq!(text(&dir.path().join("none"), LogQuery::default()).await, "");
    }
}
