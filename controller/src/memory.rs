//! Memory that stays with the process.
//!
//! While long messages go by, the same buffers are wanted again at once. The allocator's own guess is to give a few
//! hundred KiB back, and each page of the next buffer then costs a fault: a quarter of the time that a message of 1 MiB
//! takes on its way.

/// The longest free memory that is kept, bytes: the buffers of one message on its way in and out.
#[cfg(target_env = "gnu")]
const KEPT: libc::c_int = 8 << 20;

/// From now on the allocator keeps memory that is freed, up to `KEPT` at a time.
pub(crate) fn keep_buffers() {
    #[cfg(target_env = "gnu")]
    for what in [libc::M_MMAP_THRESHOLD, libc::M_TRIM_THRESHOLD] {
        // SAFETY: mallopt sets a number of the allocator; it locks what it must.
        unsafe { libc::mallopt(what, KEPT) };
    }
}
