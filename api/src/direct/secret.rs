//! A ticket's secret.

use std::fmt;

use crate::secret::same;

/// Bytes of a secret.
pub const SECRET_BYTES: usize = 32;

/// What shows that somebody may exchange messages with one executor. Not shown in logs.
#[derive(Clone)]
pub struct Secret([u8; SECRET_BYTES]);

impl Secret {
    /// Made of random bytes.
    #[must_use]
    pub fn new(bytes: [u8; SECRET_BYTES]) -> Secret {
        Secret(bytes)
    }

    /// As it came over the wire; none: it has another length.
    #[must_use]
    pub fn read(bytes: &[u8]) -> Option<Secret> {
        bytes.try_into().ok().map(Secret)
    }

    /// As it goes over the wire.
    #[must_use]
    pub fn bytes(&self) -> &[u8; SECRET_BYTES] {
        &self.0
    }
}

impl PartialEq for Secret {
    fn eq(&self, other: &Secret) -> bool {
        same(&self.0, &other.0)
    }
}

impl Eq for Secret {}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(…)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_are_compared_whole_and_not_shown() {
        let secret = Secret::new([65; SECRET_BYTES]);
        assert_eq!(Secret::read(secret.bytes()), Some(secret.clone()));
        for place in 0..SECRET_BYTES {
            let mut other = [65; SECRET_BYTES];
            other[place] ^= 1;
            assert_ne!(secret, Secret::new(other), "{place}");
        }
        assert!(Secret::read(&[65; 31]).is_none() && Secret::read(b"").is_none());
        assert_eq!(format!("{secret:?}"), "Secret(…)");
    }
}
