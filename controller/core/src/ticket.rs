//! Which framework may exchange messages with which executor's agent directly, and by which secret.
//!
//! A ticket is for one executor and one session of its framework. It ends with either: both sides are told so, and the agent
//! ends what came by it. Both are told the whole of what concerns them, so a message that is lost costs nothing but time.
//!
//! After a start nothing is known of frameworks that have not come back yet. Of their executors nothing is said: agents
//! keep what was said before, and messages go on without the controller until the framework has a session again, or is
//! removed.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use muster_api::direct::Secret;
use muster_api::id::TaskUid;
use muster_api::name::NodeName;

/// A session of a framework.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Session(pub u64);

/// What a framework is told of an executor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Told {
    /// Who is told.
    pub framework: Arc<str>,
    /// In which of its sessions; a later one is told by itself.
    pub session: Session,
    /// Of which executor.
    pub executor: TaskUid,
    /// Where the executor is.
    pub node: NodeName,
    /// HOST:PORT and the secret; none: it holds no more.
    pub door: Option<(String, Secret)>,
}

/// What follows. Agents first: a framework that is faster than its agent is turned away.
#[derive(Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct Changes {
    /// Nodes whose tickets are others now; see [`Tickets::on`].
    pub nodes: BTreeSet<NodeName>,
    /// What frameworks are told, in this order.
    pub told: Vec<Told>,
}

#[derive(Debug, Default)]
struct Node {
    /// Empty: its agent does not listen.
    address: String,
    executors: BTreeMap<TaskUid, Arc<str>>,
}

#[derive(Debug)]
struct Ticket {
    node: NodeName,
    address: String,
    framework: Arc<str>,
    session: Session,
    secret: Secret,
}

impl Ticket {
    fn told(&self, executor: &TaskUid, door: Option<(String, Secret)>) -> Told {
        Told {
            framework: Arc::clone(&self.framework),
            session: self.session,
            executor: executor.clone(),
            node: self.node.clone(),
            door,
        }
    }
}

/// All tickets. `make` gives secrets that were never given before.
#[derive(Debug, Default)]
pub struct Tickets {
    nodes: HashMap<NodeName, Node>,
    /// Where executors are.
    places: HashMap<TaskUid, NodeName>,
    /// Frameworks by their uids; none: away. One that is not in it was not seen since the start.
    frameworks: HashMap<Arc<str>, Option<Session>>,
    issued: HashMap<TaskUid, Ticket>,
}

impl Tickets {
    /// All executors that a node has, with their frameworks, and where its agent listens; empty: nowhere.
    pub fn executors(
        &mut self,
        node: &NodeName,
        address: &str,
        executors: BTreeMap<TaskUid, Arc<str>>,
        make: &mut dyn FnMut() -> Secret,
    ) -> Changes {
        let mut concerned: BTreeSet<TaskUid> = executors.keys().cloned().collect();
        self.places.extend(executors.keys().map(|executor| (executor.clone(), node.clone())));
        let present = Node { address: address.to_owned(), executors };
        if let Some(before) = self.nodes.insert(node.clone(), present) {
            concerned.extend(before.executors.into_keys());
        }
        let mut changes = self.settle(concerned, make);
        // Its session may be a new one, which was told nothing.
        changes.nodes.insert(node.clone());
        changes
    }

    /// The executor's task has ended.
    pub fn ended(&mut self, executor: &TaskUid, make: &mut dyn FnMut() -> Secret) -> Changes {
        let node = self.places.get(executor).and_then(|node| self.nodes.get_mut(node));
        let framework = node.and_then(|node| node.executors.remove(executor));
        let changes = self.settle([executor.clone()], make);
        framework.inspect(|framework| self.forget_if_alone(framework));
        changes
    }

    /// A session of a framework began, in place of an earlier one; none: of one that does not use tickets.
    pub fn began(
        &mut self,
        framework: &Arc<str>,
        session: Option<Session>,
        make: &mut dyn FnMut() -> Secret,
    ) -> Changes {
        self.frameworks.insert(Arc::clone(framework), session);
        self.settle_all_of(framework, make)
    }

    /// A session of a framework ended.
    pub fn left(
        &mut self,
        framework: &Arc<str>,
        session: Session,
        make: &mut dyn FnMut() -> Secret,
    ) -> Changes {
        match self.frameworks.get_mut(framework) {
            Some(present) if *present == Some(session) => *present = None,
            _ => return Changes::default(),
        }
        self.settle_all_of(framework, make)
    }

