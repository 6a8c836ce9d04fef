//! What the words of a command line name: `task/x`, `tk x y`, `nodes,leases`, `all`.

use muster_api::kind::{self, KindInfo, find_by_word};
use muster_api::validate::did_you_mean;

use crate::error::CliError;

/// A kind, or one object of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Named<'a> {
    pub(crate) info: &'static KindInfo,
    pub(crate) name: Option<&'a str>,
}

impl PartialEq for Named<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.info.kind == other.info.kind && self.name == other.name
    }
}

/// What `all` means: what people put there or look after. Events would drown the rest.
const ALL: [&str; 4] = ["Node", "Task", "TaskSet", "Lease"];

/// The kind that a word means.
pub(crate) fn kind(word: &str) -> Result<&'static KindInfo, CliError> {
    // `tasks.muster.dev`, as kubectl prints names, is understood too.
    let bare = word.strip_suffix(&format!(".{}", muster_api::GROUP)).unwrap_or(word);
    find_by_word(bare).ok_or_else(|| {
        let known = kind::ALL.iter().flat_map(|i| [i.plural, i.singular]);
        let kinds: Vec<&str> = kind::ALL.iter().map(|i| i.plural).collect();
        CliError::Usage {
            message: format!("there is no kind {word:?}"),
            hint: did_you_mean(bare, known)
                .or_else(|| Some(format!("kinds: {}", kinds.join(", ")))),
        }
    })
}

fn kinds(word: &str) -> Result<Vec<&'static KindInfo>, CliError> {
    if word == "all" {
        return Ok(kind::ALL.iter().filter(|i| ALL.contains(&i.kind)).collect());
    }
    word.split(',').filter(|w| !w.is_empty()).map(kind).collect()
}

/// Reads `KIND[,KIND…] [NAME…]` or `KIND/NAME…`.
pub(crate) fn parse(words: &[String]) -> Result<Vec<Named<'_>>, CliError> {
    let Some((first, names)) = words.split_first() else {
        return Err(CliError::Usage {
            message: "say which kind of object is meant".to_owned(),
            hint: Some("for example `muster get tasks` or `muster get task/gmapping`".to_owned()),
        });
    };
    if words.iter().any(|w| w.contains('/')) {
        return words.iter().map(|w| pair(w)).collect();
    }
    let kinds = kinds(first)?;
    if names.is_empty() {
        return Ok(kinds.into_iter().map(|info| Named { info, name: None }).collect());
    }
    if first == "all" {
        return Err(CliError::usage("`all` goes with no names; name a kind"));
    }
    let of_kind = |info| names.iter().map(move |name| Named { info, name: Some(name.as_str()) });
    Ok(kinds.into_iter().flat_map(of_kind).collect())
}

fn pair(word: &str) -> Result<Named<'_>, CliError> {
    match word.split_once('/') {
        Some((of, name)) if !of.is_empty() && !name.is_empty() && !name.contains('/') => {
            Ok(Named { info: kind(of)?, name: Some(name) })
        }
        _ => Err(CliError::Usage {
            message: format!("{word:?} is not KIND/NAME"),
            hint: Some(
                "either every word is KIND/NAME, or the first is a kind and the rest are names"
                    .to_owned(),
            ),
        }),
    }
}

/// Reads a word that names one object of a kind that is known, `x` or `task/x`.
pub(crate) fn one<'a>(word: &'a str, of: &str) -> Result<Named<'a>, CliError> {
    one_of(word, &[of])
}

/// Reads a word that names one object of some kinds; `x` alone is of the first.
pub(crate) fn one_of<'a>(word: &'a str, kinds: &[&str]) -> Result<Named<'a>, CliError> {
    let wanted = kinds.iter().map(|k| kind(k)).collect::<Result<Vec<_>, _>>()?;
    if let Some(info) = wanted.first().copied().filter(|_| !word.contains('/')) {
        return Ok(Named { info, name: Some(word) });
    }
    let named = pair(word)?;
    if wanted.iter().all(|info| info.kind != named.info.kind) {
        return Err(CliError::usage(format!("{word} is not a {}", kinds.join(" or a "))));
    }
    Ok(named)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(words: &[&str]) -> Result<Vec<String>, String> {
        let words: Vec<String> = words.iter().map(|w| (*w).to_owned()).collect();
        let text = |n: &Named<'_>| format!("{}/{}", n.info.kind, n.name.unwrap_or("*"));
        parse(&words).map(|all| all.iter().map(text).collect()).map_err(|e| e.to_string())
    }

    #[test]
    fn words_name_kinds_and_objects() {
        for (words, expected) in [
            (vec!["tasks"], vec!["Task/*"]),
            (vec!["tk", "x", "y"], vec!["Task/x", "Task/y"]),
            (vec!["task/x", "no/r1"], vec!["Task/x", "Node/r1"]),
            (vec!["nodes,le"], vec!["Node/*", "Lease/*"]),
            (vec!["tasks.muster.dev"], vec!["Task/*"]),
            (vec!["all"], vec!["Node/*", "Task/*", "TaskSet/*", "Lease/*"]),
            (vec!["lease", "r1.body"], vec!["Lease/r1.body"]),
        ] {
            assert_eq!(
                read(&words),
                Ok(expected.into_iter().map(str::to_owned).collect()),
                "{words:?}"
            );
        }
    }

    #[test]
    fn what_names_nothing_is_refused() {
        for words in [
            vec![],
            vec!["pods"],
            vec!["task/"],
            vec!["task/x", "y"],
            vec!["all", "x"],
            vec!["a/b/c"],
        ] {
            read(&words).expect_err("not understood");
        }
        let CliError::Usage { hint, .. } = kind("tsak").expect_err("misspelt") else {
            panic!("not a usage error")
        };
        assert_eq!(hint.as_deref(), Some("did you mean \"task\"?"));
    }

    #[test]
    fn one_object_of_a_known_kind() {
        assert_eq!(one("x", "task").expect("a name").name, Some("x"));
        assert_eq!(one("tk/x", "task").expect("a pair").name, Some("x"));
        one("node/x", "task").expect_err("another kind");
        let kinds = ["task", "framework"];
        assert_eq!(one_of("x", &kinds).expect("a name").info.kind, "Task");
        assert_eq!(one_of("fw/x", &kinds).expect("a pair").info.kind, "Framework");
        let error = one_of("node/x", &kinds).expect_err("a third kind");
        assert_eq!(error.to_string(), "node/x is not a task or a framework");
    }
}
