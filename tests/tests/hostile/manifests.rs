use std::path::{Path, PathBuf};

use muster_api::kind;
use muster_api::manifest;

fn manifests(dir: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../manifests").join(dir)
}

#[test]
fn manifests_are_read_or_refused_at_a_place() {
    let inputs = muster_hostile::inputs("manifests").and_those_in(&manifests("examples"));
    let inputs = inputs.and_those_in(&manifests("invalid")).and_those_in(&manifests("lab"));
    muster_hostile::feed(bolero::check!(), inputs, |bytes| check(&String::from_utf8_lossy(bytes)));
}

fn check(text: &str) {
    let documents = match manifest::parse("m.yaml", text) {
        Ok(documents) => documents,
        Err(error) => return said(&error, text),
    };
    for document in documents {
        match document.admit() {
            Err(error) => said(&error, text),
            // Admitted once, it stays so: defaults are filled in once.
            Ok(object) => match kind::admit(&object) {
                Ok(again) => assert_eq!(again, object),
                Err(violations) => panic!("{object:#} is not admitted again: {violations:?}"),
            },
        }
    }
}

/// Every complaint has a place in the text, and words.
fn said(error: &manifest::ManifestError, text: &str) {
    assert!(!error.0.is_empty());
    let lines = text.split(['\n', '\r']).count() + 1;
    for diagnostic in &error.0 {
        let at = diagnostic.location;
        assert!((1..=lines).contains(&at.line) && at.column >= 1, "{at:?} of {lines} lines");
        assert!(!diagnostic.violation.message().is_empty());
    }
}
