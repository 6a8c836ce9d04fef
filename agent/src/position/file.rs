//! A file that some program of the robot's keeps up to date: one line, `X Y`, `X Y YAW` or `X Y Z YAW`, metres and
//! radians in the map frame, with a newline at its end.
//!
//! ```sh
//! printf '%s %s %s\n' $x $y $yaw > /run/robot/pose.new && mv /run/robot/pose.new /run/robot/pose
//! ```
//!
//! The pose is as old as the file. A line without its newline is still being written, and the pose before it counts; a
//! file that is gone, or says something else, means that the robot does not know where it is.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use jiff::Timestamp;
use muster_api::pose::{Pose, PoseRef};
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;
use tokio_util::task::AbortOnDropHandle;

use super::{Position, Seen};

/// As often as the controller is told. A look costs some ten microseconds; a watch of the kernel's would have to follow
/// the file through renames and directories that come and go.
const EVERY: Duration = Duration::from_millis(100);

/// What a look finds.
#[derive(Debug, PartialEq)]
enum Found {
    At([f64; 4], Option<Timestamp>),
    /// It is being written.
    Half,
    /// Why the robot's place is not known.
    Nothing(String),
}

pub(super) fn open(path: &Path, map: &str) -> Position {
    let (say, newest) = watch::channel(Seen::default());
    let source = tokio::spawn(follow(path.to_owned(), map.to_owned(), say));
    Position { newest, _source: Some(AbortOnDropHandle::new(source)) }
}

async fn follow(path: PathBuf, map: String, say: watch::Sender<Seen>) {
    let mut ticks = tokio::time::interval(EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut told = String::new();
    loop {
        ticks.tick().await;
        let file = path.clone();
        // On another thread: a file system that hangs must not stop the agent.
        let Ok(found) = tokio::task::spawn_blocking(move || look(&file)).await else { return };
        if let Found::Nothing(why) = &found
            && *why != told
        {
            tracing::warn!(path = %path.display(), why, "the robot's place is not known");
        }
        told = if let Found::Nothing(why) = &found { why.clone() } else { String::new() };
        say.send_if_modified(|seen| {
            let new = Seen::of(follows(seen.pose.as_ref(), &found, &map));
            let changes = new != *seen;
            *seen = new;
            changes
        });
    }
}

/// The pose after a look.
fn follows(before: Option<&Pose>, found: &Found, map: &str) -> Option<Pose> {
    match found {
        Found::At([x, y, z, yaw], stamp) => {
            let (x, y, z, yaw) = (*x, *y, *z, *yaw);
            let pose = PoseRef {
                map,
                x,
                y,
                z,
                yaw,
                stamp: *stamp,
                source: "file",
                localized: true,
                covariance: None,
            };
            Some(pose.into())
        }
        Found::Half => before.cloned(),
        // Where it was seen last, and not there any more.
        Found::Nothing(_) => before.map(|pose| Pose { localized: false, ..pose.clone() }),
    }
}

fn look(path: &Path) -> Found {
    let read = || -> io::Result<(String, Option<Timestamp>)> {
        let text = std::fs::read_to_string(path)?;
        let modified = std::fs::metadata(path)?.modified()?;
        Ok((text, Timestamp::try_from(modified).ok()))
    };
    match read() {
        Ok((text, stamp)) => parse(&text, stamp),
        Err(error) => Found::Nothing(error.to_string()),
    }
}

fn parse(text: &str, stamp: Option<Timestamp>) -> Found {
    if !text.ends_with('\n') {
        return Found::Half;
    }
    let numbers: Option<Vec<f64>> = text
        .split_whitespace()
        .map(|word| word.parse().ok().filter(|n: &f64| n.is_finite()))
        .collect();
    match numbers.as_deref() {
        Some([x, y]) => Found::At([*x, *y, 0.0, 0.0], stamp),
        Some([x, y, yaw]) => Found::At([*x, *y, 0.0, *yaw], stamp),
        Some([x, y, z, yaw]) => Found::At([*x, *y, *z, *yaw], stamp),
        _ => Found::Nothing(format!("{:?} is not X Y, X Y YAW or X Y Z YAW", text.trim_end())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_two_to_four_numbers() {
        let at = |text: &str| match parse(text, None) {
            Found::At(numbers, _) => Some(numbers),
            _ => None,
        };
        assert_eq!(at("1 -2.5\n"), Some([1.0, -2.5, 0.0, 0.0]));
        assert_eq!(at("1 2 3\n"), Some([1.0, 2.0, 0.0, 3.0]));
        assert_eq!(at("1 2 3 4\n"), Some([1.0, 2.0, 3.0, 4.0]));
        for bad in ["\n", "1\n", "1 2 3 4 5\n", "1 inf\n", "a b\n"] {
            assert!(matches!(parse(bad, None), Found::Nothing(_)), "{bad:?}");
        }
        for half in ["", "1", "1 2"] {
            assert_eq!(parse(half, None), Found::Half, "{half:?}");
        }
    }

    #[test]
    fn a_robot_that_is_lost_was_somewhere() {
        let nothing = Found::Nothing("gone".to_owned());
        assert_eq!(follows(None, &nothing, "lab"), None);
        let there = follows(None, &Found::At([1.0, 2.0, 0.0, 0.0], None), "lab");
        assert_eq!(follows(there.as_ref(), &Found::Half, "lab"), there);
        let lost = follows(there.as_ref(), &nothing, "lab").expect("it was somewhere");
        assert_eq!((lost.x, lost.map.as_str(), lost.localized), (1.0, "lab", false));
    }

    #[tokio::test]
    async fn what_the_file_says_is_followed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("pose");
        let mut position = open(&path, "lab");
        assert_eq!(position.current(), None);
        std::fs::write(&path, "1 2 0.5\n").unwrap();
        position.other_than(None).await;
        let first = position.current().unwrap();
        assert_eq!((first.x, first.y, first.yaw), (1.0, 2.0, 0.5));
        assert!(first.localized && first.stamp.is_some());
        std::fs::remove_file(&path).unwrap();
        position.other_than(Some(&first)).await;
        assert!(!position.current().unwrap().localized);
    }
}
