//! Every broken manifest in manifests/invalid against its golden error text: place, field, reason and
//! suggestion. `UPDATE_GOLDEN=1` writes what is found instead, for a person to read in the diff.

use std::fs;
use std::path::{Path, PathBuf};

use muster_api::manifest::parse;

fn manifests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../manifests")
}

fn yaml_files(dir: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in fs::read_dir(dir).expect("a directory of the tree").flatten() {
        let path = entry.path();
        if path.is_dir() {
            files.extend(yaml_files(&path));
        } else if path.extension().is_some_and(|e| e == "yaml") {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// What a user is told about a file.
fn errors(path: &Path) -> String {
    let name = path.file_name().expect("a file").to_string_lossy();
    let text = fs::read_to_string(path).expect("readable");
    let documents = match parse(&name, &text) {
        Ok(documents) => documents,
        Err(error) => return format!("{error}\n"),
    };
    documents.iter().filter_map(|d| d.admit().err()).map(|e| format!("{e}\n")).collect()
}

#[test]
fn broken_manifests_are_refused_with_place_field_reason_and_suggestion() {
    let files = yaml_files(&manifests().join("invalid"));
    assert!(files.len() >= 12, "{}", files.len());
    for file in files {
        let found = errors(&file);
        let golden = file.with_extension("txt");
        if std::env::var_os("UPDATE_GOLDEN").is_some() {
            fs::write(&golden, &found).expect("the tree is writable");
        }
        let expected = fs::read_to_string(&golden).unwrap_or_default();
        assert!(!found.is_empty(), "{} is not refused", file.display());
        assert_eq!(found, expected, "{}", file.display());
    }
}

#[test]
fn every_example_is_admitted() {
    let files = yaml_files(&manifests().join("examples"));
    assert!(!files.is_empty());
    for file in files {
        assert_eq!(errors(&file), "", "{}", file.display());
    }
}
