//! What the controller does with memory that it does not need any more, and how many descriptors it may have.

/// Shortest buffer that is the kernel's again as soon as it is freed, bytes: batches of the store, long lists.
#[cfg(target_env = "gnu")]
const LENT: libc::c_int = 512 << 10;

/// From now on the allocator gives long buffers back. By itself it learns to keep them, up to 32 MiB each, between objects that
/// stay for ever.
pub(crate) fn give_buffers_back() {
    #[cfg(target_env = "gnu")]
    for what in [libc::M_MMAP_THRESHOLD, libc::M_TRIM_THRESHOLD] {
        // SAFETY: mallopt sets a number of the allocator; it locks what it must.
        unsafe { libc::mallopt(what, LENT) };
    }
}

/// Takes as many descriptors as it is allowed to have. Shells and systemd begin a process with 1024, so that programs that know
/// only `select` are safe, and expect others to ask for the rest: every agent and every watch is a connection.
pub(crate) fn take_descriptors() {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: both calls read or write one rlimit, which is ours.
    let took = unsafe {
        libc::getrlimit(libc::RLIMIT_NOFILE, &raw mut limit) == 0 && {
            limit.rlim_cur = limit.rlim_max;
            libc::setrlimit(libc::RLIMIT_NOFILE, &raw const limit) == 0
        }
    };
    if !took {
        tracing::warn!(
            error = &std::io::Error::last_os_error() as &dyn std::error::Error,
            "cannot raise the limit of open files"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_descriptors_are_taken_as_there_may_be() {
        let now = || {
            let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
            // SAFETY: it writes one rlimit, which is ours.
            assert_eq!(unsafe { libc::getrlimit(libc::RLIMIT_NOFILE, &raw mut limit) }, 0);
            limit
        };
        let few = libc::rlimit { rlim_cur: 64, ..now() };
        // SAFETY: it reads one rlimit, which is ours.
        assert_eq!(unsafe { libc::setrlimit(libc::RLIMIT_NOFILE, &raw const few) }, 0);
        take_descriptors();
        assert_eq!(now().rlim_cur, now().rlim_max);
    }
}
