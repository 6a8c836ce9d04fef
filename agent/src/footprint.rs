//! What an agent gives back once it runs.
//!
//! Nearly all of an idle agent's resident memory is its own program: the kernel maps it in large
//! pieces around what is touched, and a start touches most of it (flags, relocations, the join, the
//! handshake). After the first contact those pages are let go; the few that an idle agent needs come
//! back from the page cache by themselves, and the rest of it is the kernel's to use for tasks.
//!
//! The buffers of messages are the other way round: while messages go by, the same memory is wanted again at once, and a
//! megabyte that is given back costs a page fault for each 4 KiB of the next one. [`keep_buffers`] lets it stay.

use std::ops::Range;

/// The longest free memory that is kept, bytes: the buffers of one message on its way in and out.
#[cfg(target_env = "gnu")]
const KEPT: libc::c_int = 8 << 20;

/// From now on the allocator keeps memory that is freed, up to `KEPT`. Its own guess is a few hundred KiB, which each
/// long message passes twice.
pub(crate) fn keep_buffers() {
    #[cfg(target_env = "gnu")]
    for what in [libc::M_MMAP_THRESHOLD, libc::M_TRIM_THRESHOLD] {
        // SAFETY: mallopt sets a number of the allocator; it locks what it must.
        unsafe { libc::mallopt(what, KEPT) };
    }
}

/// Lets go of the pages that are copies of files. They are read again when they are needed.
pub(crate) fn give_back() {
    #[cfg(target_env = "gnu")]
    // SAFETY: gives back free memory of the allocator and nothing else.
    unsafe {
        libc::malloc_trim(0);
    }
    let Ok(smaps) = std::fs::read_to_string("/proc/self/smaps") else { return };
    for range in unchanged(&smaps) {
        // SAFETY: the range is a mapping of this process in which the kernel counts no page that
        // differs from its file, and that nobody may write to: dropping its pages changes no byte
        // of what is read from it. A mapping that is gone meanwhile gives an error, which is no harm.
        unsafe {
            libc::madvise(
                std::ptr::without_provenance_mut(range.start),
                range.len(),
                libc::MADV_DONTNEED,
            )
        };
    }
}

/// The mappings of files that are read-only and have no page of their own.
fn unchanged(smaps: &str) -> Vec<Range<usize>> {
    let mut found = Vec::new();
    let mut mapping = None;
    for line in smaps.lines() {
        if let Some(header) = header(line) {
            mapping = header;
        } else if line.split_whitespace().eq(["Anonymous:", "0", "kB"]) {
            found.extend(mapping.take());
        }
    }
    found
}

/// A line that begins a mapping: its range if it is of a file and read-only. `None`: another line.
fn header(line: &str) -> Option<Option<Range<usize>>> {
    // start-end permissions offset device inode path
    let mut fields = line.split_whitespace();
    let (start, end) = fields.next()?.split_once('-')?;
    let number = |text| usize::from_str_radix(text, 16).ok();
    let range = number(start)?..number(end)?;
    let read_only = fields.next()?.starts_with("r-");
    let of_a_file = fields.nth(3).is_some_and(|path| path.starts_with('/'));
    Some((read_only && of_a_file).then_some(range))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_equals_its_file_is_let_go() {
        let smaps = "\
1000-2000 r--p 00000000 fe:00 1 /usr/bin/muster-agent
Rss:                   4 kB
Anonymous:             0 kB
2000-6000 r-xp 00001000 fe:00 1 /usr/bin/muster agent
Anonymous:             0 kB
6000-7000 r--p 00005000 fe:00 1 /usr/bin/muster-agent
Anonymous:             4 kB
7000-8000 rw-p 00006000 fe:00 1 /usr/bin/muster-agent
Anonymous:             0 kB
8000-9000 rw-p 00000000 00:00 0 [heap]
Anonymous:             0 kB
9000-a000 r-xp 00000000 00:00 0 [vdso]
Anonymous:             0 kB
";
        assert_eq!(unchanged(smaps), [0x1000..0x2000, 0x2000..0x6000]);
    }

    #[test]
    fn the_program_goes_on() {
        let text = |n: usize| format!("{n:?} {}", "ü".repeat(n));
        let before = text(100);
        give_back();
        assert_eq!(text(100), before);
    }
}
