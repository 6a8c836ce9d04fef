//! Where every random choice of a run comes from: its seed.
//!
//! The choices of the simulation itself come from [`Dice`], anew for each step: a run from which steps were taken out still
//! makes the same choices in the others. Whatever asks the *system* for random bytes (hash tables, `tokio::select!`, uids)
//! gets them from [`getrandom`] here, which stands before libc's in this program.

use std::ffi::{c_uint, c_void};
use std::sync::atomic::{AtomicU64, Ordering};

/// A sequence of choices (splitmix64).
#[derive(Debug, Clone)]
pub(crate) struct Dice(u64);

impl Dice {
    /// The choices of one step of one seed.
    pub(crate) fn of(seed: u64, step: u64) -> Dice {
        let mut dice = Dice(seed ^ step.wrapping_mul(0xD6E8_FEB8_6659_FD93));
        dice.roll();
        dice
    }

    /// Any number.
    pub(crate) fn roll(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        mix(self.0)
    }

    /// A number from `low` to `high`, both included.
    pub(crate) fn between(&mut self, low: u64, high: u64) -> u64 {
        low + self.roll() % (high - low + 1)
    }

    /// True once in `n` times.
    pub(crate) fn one_in(&mut self, n: u64) -> bool {
        self.roll().is_multiple_of(n)
    }

    /// One of them; none of none.
    pub(crate) fn pick<'a, T>(&mut self, all: &'a [T]) -> Option<&'a T> {
        let index = self.between(0, (all.len() as u64).max(1) - 1);
        all.get(usize::try_from(index).unwrap_or(usize::MAX))
    }
}

fn mix(state: u64) -> u64 {
    let a = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let b = (a ^ (a >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    b ^ (b >> 31)
}

/// What the system's randomness goes on from.
static SYSTEM: AtomicU64 = AtomicU64::new(0);

/// The system's random bytes follow from this seed from now on.
pub(crate) fn seed_the_system(seed: u64) {
    SYSTEM.store(mix(seed), Ordering::SeqCst);
}

/// Stands before libc's function of this name: std, uuid and ring call it.
///
/// # Safety
///
/// `buffer` has room for `length` bytes, as libc's caller promises.
#[expect(unreachable_pub, reason = "the linker finds it by its name")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn getrandom(buffer: *mut c_void, length: usize, _flags: c_uint) -> isize {
    for offset in 0..length {
        let state = SYSTEM.fetch_add(0x9E37_79B9_7F4A_7C15, Ordering::SeqCst);
        let byte = mix(state).to_le_bytes()[0];
        // SAFETY: offset < length, and the caller's buffer has room for length bytes.
        unsafe { buffer.cast::<u8>().add(offset).write(byte) };
    }
    isize::try_from(length).unwrap_or(isize::MAX)
}
