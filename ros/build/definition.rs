//! Message definitions: `TYPE NAME`, `TYPE NAME=VALUE`, arrays `TYPE[]` and `TYPE[N]`, as on wiki.ros.org/msg.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use md5::{Digest, Md5};

/// What a field's elements are.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Base {
    /// `bool`, `uint8`, `string`, `time` …
    Builtin(&'static str),
    /// Another message, `geometry_msgs/Pose`.
    Message { package: String, name: String },
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Shape {
    One,
    Many,
    Fixed(usize),
}

#[derive(Debug, Clone)]
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) base: Base,
    pub(crate) shape: Shape,
    /// As written, for the checksum.
    written: String,
}

#[derive(Debug, Clone)]
pub(crate) struct Constant {
    pub(crate) name: String,
    pub(crate) base: &'static str,
    pub(crate) value: String,
}

#[derive(Debug, Clone)]
pub(crate) struct Definition {
    pub(crate) package: String,
    pub(crate) name: String,
    pub(crate) text: String,
    pub(crate) fields: Vec<Field>,
    pub(crate) constants: Vec<Constant>,
}

pub(crate) struct Definitions(BTreeMap<(String, String), Definition>);

const BUILTIN: [&str; 16] = [
    "bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32",
    "float64", "string", "time", "duration", "char", "byte",
];

fn builtin(name: &str) -> Option<&'static str> {
    BUILTIN.into_iter().find(|b| *b == name)
}

impl Definitions {
    pub(crate) fn read(dir: &Path) -> io::Result<Self> {
        let mut all = BTreeMap::new();
        for package in fs::read_dir(dir)?.collect::<io::Result<Vec<_>>>()? {
            if !package.file_type()?.is_dir() {
                continue;
            }
            for file in fs::read_dir(package.path())?.collect::<io::Result<Vec<_>>>()? {
                let path = file.path();
                let (Some(name), Some("msg")) = (
                    path.file_stem().and_then(|s| s.to_str()),
                    path.extension().and_then(|s| s.to_str()),
                ) else {
                    continue;
                };
                let package = package.file_name().to_string_lossy().into_owned();
                let text = fs::read_to_string(&path)?;
                let one = Definition::parse(&package, name, &text).ok_or_else(|| {
                    io::Error::other(format!("{} is no definition", path.display()))
                })?;
                all.insert((package, name.to_owned()), one);
            }
        }
        Ok(Definitions(all))
    }

    pub(crate) fn packages(&self) -> impl Iterator<Item = &str> {
        let mut last = "";
        self.0.keys().filter_map(move |(package, _)| {
            (std::mem::replace(&mut last, package) != package).then_some(package.as_str())
        })
    }

    pub(crate) fn of<'a>(&'a self, package: &'a str) -> impl Iterator<Item = &'a Definition> {
        self.0.values().filter(move |d| d.package == package)
    }

    fn get(&self, package: &str, name: &str) -> &Definition {
        self.0
            .get(&(package.to_owned(), name.to_owned()))
            .unwrap_or_else(|| panic!("msgs/{package}/{name}.msg is missing"))
    }

    /// The checksum as `rosmsg md5` gives it: constants first, types of fields that are messages replaced by theirs.
    pub(crate) fn md5(&self, definition: &Definition) -> String {
        let mut lines: Vec<String> = definition
            .constants
            .iter()
            .map(|c| format!("{} {}={}", c.base, c.name, c.value))
            .collect();
        lines.extend(definition.fields.iter().map(|field| match &field.base {
            Base::Builtin(_) => format!("{} {}", field.written, field.name),
            Base::Message { package, name } => {
                format!("{} {}", self.md5(self.get(package, name)), field.name)
            }
        }));
        let hash = Md5::digest(lines.join("\n").as_bytes());
        hash.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// The text with those of all messages in it, as a publisher sends it.
    pub(crate) fn full_text(&self, definition: &Definition) -> String {
        let mut seen = Vec::new();
        self.collect(definition, &mut seen);
        let mut text = definition.text.clone();
        for (package, name) in seen {
            let rule = "=".repeat(80);
            text.push_str(&format!(
                "\n{rule}\nMSG: {package}/{name}\n{}",
                self.get(&package, &name).text
            ));
        }
        text
    }

    fn collect(&self, definition: &Definition, seen: &mut Vec<(String, String)>) {
        for field in &definition.fields {
            let Base::Message { package, name } = &field.base else { continue };
            let key = (package.clone(), name.clone());
            if !seen.contains(&key) {
                seen.push(key);
                self.collect(self.get(package, name), seen);
            }
        }
    }
}

impl Definition {
    fn parse(package: &str, name: &str, text: &str) -> Option<Self> {
        let (mut fields, mut constants) = (Vec::new(), Vec::new());
        for line in text.lines() {
            let line = line.split('#').next()?.trim();
            if line.is_empty() {
                continue;
            }
            let (written, rest) = line.split_once(char::is_whitespace)?;
            if let Some((name, value)) = rest.split_once('=') {
                let (name, value) = (name.trim().to_owned(), value.trim().to_owned());
                constants.push(Constant { name, base: builtin(written)?, value });
                continue;
            }
            let (base, shape) = match written.split_once('[') {
                None => (written, Shape::One),
                Some((base, "]")) => (base, Shape::Many),
                Some((base, size)) => (base, Shape::Fixed(size.strip_suffix(']')?.parse().ok()?)),
            };
            let base = match (builtin(base), base.split_once('/')) {
                (Some(builtin), _) => Base::Builtin(builtin),
                (None, Some((package, name))) => {
                    Base::Message { package: package.to_owned(), name: name.to_owned() }
                }
                (None, None) if base == "Header" => {
                    Base::Message { package: "std_msgs".to_owned(), name: "Header".to_owned() }
                }
                (None, None) => {
                    Base::Message { package: package.to_owned(), name: base.to_owned() }
                }
            };
            fields.push(Field {
                name: rest.trim().to_owned(),
                base,
                shape,
                written: written.to_owned(),
            });
        }
        Some(Definition {
            package: package.to_owned(),
            name: name.to_owned(),
            text: text.to_owned(),
            fields,
            constants,
        })
    }
}

impl Field {
    /// The field's name in Rust and in protobuf.
    pub(crate) fn ident(&self) -> String {
        let lower = self.name.to_lowercase();
        if lower == "type" { "type_".to_owned() } else { lower }
    }

    /// `uint8[]`, `char[]`: kept as bytes of the received message.
    pub(crate) fn is_bytes(&self) -> bool {
        self.shape == Shape::Many && matches!(self.base, Base::Builtin("uint8" | "char"))
    }
}
