//! Who may do what: the one decision for REST, for gRPC and for the questions about it.
//!
//! ```text
//!   Access objects ──Grants──▶ what a user holds ┐
//!   certificate, token ──────▶ [`Who`]           ┴─ decide([`Asked`]) ──▶ Ok │ Denied (why, and which role would do)
//! ```
//!
//! | module | is |
//! |---|---|
//! | `table` | roles × resources × verbs, and how far each right reaches: data |
//! | [`grants`] | Access objects, by who they are for |
//! | [`host`] | what of a task reaches into its node, and who may have it so |
//!
//! Rights add up: one grant that allows something is enough. What no row of the table names is for administrators of the
//! whole cluster alone, so that something new is closed until somebody opens it.

pub mod grants;
pub mod host;
mod table;

use std::fmt;

use muster_api::kind::access::Role;

pub use grants::{Grant, Grants};
use table::{Reach, Row};

/// What is done, in Kubernetes' words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Verb {
    /// Read one object.
    Get,
    /// Read a collection.
    List,
    /// Follow changes.
    Watch,
    /// POST.
    Create,
    /// PUT.
    Update,
    /// PATCH.
    Patch,
    /// DELETE of one object.
    Delete,
    /// DELETE of a collection.
    DeleteCollection,
}

impl Verb {
    /// Every verb.
    pub const ALL: [Verb; 8] = [
        Verb::Get,
        Verb::List,
        Verb::Watch,
        Verb::Create,
        Verb::Update,
        Verb::Patch,
        Verb::Delete,
        Verb::DeleteCollection,
    ];

    /// The word, as in a resource's list of verbs.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Get => "get",
            Self::List => "list",
            Self::Watch => "watch",
            Self::Create => "create",
            Self::Update => "update",
            Self::Patch => "patch",
            Self::Delete => "delete",
            Self::DeleteCollection => "deletecollection",
        }
    }

    /// The verb of this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|verb| verb.as_str() == name)
    }

    /// It changes nothing.
    #[must_use]
    pub const fn reads(self) -> bool {
        matches!(self, Self::Get | Self::List | Self::Watch)
    }
}

/// Who asks, as far as rights go.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Who {
    /// Holds a certificate of the administrators.
    Admin,
    /// The agent of this node.
    Node(String),
    /// A user, with all that Access objects give them.
    User(Vec<Grant>),
    /// Said nothing about who they are.
    Nobody,
}

/// Something done to a resource.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Action<'a> {
    /// What.
    pub verb: Verb,
    /// API group; empty for core kinds.
    pub group: &'a str,
    /// The plural.
    pub resource: &'a str,
    /// A part of the object with a path of its own.
    pub subresource: Option<&'a str>,
    /// Of what is in a namespace, and of the Namespace of that name; none: all of them, or none has one.
    pub namespace: Option<&'a str>,
    /// The object.
    pub name: Option<&'a str>,
}

/// What is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Asked<'a> {
    /// Anybody may: health, version, joining (which a token decides).
    Open,
    /// Whoever said who they are may: what there is, and what one may.
    Known,
    /// A right is needed.
    Right(Action<'a>),
}

/// Why not.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Denied {
    /// They did not say who they are.
    WhoAreYou,
    /// An agent has no business there.
    NotItsNode {
        /// Its node.
        node: String,
    },
    /// Nothing that the user holds allows it.
    NoRole {
        /// All that the user holds.
        held: Vec<Grant>,
        /// The least that would.
        needed: Grant,
    },
}

impl fmt::Display for Denied {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Denied::WhoAreYou => f.write_str("a client certificate or a token is needed"),
            Denied::NotItsNode { node } => {
                write!(f, "the agent of {node:?} speaks for its node alone")
            }
            Denied::NoRole { held, needed } => {
                match &held[..] {
                    [] => f.write_str("no Access object gives the user a role")?,
                    [only] => write!(f, "the user is {only}")?,
                    [first, .., last] if held.len() == 2 => {
                        write!(f, "the user is {first} and {last}")?;
                    }
                    [first, more @ ..] => {
                        write!(f, "the user is {first} and has {} more roles", more.len())?;
                    }
                }
                write!(f, "; {needed} may")
            }
        }
    }
}

