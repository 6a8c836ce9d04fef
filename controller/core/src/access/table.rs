//! Roles × resources × verbs, and how far each right reaches.
//!
//! Kubernetes' roles `view`, `edit` and `admin` are the model for what tasks are: who may run a task in a namespace may read
//! that namespace's Secrets, since a task can, and who may only look may not.

use muster_api::kind::access::Role;

use super::{Action, Verb};

/// Where somebody must hold a role for it to count.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reach {
    /// In the namespace of what is asked for; for all namespaces at once, in the whole cluster.
    Namespace,
    /// In any namespace: what everybody shares, and questions whose objects are decided one by one.
    Anywhere,
    /// In the whole cluster.
    Cluster,
}

use Reach::{Anywhere, Cluster, Namespace};
use Verb::{Create, Delete, DeleteCollection, Get, List, Patch, Update, Watch};

type Verbs = &'static [Verb];

const NONE: Verbs = &[];
const GET: Verbs = &[Get];
const POST: Verbs = &[Create];
const READ: Verbs = &[Get, List, Watch];
const END: Verbs = &[Get, List, Watch, Delete, DeleteCollection];
const EDIT: Verbs = &[Get, Update, Patch];
const ALL: Verbs = &Verb::ALL;

/// What each role may do with a resource.
#[derive(Debug)]
pub(super) struct Row {
    /// `tasks`, or `pods/exec`; of every group that has it.
    pub(super) what: &'static str,
    /// Framework, viewer, developer, operator, admin.
    verbs: [Verbs; 5],
    /// Where a role must be held to read.
    reads: Reach,
    /// Where to write.
    writes: Reach,
}

const fn row(what: &'static str, verbs: [Verbs; 5], reads: Reach, writes: Reach) -> Row {
    Row { what, verbs, reads, writes }
}

