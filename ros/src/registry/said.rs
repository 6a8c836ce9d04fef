//! What a caller says: its name, and parameters of which each is looked at before it counts.

use crate::xmlrpc::{Call, Value};

/// Bytes of a name, a type or an address.
const LONGEST: usize = 512;

/// What a caller says.
pub(super) struct Said<'a> {
    pub(super) caller: &'a str,
    params: &'a [Value],
}

impl<'a> Said<'a> {
    pub(super) fn new(params: &'a [Value], count: usize) -> Result<Said<'a>, String> {
        if params.len() != count {
            return Err("Error: bad call arity".to_owned());
        }
        let caller = params.first().and_then(Value::as_str).filter(|caller| is_name(caller));
        let caller = caller.ok_or_else(|| "caller_id must be a string".to_owned())?;
        Ok(Said { caller, params })
    }

    pub(super) fn value(&self, at: usize) -> Result<&'a Value, String> {
        self.params.get(at).ok_or_else(|| "Error: bad call arity".to_owned())
    }

    pub(super) fn text(&self, at: usize) -> Result<&'a str, String> {
        let text = self.value(at)?.as_str().filter(|text| text.len() <= LONGEST);
        text.ok_or_else(|| format!("parameter {at} must be a string"))
    }

    /// The global name of a topic, service or node.
    pub(super) fn name(&self, at: usize) -> Result<String, String> {
        let name = self.text(at)?;
        if !is_name(name) {
            return Err(format!("parameter {at} is no name: {name:?}"));
        }
        Ok(path(&self.resolve(name)))
    }

    pub(super) fn key(&self, at: usize) -> Result<Vec<String>, String> {
        let key = self.text(at)?;
        if !is_name(key) {
            return Err(format!("parameter {at} is no key: {key:?}"));
        }
        Ok(self.resolve(key))
    }

    /// As the caller means it: private, in its namespace, or global.
    fn resolve(&self, name: &str) -> Vec<String> {
        let mut resolved = match name.as_bytes().first() {
            Some(b'/') => Vec::new(),
            _ => parts(self.caller),
        };
        match name.strip_prefix('~') {
            Some(private) => resolved.extend(parts(private)),
            None => {
                resolved.pop();
                resolved.extend(parts(name));
            }
        }
        resolved
    }

    pub(super) fn address(&self, at: usize) -> Result<&'a str, String> {
        let address = self.text(at)?;
        let there = address.split_once("://").is_some_and(|(_, rest)| !rest.is_empty());
        if there { Ok(address) } else { Err(format!("parameter {at} is no address: {address:?}")) }
    }
}

/// A call among several.
pub(super) fn one_of_many(call: &Value) -> Option<Call> {
    let Value::Struct(members) = call else { return None };
    let member = |name| members.iter().find(|(n, _)| n == name).map(|(_, value)| value);
    let method = member("methodName")?.as_str()?.to_owned();
    Some(Call { method, params: member("params")?.as_array()?.to_vec() })
}

/// Something that can stand in a list of names: what people write is not more, and what rosmaster takes is not less.
fn is_name(text: &str) -> bool {
    !text.is_empty()
        && text.len() <= LONGEST
        && !text.contains(|c: char| c.is_whitespace() || c.is_control() || c == ':')
}

pub(super) fn parts(name: &str) -> Vec<String> {
    name.split('/').filter(|part| !part.is_empty()).map(str::to_owned).collect()
}

pub(super) fn path(parts: &[String]) -> String {
    format!("/{}", parts.join("/"))
}
