//! Join tokens: `muster1.<id>.<secret>.<SHA-256 of the CA certificate's DER, hex>`. The hash is what
//! lets an agent believe a controller that it has never met.

use std::fmt;
use std::str::FromStr;

/// A token.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Token {
    /// All of it, as the controller wants it back.
    pub(crate) text: String,
    pub(crate) ca_hash: [u8; 32],
}

impl Token {
    /// Its public part, by which `muster token list` shows it.
    pub(crate) fn id(&self) -> &str {
        self.text.split('.').nth(1).unwrap_or_default()
    }
}

impl fmt::Debug for Token {
    /// Not the secret: this ends up in logs.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

/// Why a text is no token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "this is not a join token: a token has four parts, muster1.ID.SECRET.HASH, and comes from `muster token create`"
)]
pub struct TokenError;

impl FromStr for Token {
    type Err = TokenError;

    fn from_str(text: &str) -> Result<Self, TokenError> {
        let parts: Vec<&str> = text.trim().split('.').collect();
        let ["muster1", id, secret, hash] = parts.as_slice() else { return Err(TokenError) };
        if id.is_empty() || secret.is_empty() || hash.len() != 64 || !hash.is_ascii() {
            return Err(TokenError);
        }
        let mut ca_hash = [0; 32];
        for (byte, pair) in ca_hash.iter_mut().zip(hash.as_bytes().chunks(2)) {
            let pair = std::str::from_utf8(pair).map_err(|_| TokenError)?;
            *byte = u8::from_str_radix(pair, 16).map_err(|_| TokenError)?;
        }
        Ok(Token { text: text.trim().to_owned(), ca_hash })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_parts_and_a_hash() {
        let text = format!("muster1.a.b.{}", "0f".repeat(32));
        let token: Token = text.parse().unwrap();
        assert_eq!(token.ca_hash, [0x0f; 32]);
        assert_eq!(token.id(), "a");
        assert!(!format!("{token:?}").contains(".b."));
        let zz = format!("muster1.a.b.{}", "zz".repeat(32));
        for bad in ["", "muster1.a.b.c", "muster2.a.b", &zz] {
            assert_eq!(bad.parse::<Token>(), Err(TokenError), "{bad}");
        }
    }
}
