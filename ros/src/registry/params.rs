//! The parameter server: a tree of values, and who follows which part of it.
//!
//! Keys here are lists of names; the root is the empty list.

use std::collections::{BTreeMap, BTreeSet};

use super::said::path;
use crate::xmlrpc::Value;

/// All parameters together, roughly, bytes.
const MOST: usize = 16 << 20;

/// Levels of namespaces: XML-RPC's own limit is near, and walks over the tree recurse.
const DEEPEST: usize = 32;

/// A namespace, by name. Dictionaries are namespaces, everything else is a value.
type Space = BTreeMap<String, Param>;

#[derive(Debug, Clone, PartialEq)]
enum Param {
    Space(Space),
    Value(Value),
}

/// Why a parameter is not set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum ParamError {
    #[error("the root of the parameters is a dictionary")]
    Root,
    #[error("there are too many parameters")]
    Full,
    #[error("the namespaces of a parameter are too deep")]
    Deep,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Params {
    root: Space,
    size: usize,
    /// Who is told of a key and all below it: name and address, by key.
    followers: BTreeMap<Vec<String>, BTreeSet<(String, String)>>,
}

/// A follower is to be told.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Change {
    /// The address.
    pub(super) to: String,
    pub(super) key: Vec<String>,
    /// An empty struct when it is not set any more.
    pub(super) value: Value,
}

impl Params {
    pub(super) fn get(&self, key: &[String]) -> Option<Value> {
        let Some((last, above)) = key.split_last() else { return Some(dictionary(&self.root)) };
        let mut space = &self.root;
        for name in above {
            let Param::Space(next) = space.get(name)? else { return None };
            space = next;
        }
        space.get(last).map(value_of)
    }

    pub(super) fn has(&self, key: &[String]) -> bool {
        self.get(key).is_some()
    }

    /// Sets a key; what was there is gone, below it too. A value on the way to it becomes a namespace.
    pub(super) fn set(&mut self, key: &[String], value: &Value) -> Result<(), ParamError> {
        if key.len() > DEEPEST {
            return Err(ParamError::Deep);
        }
        let param = param_of(value, DEEPEST - key.len())?;
        let names: usize = key.iter().map(String::len).sum();
        let (added, removed) = (weight(&param) + names, self.weight_at(key));
        if self.size - removed + added > MOST {
            return Err(ParamError::Full);
        }
        match (key.split_last(), param) {
            (None, Param::Space(root)) => self.root = root,
            (None, Param::Value(_)) => return Err(ParamError::Root),
            (Some((last, above)), param) => {
                let mut space = &mut self.root;
                for name in above {
                    let next =
                        space.entry(name.clone()).or_insert_with(|| Param::Space(Space::new()));
                    if let Param::Value(_) = next {
                        *next = Param::Space(Space::new());
                    }
                    let Param::Space(next) = next else { unreachable!("it is one now") };
                    space = next;
                }
                space.insert(last.clone(), param);
            }
        }
        self.size = space_weight(&self.root);
        Ok(())
    }

    /// Whether it was set.
    pub(super) fn delete(&mut self, key: &[String]) -> bool {
        let Some((last, above)) = key.split_last() else { return false };
        let mut space = &mut self.root;
        for name in above {
            let Some(Param::Space(next)) = space.get_mut(name) else { return false };
            space = next;
        }
        let deleted = space.remove(last).is_some();
        self.size = space_weight(&self.root);
        deleted
    }

    fn weight_at(&self, key: &[String]) -> usize {
        let mut space = &self.root;
        for (at, name) in key.iter().enumerate() {
            match space.get(name) {
                Some(param) if at + 1 == key.len() => return weight(param),
                Some(Param::Space(next)) => space = next,
                Some(Param::Value(_)) | None => return 0,
            }
        }
        self.size
    }

    /// Of all values, `/a/b`.
    pub(super) fn names(&self) -> Vec<String> {
        let mut names = Vec::new();
        collect(&self.root, &mut String::new(), &mut names);
        names
    }

    /// The nearest key of this name, from the namespace `from` upwards; the first name of it decides.
    pub(super) fn search(&self, from: &[String], key: &[String]) -> Option<Vec<String>> {
        let first = key.first()?;
        (0..=from.len()).rev().find_map(|depth| {
            let above = &from[..depth];
            self.has(&[above, std::slice::from_ref(first)].concat()).then(|| [above, key].concat())
        })
    }

