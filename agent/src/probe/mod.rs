//! Makes the checks of a running attempt, when the core says that one is due.
//!
//! ```text
//! Prober (core: what is due) ──▶ Check ──▶ exec in the task │ http, tcp in its network │ topic ──▶ Answer ──▶ Prober ──▶ Verdict
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`check`] | a probe of a spec as the check that it is, and its answer within its timeout |
//! | [`connect`] | a connection in a task's own network |
//! | [`http`] | a GET over one |
//! | [`tls`] | the same, encrypted |
//! | [`topic`] | ROS topics, counted |
//!
//! A [`Probing`] belongs to the driver of its task and to one attempt. Before the driver ends an attempt, or says that it
//! has ended, it waits for [`Probing::end`]: no check of it is left then.

mod check;
mod connect;
mod http;
mod tls;
pub(crate) mod topic;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use muster_agent_core::probe::{Answer, Prober, Probes, Role, Timing, Verdict};
use muster_agent_core::time::Boot;
use muster_agent_core::workload::{State, Workload};
use muster_api::kind::task::TaskSpec;
use muster_api::kind::task::probe::Probe;
use tokio::task::{JoinError, JoinSet};
use tokio_util::sync::CancellationToken;

use crate::clock;
use crate::driver::sleep_until;
use crate::runtime::{Launch, Runtime};
use check::Check;
use topic::Topics;

/// The checks of one attempt.
pub(crate) struct Probing {
    /// Which.
    pub(crate) attempt: u32,
    prober: Prober,
    checks: BTreeMap<Role, Arc<Check>>,
    runtime: Arc<dyn Runtime>,
    launch: Arc<Launch>,
    /// At most one of a role. Tasks of their own: they go on, and are in time, while the driver waits for its disk.
    under_way: JoinSet<(Role, Answer)>,
    over: CancellationToken,
    /// Those of which it was said that they cannot be made.
    warned: BTreeSet<Role>,
}

impl Probing {
    /// Begins, or goes on with, the checks of the attempt that runs; `None`: it has none, or does not run.
    pub(crate) fn begin(
        workload: &Workload,
        spec: &TaskSpec,
        (runtime, topics): (&Arc<dyn Runtime>, &Arc<Topics>),
        launch: impl FnOnce() -> Launch,
    ) -> Option<Probing> {
        let State::Running { started } = workload.state else { return None };
        let probes = &workload.desired.probes;
        if probes.is_empty() {
            return None;
        }
        let now = clock::now();
        // The date may have been set since: then the delay counts from now at the latest.
        let ran_ms = u64::try_from(now.wall.0 - started.at.0).unwrap_or(0);
        let begun = Boot(now.boot.0.saturating_sub(ran_ms));
        let launch = launch();
        let check = |(role, probe): (Role, &Option<Probe>)| {
            Some((role, Arc::new(Check::of(probe.as_ref()?, &launch, topics))))
        };
        let checks = roles(spec).into_iter().filter_map(check).collect();
        Some(Probing {
            attempt: workload.attempt,
            prober: Prober::new(probes, &workload.verdicts, begun),
            checks,
            runtime: Arc::clone(runtime),
            launch: Arc::new(launch),
            under_way: JoinSet::new(),
            over: CancellationToken::new(),
            warned: BTreeSet::new(),
        })
    }

    /// The next verdict. Cancel-safe: checks under way are kept, and polled again by the next call.
    pub(crate) async fn verdict(&mut self) -> Verdict {
        loop {
            for role in self.prober.due(clock::boot()) {
                self.make(role);
            }
            // Cancel-safe: `join_next` is, and a sleep whose deadline is kept.
            tokio::select! {
                Some(answered) = self.under_way.join_next() => {
                    if let Some(verdict) = self.answered(answered) {
                        return verdict;
                    }
                }
                () = sleep_until(self.prober.next()) => {}
            }
        }
    }

    fn answered(&mut self, answered: Result<(Role, Answer), JoinError>) -> Option<Verdict> {
        match answered {
            Ok((role, answer)) => {
                self.log(role, &answer);
                self.prober.answer(role, answer)
            }
            // It panicked: this probe is not made again before another attempt, or life of the agent.
            Err(error) => {
                tracing::error!(id = %self.launch.id, %error, "a check ended unexpectedly");
                None
            }
        }
    }

    /// A probe that cannot be made changes nothing: somebody has to hear of it.
    fn log(&mut self, role: Role, answer: &Answer) {
        let id = &self.launch.id;
        match answer {
            Answer::Unknown(why) if self.warned.insert(role) => {
                tracing::warn!(%id, %role, why, "a check cannot be made, and says nothing");
            }
            answer => tracing::debug!(%id, %role, ?answer, "probe"),
        }
    }

    fn make(&mut self, role: Role) {
        // The spec and what the core knows of it come together, so there is one.
        let Some(check) = self.checks.get(&role).map(Arc::clone) else { return };
        let (runtime, launch) = (Arc::clone(&self.runtime), Arc::clone(&self.launch));
        let over = self.over.clone();
        self.under_way.spawn(async move {
            (role, check.answer(role, runtime.as_ref(), &launch, over.cancelled()).await)
        });
    }

    /// Ends the checks that are under way; their answers are dropped.
    pub(crate) async fn end(mut self) {
        self.over.cancel();
        while self.under_way.join_next().await.is_some() {}
    }
}

fn roles(spec: &TaskSpec) -> [(Role, &Option<Probe>); 3] {
    [
        (Role::Startup, &spec.startup),
        (Role::Readiness, &spec.readiness),
        (Role::Liveness, &spec.liveness),
    ]
}

/// What the core needs to know of a task's probes.
pub(crate) fn probes(spec: &TaskSpec) -> Probes {
    let millis = |span: muster_api::duration::Span| {
        u64::try_from(span.as_duration().as_millis()).unwrap_or(u64::MAX)
    };
    let timing = |probe: &Option<Probe>| {
        probe.as_ref().map(|probe| Timing {
            initial_delay_ms: millis(probe.initial_delay),
            period_ms: millis(probe.period),
            success_threshold: probe.success_threshold,
            failure_threshold: probe.failure_threshold,
        })
    };
    Probes {
        startup: timing(&spec.startup),
        readiness: timing(&spec.readiness),
        liveness: timing(&spec.liveness),
    }
}