    /// A framework is no more.
    pub fn removed(&mut self, framework: &Arc<str>, make: &mut dyn FnMut() -> Secret) -> Changes {
        self.frameworks.insert(Arc::clone(framework), None);
        let changes = self.settle_all_of(framework, make);
        self.forget_if_alone(framework);
        changes
    }

    /// Of one that is away and has no executors there is nothing to remember.
    fn forget_if_alone(&mut self, framework: &Arc<str>) {
        let away = self.frameworks.get(framework).is_some_and(Option::is_none);
        if away && self.executors_of(framework).is_empty() {
            self.frameworks.remove(framework);
        }
    }

    /// What a node's agent is told: its executors with their secrets; none: nobody may come. Those of whose frameworks
    /// nothing is known are not in it.
    #[must_use]
    pub fn on(&self, node: &NodeName) -> Vec<(TaskUid, Option<Secret>)> {
        let executors = self.nodes.get(node).into_iter().flat_map(|node| &node.executors);
        let known = executors.filter(|(_, framework)| self.frameworks.contains_key(*framework));
        let secret = |executor| self.issued.get(executor).map(|ticket| ticket.secret.clone());
        known.map(|(executor, _)| (executor.clone(), secret(executor))).collect()
    }

    fn executors_of(&self, framework: &Arc<str>) -> BTreeSet<TaskUid> {
        let all = self.nodes.values().flat_map(|node| &node.executors);
        let own = all.filter(|(_, owner)| *owner == framework);
        own.map(|(executor, _)| executor.clone()).collect()
    }

    fn settle_all_of(&mut self, framework: &Arc<str>, make: &mut dyn FnMut() -> Secret) -> Changes {
        let executors = self.executors_of(framework);
        let mut changes = self.settle(executors.iter().cloned(), make);
        // Also those that had no ticket: something is known of them now.
        changes.nodes.extend(executors.iter().filter_map(|e| self.places.get(e)).cloned());
        changes
    }

    fn settle(
        &mut self,
        executors: impl IntoIterator<Item = TaskUid>,
        make: &mut dyn FnMut() -> Secret,
    ) -> Changes {
        let mut changes = Changes::default();
        for executor in executors {
            self.settle_one(&executor, make, &mut changes);
        }
        changes
    }

    fn settle_one(
        &mut self,
        executor: &TaskUid,
        make: &mut dyn FnMut() -> Secret,
        changes: &mut Changes,
    ) {
        let Some(place) = self.places.get(executor).cloned() else { return };
        let node = self.nodes.get(&place);
        let owner = node.and_then(|node| Some((node, node.executors.get(executor)?)));
        let wanted = owner.filter(|(node, _)| !node.address.is_empty());
        let wanted = wanted.and_then(|(node, framework)| {
            Some((node.address.clone(), Arc::clone(framework), (*self.frameworks.get(framework)?)?))
        });
        let before = self.issued.get(executor);
        let same = before.is_some_and(|before| {
            before.node == place
                && wanted.as_ref().is_some_and(|(address, framework, session)| {
                    (address, framework, session)
                        == (&before.address, &before.framework, &before.session)
                })
        });
        if owner.is_none() {
            self.places.remove(executor);
        }
        if same {
            return;
        }
        if let Some(before) = self.issued.remove(executor) {
            changes.nodes.insert(before.node.clone());
            changes.told.push(before.told(executor, None));
        }
        let Some((address, framework, session)) = wanted else { return };
        let ticket = Ticket { node: place, address, framework, session, secret: make() };
        let door = Some((ticket.address.clone(), ticket.secret.clone()));
        changes.nodes.insert(ticket.node.clone());
        changes.told.push(ticket.told(executor, door));
        self.issued.insert(executor.clone(), ticket);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct World {
        tickets: Tickets,
        made: u8,
    }

    impl World {
        fn new() -> World {
            World { tickets: Tickets::default(), made: 0 }
        }

        fn act(
            &mut self,
            act: impl FnOnce(&mut Tickets, &mut dyn FnMut() -> Secret) -> Changes,
        ) -> Changes {
            let made = &mut self.made;
            let mut make = || {
                *made += 1;
                Secret::new([*made; 32])
            };
            act(&mut self.tickets, &mut make)
        }

        fn executors(&mut self, at: &str, address: &str, executors: &[(&str, &str)]) -> Changes {
            let executors = executors.iter().map(|(e, f)| (TaskUid::new(*e), Arc::from(*f)));
            let executors = executors.collect();
            self.act(|tickets, make| tickets.executors(&node(at), address, executors, make))
        }

        fn on(&self, at: &str) -> Vec<(String, Option<u8>)> {
            let on = self.tickets.on(&node(at)).into_iter();
            on.map(|(e, secret)| (e.to_string(), secret.map(|s| s.bytes()[0]))).collect()
        }
    }

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a name")
    }