    pub(super) fn follow(&mut self, key: &[String], node: &str, api: &str) {
        let followers = self.followers.entry(key.to_vec()).or_default();
        followers.insert((node.to_owned(), api.to_owned()));
    }

    pub(super) fn unfollow(&mut self, key: &[String], node: &str, api: &str) -> bool {
        let Some(followers) = self.followers.get_mut(key) else { return false };
        let followed = followers.remove(&(node.to_owned(), api.to_owned()));
        if followers.is_empty() {
            self.followers.remove(key);
        }
        followed
    }

    /// The node is gone, or another one has its name.
    pub(super) fn forget(&mut self, node: &str) {
        self.followers.retain(|_, followers| {
            followers.retain(|(name, _)| name != node);
            !followers.is_empty()
        });
    }

    /// Everybody who follows something: name, address, and the key.
    pub(super) fn followers(&self) -> impl Iterator<Item = (&str, &str, String)> {
        self.followers.iter().flat_map(|(key, followers)| {
            followers.iter().map(|(node, api)| (&**node, &**api, path(key)))
        })
    }

    /// Everything that is set.
    pub(super) fn all(&self) -> Value {
        dictionary(&self.root)
    }

    pub(super) fn follows(&self, node: &str) -> usize {
        let of = |followers: &BTreeSet<(String, String)>| {
            followers.iter().filter(|(name, _)| name == node).count()
        };
        self.followers.values().map(of).sum()
    }

    /// Whom a change at `key` concerns: those who follow it or what is above it are told of the key; those who follow what is
    /// below it, of theirs. `by` has made it, and knows.
    pub(super) fn changes(&self, key: &[String], by: &str) -> Vec<Change> {
        let told = |at: &[String]| match at.len() >= key.len() {
            true => at.to_vec(),
            false => key.to_vec(),
        };
        let concerned =
            self.followers.iter().filter(|(at, _)| key.starts_with(at) || at.starts_with(key));
        let each = |(at, followers): (&Vec<String>, &BTreeSet<(String, String)>)| {
            let key = told(at);
            let value = self.get(&key).unwrap_or(Value::Struct(Vec::new()));
            let others = followers.iter().filter(|(node, _)| node != by);
            let change = |(_, api): &(String, String)| Change {
                to: api.clone(),
                key: key.clone(),
                value: value.clone(),
            };
            others.map(change).collect::<Vec<_>>()
        };
        concerned.flat_map(each).collect()
    }
}

fn value_of(param: &Param) -> Value {
    match param {
        Param::Space(space) => dictionary(space),
        Param::Value(value) => value.clone(),
    }
}

fn dictionary(space: &Space) -> Value {
    Value::Struct(space.iter().map(|(name, param)| (name.clone(), value_of(param))).collect())
}

fn param_of(value: &Value, levels: usize) -> Result<Param, ParamError> {
    let Value::Struct(members) = value else { return Ok(Param::Value(value.clone())) };
    let levels = levels.checked_sub(1).ok_or(ParamError::Deep)?;
    let member = |(name, value): &(String, Value)| Ok((name.clone(), param_of(value, levels)?));
    members.iter().map(member).collect::<Result<Space, _>>().map(Param::Space)
}

/// Memory that it takes, roughly.
fn weight(param: &Param) -> usize {
    match param {
        Param::Space(space) => space_weight(space),
        Param::Value(value) => value_weight(value),
    }
}

fn space_weight(space: &Space) -> usize {
    space.iter().map(|(name, param)| 64 + name.len() + weight(param)).sum()
}

fn value_weight(value: &Value) -> usize {
    match value {
        Value::Int(_) | Value::Bool(_) | Value::Double(_) => 32,
        Value::String(text) | Value::DateTime(text) | Value::Base64(text) => 32 + text.len(),
        Value::Array(values) => 32 + values.iter().map(value_weight).sum::<usize>(),
        Value::Struct(members) => {
            32 + members.iter().map(|(name, value)| name.len() + value_weight(value)).sum::<usize>()
        }
    }
}

