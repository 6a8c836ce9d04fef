//! Lease tokens: who is newer than whom. The rules are those of Spot's lease service.

use std::cmp::Ordering;
use std::fmt;
use std::str::FromStr;

use muster_api::id::Epoch;
use serde::{Deserialize, Serialize};

/// Longest chain of delegates. A chain is people and programs that hand on a robot; nobody needs more.
pub const DEEPEST: usize = 16;

/// The right to one conflict group of one robot, as a fencing token: `epoch[,number…]`.
///
/// The epoch is the controller's grant and only grows. Whoever delegates appends a number; a holder of `6` drives with
/// `6,0`, delegates `6,1` and takes back with `6,2`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Token {
    /// The controller's grant.
    pub epoch: Epoch,
    /// What delegates appended.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sequence: Vec<u32>,
}

/// How one token stands to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Relation {
    /// They are equal.
    Same,
    /// It begins as the other does and goes on: a right that was handed on under the other.
    Sub,
    /// The other begins as it does and goes on.
    Super,
    /// The first number that differs is greater.
    Newer,
    /// The first number that differs is smaller.
    Older,
}

impl Token {
    /// The grant itself.
    #[must_use]
    pub fn root(epoch: Epoch) -> Token {
        Token { epoch, sequence: Vec::new() }
    }

    /// How this token stands to `other`.
    #[must_use]
    pub fn relation(&self, other: &Token) -> Relation {
        let differs = self.epoch.cmp(&other.epoch).then_with(|| {
            let mut pairs = self.sequence.iter().zip(&other.sequence);
            pairs.find_map(|(a, b)| (a != b).then(|| a.cmp(b))).unwrap_or(Ordering::Equal)
        });
        match (differs, self.sequence.len().cmp(&other.sequence.len())) {
            (Ordering::Greater, _) => Relation::Newer,
            (Ordering::Less, _) => Relation::Older,
            (Ordering::Equal, Ordering::Equal) => Relation::Same,
            (Ordering::Equal, Ordering::Greater) => Relation::Sub,
            (Ordering::Equal, Ordering::Less) => Relation::Super,
        }
    }

    /// It is `root` or was handed on under it.
    #[must_use]
    pub fn is_under(&self, root: &Token) -> bool {
        matches!(self.relation(root), Relation::Same | Relation::Sub)
    }
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.epoch.0)?;
        self.sequence.iter().try_for_each(|number| write!(f, ",{number}"))
    }
}

/// Why a text is no token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenError(String);

impl fmt::Display for TokenError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:?} is no lease token; EPOCH or EPOCH,NUMBER,… with at most {DEEPEST} numbers",
            self.0
        )
    }
}

impl std::error::Error for TokenError {}

impl FromStr for Token {
    type Err = TokenError;

    fn from_str(text: &str) -> Result<Token, TokenError> {
        let refused = || TokenError(text.chars().take(80).collect());
        let mut numbers = text.split(',');
        let epoch = numbers.next().and_then(|n| n.parse().ok()).ok_or_else(refused)?;
        let sequence: Option<Vec<u32>> = numbers.map(|n| n.parse().ok()).collect();
        let sequence = sequence.filter(|s| s.len() <= DEEPEST).ok_or_else(refused)?;
        Ok(Token { epoch: Epoch(epoch), sequence })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn relation(a: &str, b: &str) -> Relation {
        let token = |text: &str| text.parse::<Token>().unwrap();
        token(a).relation(&token(b))
    }

    #[test]
    fn the_first_number_that_differs_decides() {
        assert_eq!(relation("6,1", "5,13"), Relation::Newer);
        assert_eq!(relation("5,13", "6,1"), Relation::Older);
        assert_eq!(relation("6", "6"), Relation::Same);
        assert_eq!(relation("6,0", "6"), Relation::Sub);
        assert_eq!(relation("6", "6,0"), Relation::Super);
        assert_eq!(relation("6,2", "6,1,9"), Relation::Newer);
        assert_eq!(relation("6,1,9", "6,2"), Relation::Older);
    }

    #[test]
    fn there_and_back() {
        for text in ["6", "6,0", "18446744073709551615,1,2"] {
            assert_eq!(text.parse::<Token>().unwrap().to_string(), text);
        }
        for text in ["", "a", "6,", "6,-1", "-1", &format!("6{}", ",1".repeat(DEEPEST + 1))] {
            assert!(text.parse::<Token>().is_err(), "{text}");
        }
    }
}
