//! Where every random choice of a run comes from: its seed.
//!
//! The choices of the simulation itself come from [`Dice`], anew for each step: a run from which steps were taken out still
//! makes the same choices in the others. Whatever asks the *system* for random bytes (hash tables, `tokio::select!`, uids)
//! gets them from [`getrandom`] here, which stands before libc's in this program.

use std::ffi::{c_uint, c_void};
use std::sync::atomic::{AtomicU64, Ordering};

pub(crate) use muster_tests::dice::Dice;
use muster_tests::dice::{STEP, mix};

/// The choices of one step of one seed.
pub(crate) fn of(seed: u64, step: u64) -> Dice {
    let mut dice = Dice::new(seed ^ step.wrapping_mul(0xD6E8_FEB8_6659_FD93));
    dice.roll();
    dice
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
        let state = SYSTEM.fetch_add(STEP, Ordering::SeqCst);
        let byte = mix(state).to_le_bytes()[0];
        // SAFETY: offset < length, and the caller's buffer has room for length bytes.
        unsafe { buffer.cast::<u8>().add(offset).write(byte) };
    }
    isize::try_from(length).unwrap_or(isize::MAX)
}
