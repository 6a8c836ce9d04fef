//! Calls without an answer yet. Pure, but for the channels the answers go to.

use std::collections::BTreeMap;

use muster_api::wire::framework::v1 as proto;
use proto::call::Call as Say;
use tokio::sync::oneshot;

use crate::CallRefused;

/// Where a call's answer goes.
pub(crate) type Answered = oneshot::Sender<Result<Vec<proto::Launched>, CallRefused>>;

#[derive(Debug)]
struct Waiting {
    /// The call, when it may be said twice.
    again: Option<Say>,
    answer: Answered,
}

/// Calls by their ids, which grow.
#[derive(Debug, Default)]
pub(crate) struct Pending {
    last: u64,
    waiting: BTreeMap<u64, Waiting>,
}

/// An answered call.
pub(crate) struct Done {
    /// The call, when it may be said twice.
    pub(crate) call: Option<Say>,
    pub(crate) refused: bool,
}

impl Pending {
    /// Gives a call its id.
    pub(crate) fn add(&mut self, say: Say, answer: Answered) -> proto::Call {
        self.last += 1;
        let again = may_be_repeated(&say).then(|| say.clone());
        self.waiting.insert(self.last, Waiting { again, answer });
        proto::Call { id: self.last.to_string(), call: Some(say) }
    }

    /// Passes an answer on to who waits for it. None: nobody does.
    pub(crate) fn answer(&mut self, answer: proto::Answer) -> Option<Done> {
        let waiting = self.waiting.remove(&answer.id.parse().ok()?)?;
        let result = match answer.refusal {
            None => Ok(answer.launched),
            Some(refusal) => Err(CallRefused::from(refusal)),
        };
        let done = Done { call: waiting.again, refused: result.is_err() };
        // Who no longer waits does not need it.
        drop(waiting.answer.send(result));
        Some(done)
    }

    /// The session broke: fails what must not be said twice.
    pub(crate) fn disconnected(&mut self) {
        let lost = self.waiting.extract_if(.., |_, waiting| waiting.again.is_none());
        for (_, waiting) in lost {
            drop(waiting.answer.send(Err(CallRefused::disconnected())));
        }
    }

    /// What is said again in the next session, in the order of the first time.
    pub(crate) fn again(&self) -> Vec<proto::Call> {
        let call = |(id, waiting): (&u64, &Waiting)| proto::Call {
            id: id.to_string(),
            call: waiting.again.clone(),
        };
        self.waiting.iter().map(call).collect()
    }

    /// Whether the end of the framework was asked for; if so, whoever asked is told that it is done.
    pub(crate) fn torn_down(&mut self) -> bool {
        let is_teardown = |waiting: &Waiting| matches!(waiting.again, Some(Say::Teardown(_)));
        let mut any = false;
        for (_, waiting) in self.waiting.extract_if(.., |_, waiting| is_teardown(waiting)) {
            drop(waiting.answer.send(Ok(Vec::new())));
            any = true;
        }
        any
    }
}

/// Saying a wish or an end twice changes nothing. A launch would be there twice, messages come at most once, and offers end
/// with their session: there is nothing left to decline.
fn may_be_repeated(say: &Say) -> bool {
    !matches!(say, Say::Accept(_) | Say::Decline(_) | Say::Message(_))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reason;

    #[test]
    fn wishes_outlive_a_session_and_launches_do_not() {
        let mut pending = Pending::default();
        let (answer, mut launch) = oneshot::channel();
        assert_eq!(pending.add(Say::Accept(proto::Accept::default()), answer).id, "1");
        let (answer, mut wish) = oneshot::channel();
        pending.add(Say::Revive(proto::Revive {}), answer);
        let (answer, mut decline) = oneshot::channel();
        pending.add(Say::Decline(proto::Decline::default()), answer);
        pending.disconnected();
        let refused = decline.try_recv().expect("answered").expect_err("its offers are gone");
        assert_eq!(refused.reason, Reason::Disconnected);
        let refused = launch.try_recv().expect("answered").expect_err("refused");
        assert_eq!(refused.reason, Reason::Disconnected);
        let again = pending.again();
        assert_eq!(again.len(), 1);
        let answer = proto::Answer { id: again[0].id.clone(), ..proto::Answer::default() };
        assert!(pending.answer(answer).is_some_and(|done| !done.refused && done.call.is_some()));
        assert_eq!(wish.try_recv().expect("answered"), Ok(Vec::new()));
        assert!(!pending.torn_down());
    }
}
