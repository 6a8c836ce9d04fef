//! Comparing what somebody shows with what is secret.

/// In a time that does not tell how much of it was right; that the lengths differ it may tell.
#[must_use]
pub fn same(shown: &[u8], secret: &[u8]) -> bool {
    let differences = shown.iter().zip(secret).fold(0, |all, (a, b)| all | (a ^ b));
    shown.len() == secret.len() && std::hint::black_box(differences) == 0
}
