//! What the arrivals on a ROS topic mean for a probe that asks for so many in so much time.

use super::{Answer, Role};

/// What is asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Wanted {
    /// The topic's global name.
    pub topic: String,
    /// Messages a second at least.
    pub min_hz: f64,
    /// Over how long they are counted, milliseconds.
    pub within_ms: u64,
}

/// What was seen of the topic.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Seen {
    /// Messages in the window, or since counting began when that is shorter.
    pub count: u64,
    /// It has been watched for a whole window.
    pub whole: bool,
    /// Publishers that are connected.
    pub connected: usize,
    /// Why a publisher that the master names is not connected.
    pub trouble: Option<String>,
    /// Why the master does not answer.
    pub no_master: Option<String>,
}

impl Wanted {
    /// The least number of messages in a window; always one.
    #[must_use]
    pub fn least(&self) -> u64 {
        let messages = self.min_hz * self.seconds();
        // A span and a rate that admission lets through are far below 2^53 messages.
        (messages.ceil() as u64).max(1)
    }

    fn seconds(&self) -> f64 {
        self.within_ms as f64 / 1_000.0
    }
}

/// The answer of a check; none: it is too early to tell.
///
/// Without a master nobody knows who publishes. A task that cannot be seen does not serve, but it is no reason to end it.
#[must_use]
pub fn judge(wanted: &Wanted, seen: &Seen, role: Role) -> Option<Answer> {
    let Wanted { topic, min_hz, .. } = wanted;
    if seen.count >= wanted.least() {
        return Some(Answer::Success);
    }
    if let Some(why) = seen.no_master.as_ref().filter(|_| seen.connected == 0) {
        let why = format!("the ROS master does not answer: {why}");
        return Some(match role {
            Role::Readiness => Answer::Failure(format!("{topic}: {why}")),
            Role::Startup | Role::Liveness => Answer::Unknown(format!("{topic}: {why}")),
        });
    }
    if !seen.whole {
        return None;
    }
    let (hz, seconds) = (seen.count as f64 / wanted.seconds(), wanted.seconds());
    Some(Answer::Failure(match (seen.connected, &seen.trouble) {
        (0, Some(why)) => format!("{topic}: its publisher cannot be reached: {why}"),
        (0, None) => format!("nobody publishes {topic}"),
        _ => {
            format!("{topic} comes at {hz:.1} Hz over {seconds} s, at least {min_hz} are asked for")
        }
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted() -> Wanted {
        Wanted { topic: "/scan".to_owned(), min_hz: 5.0, within_ms: 2_000 }
    }

    fn seen(count: u64, whole: bool) -> Seen {
        Seen { count, whole, connected: 1, ..Seen::default() }
    }

    fn failure(text: &str) -> Option<Answer> {
        Some(Answer::Failure(text.to_owned()))
    }

    #[test]
    fn enough_is_enough_at_once_and_too_few_only_after_a_whole_window() {
        let judge = |seen| judge(&wanted(), &seen, Role::Liveness);
        assert_eq!(judge(seen(10, false)), Some(Answer::Success));
        assert_eq!(judge(seen(9, false)), None);
        let slow = "/scan comes at 4.5 Hz over 2 s, at least 5 are asked for";
        assert_eq!(judge(seen(9, true)), failure(slow));
    }

    #[test]
    fn a_rare_topic_needs_one_message() {
        let rare = Wanted { min_hz: 0.1, within_ms: 10_000, ..wanted() };
        assert_eq!(rare.least(), 1);
        assert_eq!(judge(&rare, &seen(1, true), Role::Readiness), Some(Answer::Success));
        assert_eq!(Wanted { min_hz: 0.3, ..rare }.least(), 3);
    }

    #[test]
    fn who_is_not_there_is_told() {
        let none = Seen { connected: 0, ..seen(0, true) };
        assert_eq!(judge(&wanted(), &none, Role::Readiness), failure("nobody publishes /scan"));
        let away = Seen { trouble: Some("refused".to_owned()), ..none.clone() };
        let why = "/scan: its publisher cannot be reached: refused";
        assert_eq!(judge(&wanted(), &away, Role::Readiness), failure(why));
        let no_master = Seen { no_master: Some("refused".to_owned()), whole: false, ..none };
        let why = "/scan: the ROS master does not answer: refused";
        assert_eq!(judge(&wanted(), &no_master, Role::Readiness), failure(why));
        let unknown = Some(Answer::Unknown(why.to_owned()));
        assert_eq!(judge(&wanted(), &no_master, Role::Liveness), unknown, "it ends nothing");
        let goes_on = Seen { connected: 1, count: 10, ..no_master };
        assert_eq!(judge(&wanted(), &goes_on, Role::Liveness), Some(Answer::Success));
    }
}