#[rustfmt::skip]
pub(super) static TABLE: &[Row] = &[
    //   what                     framework viewer developer operator admin   reads      writes
    // What runs.
    row("tasks",                   [READ,   READ,  ALL,   ALL,   ALL],   Namespace, Namespace),
    row("tasks/status",            [GET,    GET,   GET,   GET,   EDIT],  Namespace, Cluster),
    row("tasks/log",               [GET,    GET,   GET,   GET,   GET],   Namespace, Namespace),
    row("tasks/why",               [GET,    GET,   GET,   GET,   GET],   Namespace, Namespace),
    row("pods",                    [READ,   READ,  ALL,   ALL,   ALL],   Namespace, Namespace),
    row("pods/status",             [GET,    GET,   GET,   GET,   EDIT],  Namespace, Cluster),
    row("pods/log",                [GET,    GET,   GET,   GET,   GET],   Namespace, Namespace),
    row("pods/exec",               [NONE,   NONE,  POST,  POST,  POST],  Namespace, Namespace),
    row("pods/attach",             [NONE,   NONE,  POST,  POST,  POST],  Namespace, Namespace),
    row("pods/eviction",           [NONE,   NONE,  POST,  POST,  POST],  Namespace, Namespace),
    row("tasksets",                [NONE,   READ,  ALL,   ALL,   ALL],   Namespace, Namespace),
    row("tasksets/status",         [NONE,   GET,   GET,   GET,   EDIT],  Namespace, Cluster),
    row("tasksets/scale",          [NONE,   GET,   EDIT,  EDIT,  EDIT],  Namespace, Namespace),
    row("tasksetrevisions",        [NONE,   READ,  END,   END,   END],   Namespace, Namespace),
    row("applications",            [NONE,   READ,  ALL,   ALL,   ALL],   Namespace, Namespace),
    row("applications/status",     [NONE,   GET,   GET,   GET,   EDIT],  Namespace, Cluster),
    row("frameworks",              [READ,   READ,  END,   END,   END],   Namespace, Namespace),
    row("frameworks/status",       [GET,    GET,   GET,   GET,   EDIT],  Namespace, Cluster),
    row("frameworks/why",          [GET,    GET,   GET,   GET,   GET],   Namespace, Namespace),
    row("frameworks/position",     [POST,   NONE,  POST,  POST,  POST],  Namespace, Namespace),
    row("frameworks/session",      [POST,   NONE,  POST,  POST,  POST],  Namespace, Namespace),
    row("configmaps",              [NONE,   READ,  ALL,   ALL,   ALL],   Namespace, Namespace),
    row("secrets",                 [NONE,   NONE,  ALL,   ALL,   ALL],   Namespace, Namespace),
    row("services",                [READ,   READ,  READ,  READ,  READ],  Namespace, Namespace),
    row("events",                  [READ,   READ,  READ,  READ,  ALL],   Namespace, Namespace),
    // What a namespace may have is for those above it to say.
    row("quotas",                  [NONE,   READ,  READ,  READ,  ALL],   Namespace, Cluster),
    row("quotas/status",           [NONE,   GET,   GET,   GET,   EDIT],  Namespace, Cluster),
    row("namespaces",              [READ,   READ,  READ,  READ,  ALL],   Namespace, Cluster),
    row("namespaces/status",       [GET,    GET,   GET,   GET,   EDIT],  Namespace, Cluster),
    // What everybody shares.
    row("nodes",                   [READ,   READ,  READ,  ALL,   ALL],   Anywhere,  Cluster),
    row("nodes/status",            [GET,    GET,   GET,   GET,   EDIT],  Anywhere,  Cluster),
    row("nodes/pose",              [GET,    GET,   GET,   GET,   GET],   Anywhere,  Cluster),
    row("nodes/fence",             [NONE,   NONE,  NONE,  POST,  POST],  Cluster,   Cluster),
    row("leases",                  [READ,   READ,  READ,  READ,  READ],  Anywhere,  Cluster),
    row("leases/status",           [GET,    GET,   GET,   GET,   GET],   Anywhere,  Cluster),
    row("leases/acquire",          [NONE,   NONE,  POST,  POST,  POST],  Cluster,   Cluster),
    row("leases/return",           [NONE,   NONE,  POST,  POST,  POST],  Cluster,   Cluster),
    row("leases/take",             [NONE,   NONE,  NONE,  POST,  POST],  Cluster,   Cluster),
    row("sites",                   [READ,   READ,  READ,  ALL,   ALL],   Anywhere,  Cluster),
    row("poses",                   [READ,   READ,  READ,  READ,  READ],  Anywhere,  Cluster),
    row("poses/stream",            [NONE,   NONE,  NONE,  POST,  POST],  Cluster,   Cluster),
    // Questions, and what holds several objects: each of these is decided by itself.
    row("plan",                    [NONE,   POST,  POST,  POST,  POST],  Anywhere,  Anywhere),
    row("check",                   [NONE,   POST,  POST,  POST,  POST],  Anywhere,  Anywhere),
    row("transaction",             [NONE,   NONE,  POST,  POST,  POST],  Anywhere,  Anywhere),
    row("usage",                   [GET,    GET,   GET,   GET,   GET],   Anywhere,  Anywhere),
    row("offers",                  [READ,   READ,  READ,  READ,  READ],  Anywhere,  Anywhere),
    // Who may do what.
    row("accesses",                [NONE,   NONE,  NONE,  READ,  ALL],   Cluster,   Cluster),
    row("jointokens",              [NONE,   NONE,  NONE,  ALL,   ALL],   Cluster,   Cluster),
    row("usertokens",              [NONE,   NONE,  NONE,  NONE,  ALL],   Cluster,   Cluster),
    row("subjectaccessreviews",    [NONE,   NONE,  NONE,  NONE,  POST],  Cluster,   Cluster),
    row("metrics",                 [NONE,   GET,   GET,   GET,   GET],   Cluster,   Cluster),
];

impl Row {
    pub(super) fn allows(&self, role: Role, verb: Verb) -> bool {
        let column = match role {
            Role::Framework => 0,
            Role::Viewer => 1,
            Role::Developer => 2,
            Role::Operator => 3,
            Role::Admin => 4,
        };
        self.verbs[column].contains(&verb)
    }

    pub(super) fn reach(&self, verb: Verb) -> Reach {
        if verb.reads() { self.reads } else { self.writes }
    }

    /// Resource and subresource.
    pub(super) fn names(&self) -> (&'static str, Option<&'static str>) {
        match self.what.split_once('/') {
            Some((resource, subresource)) => (resource, Some(subresource)),
            None => (self.what, None),
        }
    }
}

/// The row of what is asked for; none: nobody has a right to it but administrators.
pub(super) fn find(action: &Action<'_>) -> Option<&'static Row> {
    TABLE.iter().find(|row| row.names() == (action.resource, action.subresource))
}
