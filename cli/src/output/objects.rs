//! Objects in the format that `-o` asks for.

use jiff::Timestamp;
use muster_api::kind::KindInfo;
use serde_json::{Value, json};

use super::columns::{self, Layout};
use super::table::Table;
use crate::error::CliError;

/// `-o`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Format {
    /// Columns
    #[default]
    Table,
    /// More columns
    Wide,
    /// YAML
    Yaml,
    /// JSON
    Json,
    /// KIND/NAME, one a line
    Name,
}

/// Objects of one kind.
pub(crate) struct Group {
    pub(crate) info: &'static KindInfo,
    pub(crate) objects: Vec<Value>,
}

/// The table of a group.
pub(crate) fn table(group: &Group, wide: bool, namespaces: bool, kinds: bool) -> Table {
    let layout = Layout { wide, namespaces, kinds, now: Timestamp::now() };
    columns::table(group.info, &group.objects, layout)
}

/// Objects as text in a format for programs. `single`: exactly one object was asked for by name, so
/// it stands for itself instead of in a List.
pub(crate) fn serialize(
    groups: Vec<Group>,
    single: bool,
    format: Format,
) -> Result<String, CliError> {
    if format == Format::Name {
        let names = groups.iter().flat_map(|g| g.objects.iter().map(|o| name_line(g.info, o)));
        return Ok(names.collect());
    }
    let mut objects: Vec<Value> = groups.into_iter().flat_map(|g| g.objects).collect();
    let value = match objects.pop() {
        Some(only) if single && objects.is_empty() => only,
        last => {
            objects.extend(last);
            json!({"apiVersion": "v1", "kind": "List", "metadata": {}, "items": objects})
        }
    };
    document(&value, format)
}

/// One value as YAML or JSON.
pub(crate) fn document(value: &Value, format: Format) -> Result<String, CliError> {
    if format == Format::Yaml {
        return serde_saphyr::to_string(value)
            .map_err(|error| CliError::Output(std::io::Error::other(error)));
    }
    Ok(format!("{value:#}\n"))
}

/// `task/x`.
pub(crate) fn full_name(info: &KindInfo, object: &Value) -> String {
    let name = object.pointer("/metadata/name").and_then(Value::as_str).unwrap_or_default();
    format!("{}/{name}", info.singular)
}

fn name_line(info: &KindInfo, object: &Value) -> String {
    format!("{}\n", full_name(info, object))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(names: &[&str]) -> Vec<Group> {
        let info = muster_api::kind::find_by_word("task").expect("served");
        let object = |name: &&str| json!({"kind": "Task", "metadata": {"name": name}});
        vec![Group { info, objects: names.iter().map(object).collect() }]
    }

    #[test]
    fn one_object_stands_for_itself_and_several_in_a_list() {
        let text = |names, single| serialize(group(names), single, Format::Json).expect("text");
        let read = |text: String| serde_json::from_str::<Value>(&text).expect("JSON");
        assert_eq!(read(text(&["a"], true))["kind"], "Task");
        assert_eq!(read(text(&["a"], false))["items"][0]["metadata"]["name"], "a");
        assert_eq!(read(text(&["a", "b"], true))["items"].as_array().map(Vec::len), Some(2));
        assert_eq!(read(text(&[], false))["items"], json!([]));
    }

    #[test]
    fn names_carry_their_kind() {
        assert_eq!(
            serialize(group(&["a", "b"]), false, Format::Name).expect("text"),
            "task/a\ntask/b\n"
        );
    }

    #[test]
    fn yaml_reads_back_the_same() {
        let value = json!({
            "a": "2", "b": "yes", "c": "line one\nline two\n", "d": ["x", {"e": null}], "f": 1.5,
            "long": "word ".repeat(60), "empty": {}, "none": [], "date": "2026-01-02T03:04:05Z",
            "colon": "a: b", "hash": "a #b", "quote": "it's \"so\"", "neg": -3, "key: odd": "~",
        });
        let text = document(&value, Format::Yaml).expect("YAML");
        let back: Value = serde_saphyr::from_str(&text).expect("readable");
        assert_eq!(back, value, "{text}");
    }
}