/// Whether `who` may do what is asked.
///
/// # Errors
///
/// Why not.
pub fn decide(who: &Who, asked: &Asked<'_>) -> Result<(), Denied> {
    let action = match (asked, who) {
        (Asked::Open, _) | (Asked::Known, Who::Admin | Who::Node(_) | Who::User(_)) => {
            return Ok(());
        }
        (_, Who::Nobody) => return Err(Denied::WhoAreYou),
        (Asked::Right(action), _) => action,
    };
    match who {
        Who::Admin => Ok(()),
        Who::Node(node) if of_its_node(action, node) => Ok(()),
        Who::Node(node) => Err(Denied::NotItsNode { node: node.clone() }),
        Who::User(held) if held.iter().any(|grant| grants(grant, action)) => Ok(()),
        Who::User(held) => Err(Denied::NoRole { held: held.clone(), needed: needed(action) }),
        Who::Nobody => Err(Denied::WhoAreYou),
    }
}

/// An agent reads its own Node, and holds sessions for it. Over these it tells of its node and its own tasks alone, which the
/// session sees to.
fn of_its_node(action: &Action<'_>, node: &str) -> bool {
    let what = (action.verb, action.subresource);
    action.resource == "nodes"
        && action.name == Some(node)
        && matches!(what, (Verb::Get, None | Some("pose")) | (Verb::Create, Some("session")))
}

fn grants(grant: &Grant, action: &Action<'_>) -> bool {
    let cluster = grant.namespace.is_none();
    let Some(row) = table::find(action) else { return cluster && grant.role == Role::Admin };
    row.allows(grant.role, action.verb)
        && (cluster || reaches(row, grant.namespace.as_deref(), action))
}

/// Whether a right in this namespace reaches what is asked for.
fn reaches(row: &Row, namespace: Option<&str>, action: &Action<'_>) -> bool {
    match row.reach(action.verb) {
        Reach::Namespace => action.namespace == namespace,
        Reach::Anywhere => true,
        Reach::Cluster => false,
    }
}

/// The least that allows it.
fn needed(action: &Action<'_>) -> Grant {
    let row = table::find(action);
    // A framework's is the least of all, and of use to frameworks alone.
    let order = [Role::Viewer, Role::Framework, Role::Developer, Role::Operator, Role::Admin];
    let allows = |role: &Role| row.is_some_and(|row| row.allows(*role, action.verb));
    let role = order.into_iter().find(allows).unwrap_or(Role::Admin);
    let here = row.is_some_and(|row| row.reach(action.verb) == Reach::Namespace);
    let namespace = action.namespace.filter(|_| here).map(str::to_owned);
    Grant { role, namespace, host_access: false }
}

/// What somebody may do with a resource in a namespace.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rule {
    /// `tasks`, or `pods/exec`; `*`: everything.
    pub resource: &'static str,
    /// Nothing else than this object.
    pub name: Option<String>,
    /// None: every verb.
    pub verbs: Option<Vec<Verb>>,
}

/// All that `who` may do in a namespace, and with what belongs to none.
#[must_use]
pub fn rules(who: &Who, namespace: &str) -> Vec<Rule> {
    let everything = Rule { resource: "*", name: None, verbs: None };
    match who {
        Who::Nobody => Vec::new(),
        Who::Admin => vec![everything],
        Who::Node(node) => ["nodes", "nodes/pose"]
            .into_iter()
            .map(|resource| Rule {
                resource,
                name: Some(node.clone()),
                verbs: Some(vec![Verb::Get]),
            })
            .collect(),
        Who::User(held) => {
            if held.iter().any(|g| g.role == Role::Admin && g.namespace.is_none()) {
                return vec![everything];
            }
            let rule = |row: &'static Row| {
                let (resource, subresource) = row.names();
                let may = |verb: &Verb| {
                    let (group, name) = ("", None);
                    let namespace = Some(namespace);
                    let verb = *verb;
                    let action = Action { verb, group, resource, subresource, namespace, name };
                    held.iter().any(|grant| grants(grant, &action))
                };
                let verbs: Vec<Verb> = Verb::ALL.into_iter().filter(may).collect();
                let some = !verbs.is_empty();
                some.then_some(Rule { resource: row.what, name: None, verbs: Some(verbs) })
            };
            table::TABLE.iter().filter_map(rule).collect()
        }
    }
}

#[cfg(test)]
mod tests;