fn collect(space: &Space, above: &mut String, names: &mut Vec<String>) {
    for (name, param) in space {
        let length = above.len();
        above.push('/');
        above.push_str(name);
        match param {
            Param::Space(space) => collect(space, above, names),
            Param::Value(_) => names.push(above.clone()),
        }
        above.truncate(length);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(text: &str) -> Vec<String> {
        text.split('/').filter(|name| !name.is_empty()).map(str::to_owned).collect()
    }

    fn tree(members: &[(&str, Value)]) -> Value {
        Value::Struct(members.iter().map(|(name, v)| ((*name).to_owned(), v.clone())).collect())
    }

    #[test]
    fn a_dictionary_is_a_namespace() {
        let mut params = Params::default();
        params.set(&key("/r1/gains"), &tree(&[("p", 2.into()), ("d", 1.into())])).unwrap();
        assert_eq!(params.get(&key("/r1/gains/p")), Some(2.into()));
        assert_eq!(params.names(), ["/r1/gains/d", "/r1/gains/p"]);
        params.set(&key("/r1/gains"), &tree(&[("i", 3.into())])).unwrap();
        assert!(!params.has(&key("/r1/gains/p")), "it is replaced, not merged");
        params.set(&key("/r1/gains/i/x"), &4.into()).unwrap();
        assert_eq!(params.get(&key("/r1/gains")), Some(tree(&[("i", tree(&[("x", 4.into())]))])));
        assert!(params.delete(&key("/r1")) && !params.delete(&key("/r1")));
        assert_eq!((params.names().len(), params.size), (0, 0));
        assert_eq!(params.set(&[], &1.into()), Err(ParamError::Root));
    }

    /// The example of rosmaster's own documentation.
    #[test]
    fn the_first_name_of_a_key_is_searched_upwards() {
        let mut params = Params::default();
        for name in
            ["/robot_description/arm", "/robot_description/base", "/pr2/robot_description/base"]
        {
            params.set(&key(name), &1.into()).unwrap();
        }
        let search = |from, name| params.search(&key(from), &key(name)).map(|key| key.join("/"));
        assert_eq!(search("/pr2/foo", "robot_description").unwrap(), "pr2/robot_description");
        assert_eq!(
            search("/pr2/foo", "robot_description/arm").unwrap(),
            "pr2/robot_description/arm"
        );
        assert_eq!(search("/other", "robot_description/arm").unwrap(), "robot_description/arm");
        assert_eq!(search("/pr2", "nothing"), None);
    }

    #[test]
    fn who_follows_is_told_of_what_is_above_and_below() {
        let mut params = Params::default();
        for (at, node) in [("/", "root"), ("/a", "a"), ("/a/b", "b"), ("/a/b/c", "c"), ("/x", "x")]
        {
            params.follow(&key(at), node, node);
        }
        let told = |params: &Params, at: &str, by: &str| -> Vec<String> {
            let changes = params.changes(&key(at), by);
            changes.into_iter().map(|c| format!("{} {}", c.to, c.key.join("/"))).collect()
        };
        params.set(&key("/a/b"), &1.into()).unwrap();
        assert_eq!(told(&params, "/a/b", "b"), ["root a/b", "a a/b", "c a/b/c"]);
        params.forget("a");
        assert!(params.unfollow(&[], "root", "root") && !params.unfollow(&[], "root", "root"));
        assert_eq!(told(&params, "/a", ""), ["b a/b", "c a/b/c"]);
        let changes = params.changes(&key("/a"), "");
        assert_eq!(changes[1].value, Value::Struct(Vec::new()), "it is not set");
    }

    #[test]
    fn parameters_are_bounded() {
        let mut params = Params::default();
        let mega = Value::String("x".repeat(1 << 20));
        let set = (0..20).map(|n| params.set(&key(&format!("/p{n}")), &mega)).collect::<Vec<_>>();
        assert!(set[..15].iter().all(Result::is_ok) && set[19] == Err(ParamError::Full));
        assert_eq!(params.set(&key("/p0"), &mega), Ok(()), "it takes the place of another");
        let deep = "/a".repeat(DEEPEST + 1);
        assert_eq!(params.set(&key(&deep), &1.into()), Err(ParamError::Deep));
        let deep = (0..DEEPEST).fold(Value::Int(1), |value, _| tree(&[("a", value)]));
        assert_eq!(params.set(&key("/a"), &deep), Err(ParamError::Deep));
    }
}
