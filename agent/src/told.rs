//! What a task's program tells of itself while it runs: frequencies of topics and values of signals, for the decision where
//! the parts of an Application run.
//!
//! The file is `$MUSTER_RUN_DIR/observed`, a line for each: `/scan 9.8`. It is the program's to replace (written beside it
//! and renamed, a look never sees half of it), and counts until it is removed or the task has ended. It goes with every
//! heartbeat, so it is short: of a link of 1 Mbit/s it is less than 2 %.

use std::path::Path;

use muster_api::wire::agent::v1 as proto;

use crate::mission::text_of;

const FILE: &str = "observed";
/// More is not read, bytes.
const LONGEST: u64 = 1024;
/// More names are not told.
const MOST: usize = 16;

/// What the task of this run directory tells now.
pub(crate) fn observed(run_dir: &Path) -> Vec<proto::Told> {
    text_of(&run_dir.join(FILE), LONGEST).map(|text| told(&text)).unwrap_or_default()
}

/// Lines that are no name and number say nothing; nor does one that was cut off.
fn told(text: &str) -> Vec<proto::Told> {
    let whole = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    let read = |line: &str| {
        let (name, value) = line.trim().rsplit_once(char::is_whitespace)?;
        let value: f64 = value.parse().ok()?;
        value.is_finite().then(|| proto::Told { name: name.trim().to_owned(), value })
    };
    whole.filter_map(read).take(MOST).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_a_name_and_a_number() {
        let all = told("/scan 9.8\nangular velocity\t-0.25\n\nnonsense\n/nan NaN\n/cut 1");
        let all: Vec<(&str, f64)> = all.iter().map(|t| (t.name.as_str(), t.value)).collect();
        assert_eq!(all, [("/scan", 9.8), ("angular velocity", -0.25)]);
        assert_eq!(told(&"/t 1\n".repeat(1000)).len(), MOST);
    }

    #[test]
    fn a_task_without_the_file_tells_nothing() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(observed(dir.path()), []);
        std::fs::write(dir.path().join(FILE), "/scan 5\n").unwrap();
        assert_eq!(observed(dir.path()).len(), 1);
    }
}
