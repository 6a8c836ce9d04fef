//! URL and method → what is asked for.

use http::{Method, Uri};
pub use muster_controller_core::access::Verb;
use muster_controller_core::person::Step;

use super::discovery::{self, ApiGroup};
use super::failure::Failure;
use super::metrics_api::{self, Measured};
use super::query::Query;
use super::registry::{self, Entry, View};
use super::review::Review;
use crate::objects::NODES;
use crate::store::Key;

/// Which question about health.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Probe {
    /// Is the process alive?
    Live,
    /// Does it answer writes?
    Ready,
}

/// Which part of discovery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Discovery {
    /// `/`
    Root,
    /// `/api`
    Core,
    /// `/apis`
    Groups,
    /// `/apis/GROUP`
    Group(&'static ApiGroup),
    /// `/api/v1` or `/apis/GROUP/VERSION`
    Resources(&'static ApiGroup),
}

/// A part of an object with a path of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subresource {
    /// `…/status`
    Status,
    /// `…/log`
    Log,
    /// `…/why`
    Why,
    /// `…/fence`
    Fence,
    /// `…/pose`
    Pose,
    /// `…/scale`
    Scale,
    /// `…/eviction`
    Eviction,
    /// `…/exec`
    Exec,
    /// `…/attach`
    Attach,
    /// `…/position`
    Position,
    /// `…/acquire`, `…/take`, `…/return`
    Lease(Step),
}

impl Subresource {
    /// The last part of its path.
    pub(crate) const fn as_str(self) -> &'static str {
        match self {
            Self::Status => "status",
            Self::Log => "log",
            Self::Why => "why",
            Self::Fence => "fence",
            Self::Pose => "pose",
            Self::Scale => "scale",
            Self::Eviction => "eviction",
            Self::Exec => "exec",
            Self::Attach => "attach",
            Self::Position => "position",
            Self::Lease(Step::Acquire) => "acquire",
            Self::Lease(Step::Take) => "take",
            Self::Lease(Step::Return) => "return",
        }
    }
}

/// One object, or a collection when `name` is `None`.
#[derive(Debug, Clone)]
pub struct Object {
    pub(crate) entry: &'static Entry,
    /// `None` for cluster-scoped kinds and for lists over all namespaces.
    pub(crate) namespace: Option<String>,
    pub(crate) name: Option<String>,
    pub(crate) subresource: Option<Subresource>,
}

impl Object {
    /// The key of the named object.
    pub(crate) fn key(&self) -> Result<Key, Failure> {
        let name = self.name.as_deref().ok_or_else(|| Failure::bad_request("a name is needed"))?;
        Ok(self.entry.key(self.namespace.as_deref(), name))
    }

    pub(crate) fn allows(&self, verb: Verb) -> bool {
        match self.subresource {
            Some(Subresource::Log | Subresource::Why | Subresource::Pose) => verb == Verb::Get,
            Some(
                Subresource::Fence
                | Subresource::Eviction
                | Subresource::Exec
                | Subresource::Attach
                | Subresource::Position
                | Subresource::Lease(_),
            ) => verb == Verb::Create,
            Some(Subresource::Scale) => matches!(verb, Verb::Get | Verb::Update | Verb::Patch),
            Some(Subresource::Status) => {
                self.entry.info.has_status
                    && (verb == Verb::Get
                        || self.entry.verbs.contains(&verb)
                            && matches!(verb, Verb::Update | Verb::Patch))
            }
            // As in Kubernetes: all of a kind in all namespaces is not ended by one request.
            None if verb == Verb::DeleteCollection => {
                let everywhere = self.entry.info.namespaced && self.namespace.is_none();
                self.entry.verbs.contains(&verb) && !everywhere
            }
            None => self.entry.verbs.contains(&verb),
        }
    }
}

/// What a request is about.
#[derive(Debug, Clone)]
pub(crate) enum Target {
    Health(Probe),
    Metrics,
    Version,
    Discovery(Discovery),
    Join,
    /// What the real scheduler would do with some objects.
    Plan,
    /// What objects have wrong only all together.
    Check,
    /// Several objects in one commit.
    Transaction,
    /// What nodes and tasks use now.
    Usage,
    /// What nodes and tasks use now, for `kubectl top`.
    Measured(Measured),
    /// What the client itself may do, and who it is.
    Review(Review),
    /// OpenAPI: the index, or the document of a group.
    OpenApi(Option<&'static ApiGroup>),
    /// What frameworks are offered now.
    Offers,
    /// Where robots are now.
    Poses,
    /// Join tokens; one when it is named.
    Tokens(Option<String>),
    /// Tokens of users; one when it is named.
    UserTokens(Option<String>),
    Objects(Object),
}

impl Target {
    /// The plural, for metrics and messages.
    pub(crate) fn resource(&self) -> Option<&'static str> {
        match self {
            Self::Objects(object) => Some(object.entry.info.plural),
            Self::Measured(_) => Some("metrics"),
            Self::Review(_) => Some("reviews"),
            Self::Tokens(_) => Some("jointokens"),
            Self::UserTokens(_) => Some("usertokens"),
            Self::Join => Some("join"),
            Self::Plan => Some("plan"),
            Self::Check => Some("check"),
            Self::Transaction => Some("transaction"),
            Self::Usage => Some("usage"),
            Self::Offers => Some("offers"),
            Self::Poses => Some("poses"),
            _ => None,
        }
    }
}

