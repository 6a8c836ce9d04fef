//! Memory for frames: written here once, seen by every reader, changed by none.
//!
//! A slot is a memfd, sealed so that no descriptor of it can be written through or mapped for writing any more; this process
//! writes through the mapping that it made before (`F_SEAL_FUTURE_WRITE`, Linux 5.1). A slot that nobody has a frame in is
//! written again, so that memory is touched once and not for each frame. What bounds memory is decided by whoever asks the
//! [`Pool`].

use std::io;
use std::num::NonZeroUsize;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::ptr::NonNull;
use std::sync::Arc;

use rustix::fs::{MemfdFlags, SealFlags};
use rustix::mm::{MapFlags, ProtFlags};

/// A frame up to this is sent, longer ones are lent: below it a copy costs less than a reader's page faults.
pub(super) const INLINE: usize = 4 << 10;

/// Slots that nobody uses and that are kept for the next frames.
const SPARE: usize = 4;

/// Small frames of changing size share slots of one size.
const STEP: usize = 1 << 20;

/// A piece of memory.
#[derive(Debug)]
pub(super) struct Slot {
    id: u32,
    memory: OwnedFd,
    at: NonNull<u8>,
    capacity: NonZeroUsize,
}

// SAFETY: the mapping is this value's alone; it is written through `&mut` only.
unsafe impl Send for Slot {}
// SAFETY: as above; `&Slot` gives reading.
unsafe impl Sync for Slot {}

impl Slot {
    fn make(id: u32, capacity: NonZeroUsize) -> io::Result<Slot> {
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let memory = rustix::fs::memfd_create("muster-sensor", flags)?;
        rustix::fs::ftruncate(&memory, capacity.get() as u64)?;
        // SAFETY: a new mapping at a place of the kernel's choice.
        let at = unsafe {
            rustix::mm::mmap(
                std::ptr::null_mut(),
                capacity.get(),
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::SHARED,
                &memory,
                0,
            )?
        };
        let at = NonNull::new(at.cast()).ok_or(io::ErrorKind::OutOfMemory)?;
        let slot = Slot { id, memory, at, capacity };
        let seals = SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL;
        rustix::fs::fcntl_add_seals(&slot.memory, seals)?;
        Ok(slot)
    }

    /// Never used twice in a pool.
    pub(super) fn id(&self) -> u32 {
        self.id
    }

    pub(super) fn capacity(&self) -> usize {
        self.capacity.get()
    }

    /// For a reader.
    pub(super) fn descriptor(&self) -> BorrowedFd<'_> {
        self.memory.as_fd()
    }

    /// The first `length` bytes, or all.
    pub(super) fn bytes(&self, length: usize) -> &[u8] {
        // SAFETY: the mapping is as long as its capacity, and nobody writes while it is shared.
        unsafe { std::slice::from_raw_parts(self.at.as_ptr(), length.min(self.capacity.get())) }
    }

    /// The same, to be written.
    pub(super) fn bytes_mut(&mut self, length: usize) -> &mut [u8] {
        let length = length.min(self.capacity.get());
        // SAFETY: as above, and this is the only one.
        unsafe { std::slice::from_raw_parts_mut(self.at.as_ptr(), length) }
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        // SAFETY: the mapping that was made with it; no reference into it outlives it.
        let _ = unsafe { rustix::mm::munmap(self.at.as_ptr().cast(), self.capacity.get()) };
    }
}

/// The slots of a source.
#[derive(Debug)]
pub(super) struct Pool {
    slots: Vec<Arc<Slot>>,
    next: u32,
    /// Bytes that all slots may have.
    most: usize,
}

impl Pool {
    pub(super) fn new(most: usize) -> Pool {
        Pool { slots: Vec::new(), next: 0, most }
    }

    /// A slot that nobody has a frame in, of at least this capacity.
    pub(super) fn take(&mut self, length: usize) -> Option<Slot> {
        let fits = |slot: &Arc<Slot>| Arc::strong_count(slot) == 1 && slot.capacity() >= length;
        let at = self.slots.iter().position(fits)?;
        Arc::into_inner(self.slots.swap_remove(at))
    }