    fn told(changes: &Changes) -> Vec<(&str, u64, &str, Option<u8>)> {
        let told = changes.told.iter();
        told.map(|t| {
            let secret = t.door.as_ref().map(|(_, secret)| secret.bytes()[0]);
            (&*t.framework, t.session.0, t.executor.as_str(), secret)
        })
        .collect()
    }

    fn pair(executor: &str, secret: Option<u8>) -> (String, Option<u8>) {
        (executor.to_owned(), secret)
    }

    #[test]
    fn both_sides_are_told_as_soon_as_both_are_there() {
        let mut world = World::new();
        let crew: Arc<str> = "crew".into();
        assert_eq!(told(&world.executors("n", "h:1", &[("e", "crew")])), []);
        assert_eq!(world.on("n"), [], "nothing is known of the framework since the start");
        let changes = world.act(|t, make| t.began(&crew, Some(Session(1)), make));
        assert_eq!(told(&changes), [("crew", 1, "e", Some(1))]);
        assert!(changes.nodes.contains(&node("n")));
        assert_eq!(world.on("n"), [pair("e", Some(1))]);

        // The agent's session was lost for a moment: what holds goes on.
        let changes = world.executors("n", "h:1", &[("e", "crew")]);
        assert_eq!((told(&changes), world.on("n")), (vec![], vec![pair("e", Some(1))]));
        assert!(changes.nodes.contains(&node("n")), "the new session is told");
        // It listens elsewhere now.
        let changes = world.executors("n", "h:2", &[("e", "crew")]);
        assert_eq!(told(&changes), [("crew", 1, "e", None), ("crew", 1, "e", Some(2))]);
    }

    #[test]
    fn a_ticket_ends_with_the_session_the_framework_or_the_executor() {
        let crew: Arc<str> = "crew".into();
        let begin = || {
            let mut world = World::new();
            let _ = world.executors("n", "h:1", &[("e", "crew"), ("other", "others")]);
            let _ = world.act(|t, make| t.began(&"crew".into(), Some(Session(1)), make));
            world
        };
        let mut world = begin();
        let changes = world.act(|t, make| t.began(&crew, Some(Session(2)), make));
        assert_eq!(told(&changes), [("crew", 1, "e", None), ("crew", 2, "e", Some(2))]);
        let late = world.act(|t, make| t.left(&crew, Session(1), make));
        assert_eq!((late, world.on("n")), (Changes::default(), vec![pair("e", Some(2))]));
        let _ = world.act(|t, make| t.left(&crew, Session(2), make));
        assert_eq!(world.on("n"), [pair("e", None)], "the agent is told that nobody may come");

        let mut world = begin();
        let changes = world.act(|t, make| t.removed(&crew, make));
        assert_eq!(told(&changes), [("crew", 1, "e", None)]);
        assert_eq!(world.on("n"), [pair("e", None)]);

        let mut world = begin();
        let changes = world.act(|t, make| t.ended(&TaskUid::new("e"), make));
        assert_eq!((told(&changes), world.on("n")), (vec![("crew", 1, "e", None)], vec![]));
        assert!(world.tickets.issued.is_empty() && !world.tickets.places.contains_key("e"));

        let mut world = begin();
        let changes = world.executors("n", "h:1", &[("other", "others")]);
        assert_eq!(told(&changes), [("crew", 1, "e", None)]);
    }

    #[test]
    fn who_does_not_listen_or_does_not_dial_gets_none() {
        let mut world = World::new();
        let crew: Arc<str> = "crew".into();
        let _ = world.executors("n", "", &[("e", "crew")]);
        let changes = world.act(|t, make| t.began(&crew, Some(Session(1)), make));
        assert_eq!((told(&changes), world.on("n")), (vec![], vec![pair("e", None)]));
        let _ = world.executors("n", "h:1", &[("e", "crew")]);
        assert_eq!(world.on("n"), [pair("e", Some(1))]);
        let changes = world.act(|t, make| t.began(&crew, None, make));
        assert_eq!(told(&changes), [("crew", 1, "e", None)]);
        assert_eq!(world.on("n"), [pair("e", None)]);
    }
}