/// Reads a request's line.
pub(crate) fn read(method: &Method, uri: &Uri) -> Result<(Verb, Target), Failure> {
    let path = uri.path();
    let parts: Vec<&str> = path.split('/').filter(|part| !part.is_empty()).collect();
    let unknown = || Failure::unknown_path(path);
    let target = match parts[..] {
        ["healthz" | "livez"] => Target::Health(Probe::Live),
        ["readyz"] => Target::Health(Probe::Ready),
        ["metrics"] => Target::Metrics,
        ["version"] => Target::Version,
        [] => Target::Discovery(Discovery::Root),
        ["api"] => Target::Discovery(Discovery::Core),
        ["apis"] => Target::Discovery(Discovery::Groups),
        ["openapi", "v3"] => Target::OpenApi(None),
        ["openapi", "v3", "api", "v1"] => Target::OpenApi(discovery::find("", "v1")),
        ["openapi", "v3", "apis", group, version] => {
            Target::OpenApi(Some(discovery::find(group, version).ok_or_else(unknown)?))
        }
        ["apis", group] => {
            let group = discovery::named(group).ok_or_else(unknown)?;
            Target::Discovery(Discovery::Group(group))
        }
        ["api", "v1"] => Target::Discovery(Discovery::Resources(&discovery::GROUPS[0])),
        ["apis", group, version] => {
            let group = discovery::find(group, version).ok_or_else(unknown)?;
            Target::Discovery(Discovery::Resources(group))
        }
        ["apis", "authorization.k8s.io", "v1", "selfsubjectaccessreviews"] => {
            Target::Review(Review::Access)
        }
        ["apis", "authorization.k8s.io", "v1", "subjectaccessreviews"] => {
            Target::Review(Review::OfOthers)
        }
        ["apis", "authorization.k8s.io", "v1", "selfsubjectrulesreviews"] => {
            Target::Review(Review::Rules)
        }
        ["apis", "authentication.k8s.io", "v1", "selfsubjectreviews"] => {
            Target::Review(Review::Subject)
        }
        ["apis", metrics_api::GROUP, metrics_api::VERSION, ref rest @ ..] => {
            Target::Measured(measured(rest).ok_or_else(unknown)?)
        }
        ["api", "v1", ref rest @ ..] => Target::Objects(object("", rest).ok_or_else(unknown)?),
        ["apis", muster_api::GROUP, muster_api::VERSION, ref rest @ ..] => match rest {
            ["join"] => Target::Join,
            ["plan"] => Target::Plan,
            ["check"] => Target::Check,
            ["transaction"] => Target::Transaction,
            ["usage"] => Target::Usage,
            ["offers"] => Target::Offers,
            ["poses"] => Target::Poses,
            ["jointokens"] => Target::Tokens(None),
            ["jointokens", id] => Target::Tokens(Some((*id).to_owned())),
            ["usertokens"] => Target::UserTokens(None),
            ["usertokens", id] => Target::UserTokens(Some((*id).to_owned())),
            _ => Target::Objects(object(muster_api::GROUP, rest).ok_or_else(unknown)?),
        },
        _ => return Err(unknown()),
    };
    let named = match &target {
        Target::Objects(object) => object.name.is_some(),
        Target::Tokens(id) | Target::UserTokens(id) => id.is_some(),
        Target::Poses => false,
        Target::Measured(measured) => measured.name.is_some(),
        _ => true,
    };
    let verb = match (verb(method, uri, named).ok_or_else(|| Failure::method(method))?, &target) {
        // A GET because WebSockets are; it is no reading.
        (Verb::Get, Target::Objects(object))
            if matches!(object.subresource, Some(Subresource::Exec | Subresource::Attach)) =>
        {
            Verb::Create
        }
        (verb, _) => verb,
    };
    let read_only = matches!(
        target,
        Target::Health(_)
            | Target::Metrics
            | Target::Version
            | Target::Discovery(_)
            | Target::OpenApi(_)
            | Target::Usage
    );
    let post_only = matches!(
        target,
        Target::Join | Target::Plan | Target::Check | Target::Transaction | Target::Review(_)
    );
    let read_only =
        read_only || matches!(target, Target::Measured(_)) && !matches!(verb, Verb::List);
    let followed = matches!(target, Target::Poses) && !matches!(verb, Verb::List | Verb::Watch);
    if read_only && verb != Verb::Get || post_only && verb != Verb::Create || followed {
        return Err(Failure::method(method));
    }
    Ok((verb, target))
}

