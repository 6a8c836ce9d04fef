//! Why a message cannot be taken for what it says it is.

/// A message that does not mean anything.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// A field that must be there is not.
    #[error("{0} is missing")]
    Missing(&'static str),
    /// An enum's zero value, or one that this version does not know.
    #[error("{field} has the value {value}, which this version does not know")]
    UnknownEnum {
        /// The field.
        field: &'static str,
        /// The number on the wire.
        value: i32,
    },
    /// A value that cannot be right.
    #[error("{field}: {reason}")]
    Invalid {
        /// The field.
        field: &'static str,
        /// What is wrong.
        reason: String,
    },
}

impl WireError {
    /// A value that cannot be right.
    pub fn invalid(field: &'static str, reason: impl ToString) -> Self {
        WireError::Invalid { field, reason: reason.to_string() }
    }
}
