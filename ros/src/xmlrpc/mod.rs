//! XML-RPC as ROS speaks it. `read` and `write` are pure; `http` carries them.
//!
//! Whoever reaches the port may say anything: sizes, depth and times are bounded, and a document type (with the entities
//! it could define) is refused.

pub mod http;
mod read;
mod write;

pub use read::{DEEPEST, Malformed, answer, call};
pub use write::{write_answer, write_call};

/// A value.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// `int`, `i4`.
    Int(i32),
    /// `boolean`.
    Bool(bool),
    /// `string`, or no type at all.
    String(String),
    /// `double`.
    Double(f64),
    /// `dateTime.iso8601`, as it is written.
    DateTime(String),
    /// `base64`, as it is written.
    Base64(String),
    /// `array`.
    Array(Vec<Value>),
    /// `struct`, in its order.
    Struct(Vec<(String, Value)>),
}

impl Value {
    /// Its text, of a string.
    #[must_use]
    pub fn as_str(&self) -> Option<&str> {
        if let Value::String(text) = self { Some(text) } else { None }
    }

    /// Its number, of an int or a boolean.
    #[must_use]
    pub fn as_int(&self) -> Option<i32> {
        match self {
            Value::Int(number) => Some(*number),
            Value::Bool(yes) => Some(i32::from(*yes)),
            _ => None,
        }
    }

    /// Its elements, of an array.
    #[must_use]
    pub fn as_array(&self) -> Option<&[Value]> {
        if let Value::Array(values) = self { Some(values) } else { None }
    }

    /// The strings of an array of them; others in it are left out.
    #[must_use]
    pub fn strings(&self) -> Vec<String> {
        let values = self.as_array().unwrap_or_default().iter();
        values.filter_map(Value::as_str).map(str::to_owned).collect()
    }
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Value::String(text.to_owned())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Value::String(text)
    }
}

impl From<i32> for Value {
    fn from(number: i32) -> Self {
        Value::Int(number)
    }
}

impl From<bool> for Value {
    fn from(yes: bool) -> Self {
        Value::Bool(yes)
    }
}

impl From<f64> for Value {
    fn from(number: f64) -> Self {
        Value::Double(number)
    }
}

impl From<Vec<Value>> for Value {
    fn from(values: Vec<Value>) -> Self {
        Value::Array(values)
    }
}

/// A request.
#[derive(Debug, Clone, PartialEq)]
pub struct Call {
    /// `registerSubscriber`.
    pub method: String,
    /// In order.
    pub params: Vec<Value>,
}

/// What is answered instead of a value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("fault {code}: {text}")]
pub struct Fault {
    /// The server's own number.
    pub code: i32,
    /// Why.
    pub text: String,
}

/// A response.
pub type Answer = Result<Value, Fault>;