/// `nodes[/NAME]`, `pods` or `namespaces/NS/pods[/NAME]`.
fn measured(parts: &[&str]) -> Option<Measured> {
    let (pods, namespace, name) = match *parts {
        ["nodes"] => (false, None, None),
        ["nodes", name] => (false, None, Some(name)),
        ["pods"] => (true, None, None),
        ["namespaces", namespace, "pods"] => (true, Some(namespace), None),
        ["namespaces", namespace, "pods", name] => (true, Some(namespace), Some(name)),
        _ => return None,
    };
    Some(Measured { pods, namespace: namespace.map(str::to_owned), name: name.map(str::to_owned) })
}

fn verb(method: &Method, uri: &Uri, named: bool) -> Option<Verb> {
    let watching = || Query::read(uri).is_ok_and(|query| query.flag("watch"));
    Some(match (method.as_str(), named) {
        ("GET" | "HEAD", true) => Verb::Get,
        ("GET" | "HEAD", false) if watching() => Verb::Watch,
        ("GET" | "HEAD", false) => Verb::List,
        ("POST", _) => Verb::Create,
        ("PUT", true) => Verb::Update,
        ("PATCH", true) => Verb::Patch,
        ("DELETE", true) => Verb::Delete,
        ("DELETE", false) => Verb::DeleteCollection,
        _ => return None,
    })
}

/// `[namespaces/NS/]PLURAL[/NAME[/SUB]]`. Namespaces themselves are `namespaces[/NAME[/SUB]]`.
fn object(group: &str, parts: &[&str]) -> Option<Object> {
    let (namespace, rest) = match parts {
        ["namespaces", namespace, plural, rest @ ..]
            if registry::find(group, plural).is_some_and(|entry| entry.info.namespaced) =>
        {
            (Some((*namespace).to_owned()), [&[*plural], rest].concat())
        }
        _ => (None, parts.to_vec()),
    };
    let (plural, name, sub) = match rest[..] {
        [plural] => (plural, None, None),
        [plural, name] => (plural, Some(name.to_owned()), None),
        [plural, name, sub] => (plural, Some(name.to_owned()), Some(sub)),
        _ => return None,
    };
    let entry = registry::find(group, plural)?;
    let subresource = match sub {
        None => None,
        Some(sub) => Some(subresource(entry, sub)?),
    };
    // An object of a namespaced kind has no path outside its namespace.
    if entry.info.namespaced && namespace.is_none() && name.is_some() {
        return None;
    }
    Some(Object { entry, namespace, name, subresource })
}

