//! Reading calls and answers.

use quick_xml::Reader;
use quick_xml::events::{BytesRef, Event};

use super::{Answer, Call, Fault, Value};

/// Values within values: parameter trees of real robots are six or seven deep.
pub const DEEPEST: usize = 64;

/// Why a text is no call or answer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Malformed {
    /// It is no XML.
    #[error("no XML: {0}")]
    Xml(String),
    /// An element stands where another should, or text.
    #[error("{found} where {wanted} should be")]
    Unexpected {
        /// What is there.
        found: String,
        /// What should be.
        wanted: &'static str,
    },
    /// A number is none.
    #[error("{text:?} is no {kind}")]
    Scalar {
        /// `int`.
        kind: &'static str,
        /// What is written.
        text: String,
    },
    /// Arrays or structs stand too deep in each other.
    #[error("values are more than {DEEPEST} deep in each other")]
    Deep,
    /// It has a document type.
    #[error("a document type is not taken")]
    DocType,
}

/// Reads a `methodCall`.
///
/// # Errors
///
/// It is none.
pub fn call(text: &str) -> Result<Call, Malformed> {
    let mut document = Document::new(text);
    document.enter("methodCall")?;
    document.enter("methodName")?;
    let method = document.text("methodName")?.trim().to_owned();
    let mut params = Vec::new();
    match document.next()? {
        Part::Open(name) if name == "params" => params = document.params()?,
        Part::Close(_) => return Ok(Call { method, params }),
        other => return Err(other.instead("params")),
    }
    document.leave("methodCall")?;
    Ok(Call { method, params })
}

/// Reads a `methodResponse`.
///
/// # Errors
///
/// It is none.
pub fn answer(text: &str) -> Result<Answer, Malformed> {
    let mut document = Document::new(text);
    document.enter("methodResponse")?;
    let answer = match document.next()? {
        Part::Open(name) if name == "params" => {
            let mut params = document.params()?;
            let wanted = "one param";
            let found = format!("{} params", params.len());
            if params.len() != 1 {
                return Err(Malformed::Unexpected { found, wanted });
            }
            Ok(params.remove(0))
        }
        Part::Open(name) if name == "fault" => {
            document.enter("value")?;
            let value = document.value(0)?;
            document.leave("fault")?;
            Err(fault(&value))
        }
        other => return Err(other.instead("params or fault")),
    };
    document.leave("methodResponse")?;
    Ok(answer)
}

fn fault(value: &Value) -> Fault {
    let fields = if let Value::Struct(fields) = value { &fields[..] } else { &[] };
    let field = |name: &str| fields.iter().find(|(n, _)| n == name).map(|(_, value)| value);
    Fault {
        code: field("faultCode").and_then(Value::as_int).unwrap_or(0),
        text: field("faultString").and_then(Value::as_str).unwrap_or_default().to_owned(),
    }
}

/// The parts of a document that matter: tags, and text that is not between tags for looks only.
enum Part {
    Open(String),
    Close(String),
    Text(String),
    End,
}

impl Part {
    fn instead(&self, wanted: &'static str) -> Malformed {
        let found = match self {
            Part::Open(name) => format!("<{name}>"),
            Part::Close(name) => format!("</{name}>"),
            Part::Text(_) => "text".to_owned(),
            Part::End => "the end".to_owned(),
        };
        Malformed::Unexpected { found, wanted }
    }
}

struct Document<'a> {
    reader: Reader<&'a [u8]>,
    /// Read, and put back.
    next: Option<Part>,
}

impl<'a> Document<'a> {
    fn new(text: &'a str) -> Self {
        let mut reader = Reader::from_str(text);
        reader.config_mut().expand_empty_elements = true;
        Document { reader, next: None }
    }

    /// The next tag or text; text of white space only counts where `blank` is true.
    fn part(&mut self, blank: bool) -> Result<Part, Malformed> {
        if let Some(part) = self.next.take() {
            return Ok(part);
        }
        let mut text = String::new();
        loop {
            let part = match self.reader.read_event().map_err(|e| Malformed::Xml(e.to_string()))? {
                Event::Start(tag) => Part::Open(tag.local_name().as_ref().to_owned()),
                Event::End(tag) => Part::Close(tag.local_name().as_ref().to_owned()),
                Event::Eof => Part::End,
                Event::Text(more) => {
                    text.push_str(&more.xml10_content());
                    continue;
                }
                Event::CData(more) => {
                    text.push_str(&more.xml10_content());
                    continue;
                }
                Event::GeneralRef(entity) => {
                    text.push(resolve(&entity)?);
                    continue;
                }
                Event::DocType(_) => return Err(Malformed::DocType),
                Event::Decl(_) | Event::PI(_) | Event::Comment(_) => continue,
                Event::Empty(_) => unreachable!("empty elements are expanded"),
            };
            if text.is_empty() || (!blank && text.trim().is_empty()) {
                return Ok(part);
            }
            self.next = Some(part);
            return Ok(Part::Text(text));
        }
    }

