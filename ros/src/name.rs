//! Names in the graph: `global`, `relative`, `~private`, and how they become global ones (wiki.ros.org/Names).

use std::collections::BTreeMap;

/// Why a text is no name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no ROS name; write letters, digits, _ and / that begin with a letter, / or ~, as in /robot1/odom"
)]
pub struct NameError(pub String);

/// A text as part of a name: what names do not have, as the dashes and dots of other names, is `_`.
#[must_use]
pub fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
}

/// A name may not be longer than anything that people write.
const LONGEST: usize = 512;

fn check(text: &str) -> Result<(), NameError> {
    let parts = text.strip_prefix(['/', '~']).unwrap_or(text);
    let part = |part: &str| {
        let mut chars = part.chars();
        chars.next().is_some_and(|first| first.is_ascii_alphabetic() || first == '_')
            && chars.all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    let good = text.len() <= LONGEST
        && (text == "/" || parts.trim_start_matches('/').split('/').all(part));
    if good { Ok(()) } else { Err(NameError(text.to_owned())) }
}

/// Where a node's names are resolved: its namespace, its own name, and what its names are replaced by.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Resolver {
    /// With a slash at both ends.
    namespace: String,
    node: String,
    /// Global names only.
    remapped: BTreeMap<String, String>,
}

impl Resolver {
    /// Of a node `node` in `namespace` (`/` or empty: the root), with remapping rules as they stand on ROS command
    /// lines, `FROM:=TO`.
    ///
    /// # Errors
    ///
    /// One of the names is none.
    pub fn new<'a>(
        namespace: &str,
        node: &str,
        rules: impl IntoIterator<Item = (&'a str, &'a str)>,
    ) -> Result<Self, NameError> {
        let trimmed = namespace.trim_matches('/');
        let namespace = if trimmed.is_empty() { "/".to_owned() } else { format!("/{trimmed}/") };
        check(&namespace[..namespace.len().max(2) - 1])?;
        if node.contains(['/', '~']) {
            return Err(NameError(node.to_owned()));
        }
        check(node)?;
        let mut resolver =
            Resolver { node: format!("{namespace}{node}"), namespace, remapped: BTreeMap::new() };
        let rules = rules.into_iter().map(|(from, to)| {
            // Parameters (`_rate:=5`) and special keys (`__name:=x`) are no rules of names.
            Ok((resolver.global(from)?, resolver.global(to)?))
        });
        resolver.remapped = rules.collect::<Result<_, NameError>>()?;
        Ok(resolver)
    }

    /// The node's own global name.
    #[must_use]
    pub fn node(&self) -> &str {
        &self.node
    }

    /// The global name, remapped. Rules apply to resolved names, as ROS's own clients have it.
    ///
    /// # Errors
    ///
    /// It is no name.
    pub fn resolve(&self, name: &str) -> Result<String, NameError> {
        let global = self.global(name)?;
        Ok(self.remapped.get(&global).cloned().unwrap_or(global))
    }

    fn global(&self, name: &str) -> Result<String, NameError> {
        check(name)?;
        let joined = if let Some(private) = name.strip_prefix('~') {
            format!("{}/{private}", self.node)
        } else if name.starts_with('/') {
            name.to_owned()
        } else {
            format!("{}{name}", self.namespace)
        };
        let parts: Vec<&str> = joined.split('/').filter(|part| !part.is_empty()).collect();
        Ok(format!("/{}", parts.join("/")))
    }
}

/// The rules among a command line's arguments, `FROM:=TO`; `__name:=x` and `_param:=5` are none.
pub fn rules<'a>(
    arguments: impl IntoIterator<Item = &'a str>,
) -> impl Iterator<Item = (&'a str, &'a str)> {
    let split = arguments.into_iter().filter_map(|argument| argument.split_once(":="));
    split.filter(|(from, _)| !from.starts_with('_'))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The table of wiki.ros.org/Names.
    #[test]
    fn names_resolve_as_ros_documents_it() {
        let cases = [
            ("/", "node1", "bar", "/bar"),
            ("/wg", "node2", "bar", "/wg/bar"),
            ("/wg/", "node3", "foo/bar", "/wg/foo/bar"),
            ("", "node1", "/bar", "/bar"),
            ("/wg", "node2", "/foo/bar", "/foo/bar"),
            ("/", "node1", "~bar", "/node1/bar"),
            ("wg", "node2", "~bar", "/wg/node2/bar"),
            ("/wg", "node3", "~foo/bar", "/wg/node3/foo/bar"),
        ];
        for (namespace, node, name, expected) in cases {
            let resolver = Resolver::new(namespace, node, []).unwrap();
            assert_eq!(resolver.resolve(name).unwrap(), expected, "{namespace} {node} {name}");
        }
    }

    #[test]
    fn rules_replace_resolved_names() {
        let arguments =
            ["--x", "odom:=base/odom", "/scan:=front", "__name:=n", "_rate:=5", "plain"];
        let resolver = Resolver::new("/r1", "n", rules(arguments)).unwrap();
        assert_eq!(resolver.resolve("odom").unwrap(), "/r1/base/odom");
        assert_eq!(resolver.resolve("/r1/odom").unwrap(), "/r1/base/odom");
        assert_eq!(resolver.resolve("/scan").unwrap(), "/r1/front");
        assert_eq!(resolver.resolve("scan").unwrap(), "/r1/scan");
    }

    #[test]
    fn what_is_no_name_is_refused() {
        let resolver = Resolver::new("/", "n", []).unwrap();
        let long = "a".repeat(LONGEST + 1);
        for bad in ["", "1a", "a b", "a/1b", "/a/", "ä", "a~b", &long] {
            assert!(resolver.resolve(bad).is_err(), "{bad:?}");
        }
        assert!(Resolver::new("/", "a/b", []).is_err());
        assert!(Resolver::new("/a b", "n", []).is_err());
    }
}
