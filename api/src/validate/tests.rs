use schemars::JsonSchema;
use serde::Deserialize;
use serde_json::json;

use super::*;

#[derive(Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
#[expect(dead_code, reason = "only its schema is used")]
struct Sample {
    cpu: Option<MilliCpu>,
    how: Option<How>,
    tags: Option<Vec<String>>,
    count: u32,
    wait: Option<Span>,
}

#[derive(Deserialize, JsonSchema)]
enum How {
    /// One way.
    Never,
    /// The other.
    Always,
}

fn violations(value: &Value) -> Vec<String> {
    let schema = crate::kind::schema_of::<Sample>();
    let mut found = Violations::new();
    walk_schema(&schema, value, "spec", &mut found);
    found.iter().map(Violation::to_string).collect()
}

#[test]
fn a_value_that_fits_has_no_violations() {
    let full = json!({"cpu": 2, "how": "Never", "tags": ["a"], "count": 1, "wait": "3s"});
    assert_eq!(violations(&full), Vec::<String>::new());
    assert_eq!(violations(&json!({"count": 1, "cpu": null})), Vec::<String>::new());
}

#[test]
fn every_violation_is_found_at_once() {
    let bad = json!({"cpu": "2core", "how": "never", "tags": [1], "cout": 3, "wait": 30});
    assert_eq!(
        violations(&bad),
        [
            "spec.cout: is not a field; did you mean \"count\"?",
            "spec.cpu: \"2core\" is not a quantity of cpu; try \"2\" or \"2000m\"",
            "spec.how: \"never\" is none of \"Never\", \"Always\"; did you mean \"Never\"?",
            "spec.tags[0]: is 1 where a text is expected; put it in quotes: \"1\"",
            "spec.wait: \"30\" is not a duration; try \"30s\"",
            "spec.count: is required",
        ]
    );
}

#[test]
fn no_more_is_told_than_can_be_read() {
    let fields = (0..300_000).map(|i| (format!("unknown{i}"), json!(1)));
    let many = Value::Object(fields.collect());
    let mut found = Violations::new();
    walk_schema(&crate::kind::schema_of::<Sample>(), &many, "spec", &mut found);
    assert!(found.is_full());
    assert_eq!(found.iter().count(), MOST);
    assert!(found.to_string().ends_with("\nand more"));
    let mut more = Violations::new();
    for i in 0..3 * MOST {
        more.invalid(format!("a[{i}]"), "is wrong").suggest("x");
    }
    let mut all = Violations::new();
    all.append(found);
    assert!(all.is_full(), "what was left out stays known");
    all.append(more);
    assert_eq!((all.iter().count(), all.into_iter().count()), (MOST, MOST));
    assert_eq!(did_you_mean(&"n".repeat(LONGEST + 1), ["n"]), None);
}

#[test]
fn numbers_keep_to_their_range() {
    assert_eq!(
        violations(&json!({"count": -1})),
        ["spec.count: -1 is less than the smallest allowed, 0"]
    );
    assert_eq!(
        violations(&json!({"count": 1.5})),
        ["spec.count: is 1.5 where a whole number is expected"]
    );
}
