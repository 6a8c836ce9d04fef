//! Bytes in pieces: a message is encoded without copying the large pieces that it is made of.

use std::collections::VecDeque;
use std::io::IoSlice;

use bytes::buf::UninitSlice;
use bytes::{Buf, BufMut, Bytes, BytesMut};

/// A piece this long is kept as it is; shorter ones are copied together.
const LARGE: usize = 4 << 10;

/// Written as a `BufMut`, read as a `Buf`.
///
/// Prost hands a field of `Bytes` to [`BufMut::put`], which keeps it when it is large.
#[derive(Debug, Default)]
pub struct Rope {
    pieces: VecDeque<Bytes>,
    /// What was written after the last piece.
    tail: BytesMut,
    /// Bytes in `pieces`.
    before: usize,
}

impl Rope {
    /// Nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Rope::default()
    }

    /// Ends the writing: everything is a piece.
    pub fn seal(&mut self) {
        if !self.tail.is_empty() {
            self.before += self.tail.len();
            self.pieces.push_back(self.tail.split().freeze());
        }
    }
}

// SAFETY: `chunk_mut` and `advance_mut` are those of `tail`, which keeps the contract.
unsafe impl BufMut for Rope {
    fn remaining_mut(&self) -> usize {
        usize::MAX - self.before - self.tail.len()
    }

    unsafe fn advance_mut(&mut self, count: usize) {
        // SAFETY: the caller has written `count` bytes to the `chunk_mut` of the tail.
        unsafe { self.tail.advance_mut(count) }
    }

    fn chunk_mut(&mut self) -> &mut UninitSlice {
        self.tail.chunk_mut()
    }

    fn put<T: Buf>(&mut self, mut from: T) {
        if from.remaining() < LARGE {
            self.tail.put(from);
            return;
        }
        self.seal();
        // No copy when `from` is a `Bytes`.
        let piece = from.copy_to_bytes(from.remaining());
        self.before += piece.len();
        self.pieces.push_back(piece);
    }
}

/// What was written before the last [`Rope::seal`].
impl Buf for Rope {
    fn remaining(&self) -> usize {
        self.before
    }

    fn chunk(&self) -> &[u8] {
        self.pieces.front().map_or(&[], |piece| piece)
    }

    fn chunks_vectored<'a>(&'a self, slices: &mut [IoSlice<'a>]) -> usize {
        let filled = slices.iter_mut().zip(&self.pieces);
        filled.map(|(slice, piece)| *slice = IoSlice::new(piece)).count()
    }

    fn advance(&mut self, mut count: usize) {
        assert!(count <= self.before, "{count} of {} bytes", self.before);
        self.before -= count;
        while count > 0 {
            let Some(piece) = self.pieces.front_mut() else { return };
            let here = count.min(piece.len());
            piece.advance(here);
            count -= here;
            if piece.is_empty() {
                self.pieces.pop_front();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use prost::Message as _;

    use super::*;
    use crate::wire::executor::v1::Message;

    #[test]
    fn a_large_piece_is_kept_and_the_bytes_are_those_of_the_message() {
        for length in [0, 10, LARGE - 1, LARGE, 100_000] {
            let message = Message { data: vec![7; length].into() };
            let mut rope = Rope::new();
            rope.put_u32(9);
            message.encode(&mut rope).expect("a rope has room");
            rope.put_u8(1);
            rope.seal();
            let kept = rope.pieces.iter().any(|p| p.as_ptr() == message.data.as_ptr());
            assert_eq!(kept, length >= LARGE, "{length}");
            let mut expected = BytesMut::new();
            expected.put_u32(9);
            message.encode(&mut expected).expect("it has room");
            expected.put_u8(1);
            assert_eq!(rope.remaining(), expected.len());
            // Read in steps that cross the pieces.
            let mut read = Vec::new();
            while rope.has_remaining() {
                let mut step = vec![0; 3_333.min(rope.remaining())];
                rope.copy_to_slice(&mut step);
                read.extend(step);
            }
            assert_eq!(read, expected);
        }
    }
}
