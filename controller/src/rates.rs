//! Who asks too often waits: each user has a rate of requests of their own, so that a program in a loop takes the controller
//! from nobody else.
//!
//! Administrators and agents have none: the former mend what is broken, and the latter are heard whatever happens. Nor are
//! writes of nodes and leases counted, an emergency stop among them. Who said nothing about who they are is held back by
//! their connections (`serve`).

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use http::Method;
use muster_controller_core::rate::{Bucket, Rate};

use crate::auth::Identity;
use crate::context::Context;
use crate::rest::failure::Failure;

/// Users whose buckets are kept before those are let go that are full.
const KEPT: usize = 1024;

/// The buckets of all users.
#[derive(Debug)]
pub(crate) struct Rates {
    /// None: nobody waits.
    rate: Option<Rate>,
    begun: Instant,
    users: Mutex<HashMap<String, Bucket>>,
}

impl Rates {
    /// So many requests a second for each user, and twice as many at once; 0: any number.
    pub(crate) fn new(per_second: u32) -> Self {
        let per = f64::from(per_second);
        let rate = (per_second > 0).then_some(Rate { per_second: per, burst: 2.0 * per });
        Self { rate, begun: Instant::now(), users: Mutex::default() }
    }

    /// Lets one request of a user pass.
    fn take(&self, user: &str) -> Result<(), Duration> {
        let Some(rate) = self.rate else { return Ok(()) };
        let now = self.begun.elapsed();
        let mut users = self.users.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(bucket) = users.get_mut(user) {
            return bucket.take(rate, now);
        }
        if users.len() >= KEPT {
            users.retain(|_, bucket| !bucket.is_full(rate, now));
        }
        users.entry(user.to_owned()).or_insert_with(|| Bucket::full(rate, now)).take(rate, now)
    }
}

/// Answers 429 to a user who asks too often.
pub(crate) async fn hold_back(
    State(context): State<Arc<Context>>,
    request: Request,
    next: Next,
) -> Response {
    if let Some(Identity::User { name, .. }) = request.extensions().get::<Identity>()
        && !is_of_robots(request.method(), request.uri().path())
        && let Err(after) = context.rates.take(name)
    {
        metrics::counter!("muster_requests_held_back_total").increment(1);
        return Failure::too_often(name, after).into_response();
    }
    next.run(request).await
}

/// A change of a node or a lease: nobody waits to stop a robot.
fn is_of_robots(method: &Method, path: &str) -> bool {
    !method.is_safe() && ["/nodes/", "/leases/"].iter().any(|part| path.contains(part))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_waits_to_stop_a_robot() {
        let path = "/apis/muster.dev/v1alpha1/nodes/r1";
        assert!(is_of_robots(&Method::PATCH, path) && !is_of_robots(&Method::GET, path));
        assert!(is_of_robots(&Method::POST, "/apis/muster.dev/v1alpha1/leases/r1.body/take"));
        assert!(!is_of_robots(&Method::POST, "/apis/muster.dev/v1alpha1/namespaces/lab/tasks"));
    }

    #[test]
    fn users_do_not_wait_for_each_other() {
        let rates = Rates::new(1);
        assert!(rates.take("ada").is_ok() && rates.take("ada").is_ok());
        assert!(rates.take("ada").is_err());
        assert!(rates.take("bob").is_ok());
        let none = Rates::new(0);
        assert!((0..10_000).all(|_| none.take("ada").is_ok()));
    }

    #[test]
    fn names_that_come_and_go_are_forgotten() {
        // Full again within a microsecond.
        let rates = Rates::new(u32::MAX);
        for user in 0..10 * KEPT {
            assert!(rates.take(&user.to_string()).is_ok());
        }
        assert!(rates.users.lock().unwrap_or_else(PoisonError::into_inner).len() <= KEPT);
    }
}