    fn next(&mut self) -> Result<Part, Malformed> {
        self.part(false)
    }

    fn enter(&mut self, name: &'static str) -> Result<(), Malformed> {
        match self.next()? {
            Part::Open(found) if found == name => Ok(()),
            other => Err(other.instead(name)),
        }
    }

    fn leave(&mut self, name: &'static str) -> Result<(), Malformed> {
        match self.next()? {
            Part::Close(found) if found == name => Ok(()),
            other => Err(other.instead(name)),
        }
    }

    /// All text up to the end tag of `name`.
    fn text(&mut self, name: &'static str) -> Result<String, Malformed> {
        let text = match self.part(true)? {
            Part::Text(text) => text,
            Part::Close(found) if found == name => return Ok(String::new()),
            other => return Err(other.instead("text")),
        };
        self.leave(name)?;
        Ok(text)
    }

    /// Within `params`, up to its end.
    fn params(&mut self) -> Result<Vec<Value>, Malformed> {
        let mut params = Vec::new();
        loop {
            match self.next()? {
                Part::Open(name) if name == "param" => {
                    self.enter("value")?;
                    params.push(self.value(0)?);
                    self.leave("param")?;
                }
                Part::Close(_) => return Ok(params),
                other => return Err(other.instead("param")),
            }
        }
    }

    /// Within `value`, up to its end.
    fn value(&mut self, depth: usize) -> Result<Value, Malformed> {
        if depth > DEEPEST {
            return Err(Malformed::Deep);
        }
        let value = match self.part(true)? {
            Part::Close(_) => return Ok(Value::String(String::new())),
            Part::Text(text) => match self.next()? {
                Part::Close(_) => return Ok(Value::String(text)),
                // White space around the type's tag.
                Part::Open(kind) if text.trim().is_empty() => self.typed(&kind, depth)?,
                other => return Err(other.instead("the end of the value")),
            },
            Part::Open(kind) => self.typed(&kind, depth)?,
            Part::End => return Err(Part::End.instead("a value")),
        };
        self.leave("value")?;
        Ok(value)
    }

    fn typed(&mut self, kind: &str, depth: usize) -> Result<Value, Malformed> {
        let scalar =
            |kind, text: &str| Malformed::Scalar { kind, text: text.chars().take(40).collect() };
        Ok(match kind {
            "int" | "i4" => {
                let text = self.text(if kind == "int" { "int" } else { "i4" })?;
                Value::Int(text.trim().parse().map_err(|_| scalar("int", &text))?)
            }
            "boolean" => {
                let text = self.text("boolean")?;
                match text.trim() {
                    "0" => Value::Bool(false),
                    "1" => Value::Bool(true),
                    _ => return Err(scalar("boolean", &text)),
                }
            }
            "double" => {
                let text = self.text("double")?;
                Value::Double(text.trim().parse().map_err(|_| scalar("double", &text))?)
            }
            "string" => Value::String(self.text("string")?),
            "dateTime.iso8601" => Value::DateTime(self.text("dateTime.iso8601")?),
            "base64" => Value::Base64(self.text("base64")?),
            "array" => Value::Array(self.array(depth)?),
            "struct" => Value::Struct(self.members(depth)?),
            other => {
                let found = format!("<{other}>");
                return Err(Malformed::Unexpected { found, wanted: "a type of value" });
            }
        })
    }

    fn array(&mut self, depth: usize) -> Result<Vec<Value>, Malformed> {
        self.enter("data")?;
        let mut values = Vec::new();
        loop {
            match self.next()? {
                Part::Open(name) if name == "value" => values.push(self.value(depth + 1)?),
                Part::Close(_) => break,
                other => return Err(other.instead("value")),
            }
        }
        self.leave("array")?;
        Ok(values)
    }

    fn members(&mut self, depth: usize) -> Result<Vec<(String, Value)>, Malformed> {
        let mut members = Vec::new();
        loop {
            match self.next()? {
                Part::Open(name) if name == "member" => {
                    self.enter("name")?;
                    let name = self.text("name")?;
                    self.enter("value")?;
                    members.push((name, self.value(depth + 1)?));
                    self.leave("member")?;
                }
                Part::Close(_) => return Ok(members),
                other => return Err(other.instead("member")),
            }
        }
    }
}

fn resolve(entity: &BytesRef<'_>) -> Result<char, Malformed> {
    let char = entity.resolve_char_ref().map_err(|e| Malformed::Xml(e.to_string()))?;
    let known = || match &*entity.xml10_content() {
        "lt" => Some('<'),
        "gt" => Some('>'),
        "amp" => Some('&'),
        "quot" => Some('"'),
        "apos" => Some('\''),
        _ => None,
    };
    char.or_else(known)
        .ok_or_else(|| Malformed::Xml(format!("&{}; is not known", entity.xml10_content())))
}