    /// Whether one more of this capacity is within bounds, perhaps in the place of some that nobody uses.
    pub(super) fn has_room(&mut self, length: usize) -> bool {
        let capacity = capacity(length).get();
        loop {
            let used: usize = self.slots.iter().map(|slot| slot.capacity()).sum();
            if used + capacity <= self.most {
                return true;
            }
            let Some(at) = self.slots.iter().position(|slot| Arc::strong_count(slot) == 1) else {
                return false;
            };
            self.slots.swap_remove(at);
        }
    }

    /// A new one.
    pub(super) fn make(&mut self, length: usize) -> io::Result<Slot> {
        self.next += 1;
        Slot::make(self.next, capacity(length))
    }

    /// Takes one back that was written.
    pub(super) fn put(&mut self, slot: &Arc<Slot>) {
        let mut spare = 0;
        self.slots.retain(|slot| {
            spare += usize::from(Arc::strong_count(slot) == 1);
            spare <= SPARE || Arc::strong_count(slot) > 1
        });
        self.slots.push(Arc::clone(slot));
    }

    /// Whether a slot may come again.
    pub(super) fn has(&self, id: u32) -> bool {
        self.slots.iter().any(|slot| slot.id == id)
    }

    /// All that nobody uses go.
    pub(super) fn clear(&mut self) {
        self.slots.retain(|slot| Arc::strong_count(slot) > 1);
    }
}

fn capacity(length: usize) -> NonZeroUsize {
    let rounded = match length {
        0..STEP => length.next_power_of_two(),
        _ => length.div_ceil(STEP).saturating_mul(STEP),
    };
    NonZeroUsize::new(rounded).unwrap_or(NonZeroUsize::MIN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_else_writes_into_a_slot() {
        let mut slot = Slot::make(1, capacity(5_000)).unwrap();
        slot.bytes_mut(4).copy_from_slice(b"seen");
        let theirs = rustix::io::dup(slot.descriptor()).unwrap();
        let map = |prot| {
            // SAFETY: a new mapping at a place of the kernel's choice; it is looked at before the slot goes.
            unsafe {
                rustix::mm::mmap(
                    std::ptr::null_mut(),
                    slot.capacity(),
                    prot,
                    MapFlags::SHARED,
                    &theirs,
                    0,
                )
            }
        };
        assert!(rustix::io::pwrite(&theirs, b"lost", 0).is_err());
        assert!(rustix::fs::ftruncate(&theirs, 0).is_err());
        assert!(map(ProtFlags::READ | ProtFlags::WRITE).is_err());
        let seen = map(ProtFlags::READ).unwrap();
        // SAFETY: the mapping was just made.
        let writable = unsafe {
            rustix::mm::mprotect(
                seen,
                slot.capacity(),
                rustix::mm::MprotectFlags::READ | rustix::mm::MprotectFlags::WRITE,
            )
        };
        assert!(writable.is_err(), "a mapping for reading stays one");
        // Nor through a descriptor that is opened anew.
        use std::os::fd::AsRawFd;
        let path = format!("/proc/self/fd/{}", theirs.as_raw_fd());
        if let Ok(again) = std::fs::OpenOptions::new().write(true).open(path) {
            assert!(rustix::io::pwrite(&again, b"lost", 0).is_err());
        }
        assert_eq!(slot.bytes(4), b"seen");
        // SAFETY: a mapping of this test's.
        let first = unsafe { std::slice::from_raw_parts(seen.cast::<u8>(), 4) };
        assert_eq!(first, b"seen");
        slot.bytes_mut(4).copy_from_slice(b"next");
        assert_eq!(slot.bytes(4), b"next");
        // SAFETY: as above.
        unsafe { rustix::mm::munmap(seen, slot.capacity()) }.unwrap();
    }

    #[test]
    fn slots_are_used_again_when_nobody_has_a_frame_in_them() {
        let mut pool = Pool::new(4 * STEP);
        let mut made = Vec::new();
        for _ in 0..3 {
            assert!(pool.take(STEP).is_none() && pool.has_room(STEP));
            let slot = Arc::new(pool.make(STEP).unwrap());
            pool.put(&slot);
            made.push(slot);
        }
        assert!(!pool.has_room(2 * STEP));
        let id = made.pop().unwrap().id();
        assert_eq!(pool.take(STEP / 2).map(|slot| slot.id()), Some(id));
        assert!(!pool.has(id), "taken, and dropped");
        drop(made.pop());
        assert!(pool.has_room(3 * STEP), "in the place of one that nobody uses");
        assert!(!pool.has_room(4 * STEP));
    }
}