/// The part of an object of this kind that is called so.
pub(super) fn subresource(entry: &Entry, name: &str) -> Option<Subresource> {
    let is_lease = entry.info.kind == "Lease";
    let stored_node = entry.resource == NODES && entry.view == View::Stored;
    let there = match name {
        "status" => (Subresource::Status, entry.info.has_status),
        "log" => (Subresource::Log, entry.has_log),
        "why" => (Subresource::Why, entry.has_why),
        "fence" => (Subresource::Fence, stored_node),
        "pose" => (Subresource::Pose, stored_node),
        "eviction" => (Subresource::Eviction, entry.info.kind == "Pod"),
        "exec" => (Subresource::Exec, entry.info.kind == "Pod"),
        "attach" => (Subresource::Attach, entry.info.kind == "Pod"),
        "position" => (Subresource::Position, entry.info.kind == "Framework"),
        "scale" => (Subresource::Scale, entry.info.kind == "TaskSet"),
        "acquire" => (Subresource::Lease(Step::Acquire), is_lease),
        "take" => (Subresource::Lease(Step::Take), is_lease),
        "return" => (Subresource::Lease(Step::Return), is_lease),
        _ => return None,
    };
    there.1.then_some(there.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_text(method: &str, uri: &str) -> String {
        let method: Method = method.parse().unwrap();
        match read(&method, &uri.parse().unwrap()) {
            Ok((verb, Target::Objects(object))) => format!(
                "{} {} ns={:?} name={:?} sub={:?}",
                verb.as_str(),
                object.entry.resource,
                object.namespace,
                object.name,
                object.subresource
            ),
            Ok((verb, target)) => format!("{} {target:?}", verb.as_str()),
            Err(failure) => failure.code().to_string(),
        }
    }

    #[test]
    fn paths_are_read_as_kubernetes_does() {
        let g = "/apis/muster.dev/v1alpha1";
        let cases = [
            ("GET", format!("{g}/tasks"), "list tasks ns=None name=None sub=None"),
            ("GET", format!("{g}/tasks?watch=true"), "watch tasks ns=None name=None sub=None"),
            // Python's client writes it so.
            ("GET", format!("{g}/tasks?watch=True"), "watch tasks ns=None name=None sub=None"),
            ("GET", format!("{g}/tasks?limit=1&watch"), "watch tasks ns=None name=None sub=None"),
            ("GET", format!("{g}/tasks?watch=False"), "list tasks ns=None name=None sub=None"),
            ("GET", format!("{g}/tasks?watch=0"), "list tasks ns=None name=None sub=None"),
            (
                "POST",
                format!("{g}/namespaces/a/tasks"),
                "create tasks ns=Some(\"a\") name=None sub=None",
            ),
            (
                "PUT",
                format!("{g}/namespaces/a/tasks/t/status"),
                "update tasks ns=Some(\"a\") name=Some(\"t\") sub=Some(Status)",
            ),
            ("GET", format!("{g}/tasks/t"), "404"),
            ("GET", format!("{g}/nodes/n/log"), "404"),
            (
                "POST",
                format!("{g}/nodes/n/fence"),
                "create nodes ns=None name=Some(\"n\") sub=Some(Fence)",
            ),
            ("POST", format!("{g}/namespaces/a/tasks/t/fence"), "404"),
            (
                "GET",
                format!("{g}/nodes/n/pose"),
                "get nodes ns=None name=Some(\"n\") sub=Some(Pose)",
            ),
            ("GET", format!("{g}/poses"), "list Poses"),
            ("GET", format!("{g}/poses?watch=true"), "watch Poses"),
            ("POST", format!("{g}/poses"), "405"),
            ("GET", format!("{g}/namespaces/a/tasks/t/scale"), "404"),
            (
                "PATCH",
                format!("{g}/namespaces/a/tasksets/t/scale"),
                "patch tasksets ns=Some(\"a\") name=Some(\"t\") sub=Some(Scale)",
            ),
            ("DELETE", format!("{g}/nodes"), "deletecollection nodes ns=None name=None sub=None"),
            ("GET", "/api/v1/namespaces".into(), "list namespaces ns=None name=None sub=None"),
            (
                "GET",
                "/api/v1/namespaces/a/status".into(),
                "get namespaces ns=None name=Some(\"a\") sub=Some(Status)",
            ),
            (
                "GET",
                "/api/v1/namespaces/a/events".into(),
                "list events ns=Some(\"a\") name=None sub=None",
            ),
            ("GET", "/api/v1/pods".into(), "list tasks ns=None name=None sub=None"),
            ("POST", "/api/v1/pods".into(), "create tasks ns=None name=None sub=None"),
            (
                "POST",
                "/api/v1/namespaces/a/pods/t/eviction".into(),
                "create tasks ns=Some(\"a\") name=Some(\"t\") sub=Some(Eviction)",
            ),
            (
                "GET",
                "/api/v1/namespaces/a/pods/t/exec?command=ls&stdout=true".into(),
                "create tasks ns=Some(\"a\") name=Some(\"t\") sub=Some(Exec)",
            ),
            (
                "POST",
                "/api/v1/namespaces/a/pods/t/attach".into(),
                "create tasks ns=Some(\"a\") name=Some(\"t\") sub=Some(Attach)",
            ),
            ("GET", format!("{g}/namespaces/a/tasks/t/exec"), "404"),
            (
                "POST",
                format!("{g}/leases/n.body/take"),
                "create leases ns=None name=Some(\"n.body\") sub=Some(Lease(Take))",
            ),
            ("POST", format!("{g}/nodes/n/take"), "404"),
            ("GET", "/api/v1/nodes/n/pose".into(), "404"),
            ("GET", "/apis/metrics.k8s.io/v1beta1/things".into(), "404"),
            ("POST", "/openapi/v3".into(), "405"),
            ("GET", "/openapi/v2".into(), "404"),
            ("GET", "/apis/other/v1/things".into(), "404"),
            ("PUT", format!("{g}/nodes"), "405"),
            ("POST", "/healthz".into(), "405"),
            ("GET", format!("{g}/join"), "405"),
        ];
        for (method, uri, expected) in cases {
            assert_eq!(read_text(method, &uri), expected, "{method} {uri}");
        }
    }
}
