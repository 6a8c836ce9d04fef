//! Bits, and the code of a block: its first coefficient as a difference, then (run of zeros, value)
//! pairs, all as Exponential-Golomb codes (as H.264 has them, 9.1), then the end of the block.

/// Bits being written, the highest first.
#[derive(Debug, Default)]
pub(super) struct Writer {
    bytes: Vec<u8>,
    /// Bits that do not fill a byte yet, the lowest `waiting` ones.
    buffer: u64,
    waiting: u32,
}

/// Bits being read.
#[derive(Debug, Clone)]
pub(super) struct Reader<'a> {
    bytes: &'a [u8],
    bit: usize,
}

impl Writer {
    fn put(&mut self, value: u32, bits: u32) {
        self.buffer = (self.buffer << bits) | u64::from(value);
        self.waiting += bits;
        while self.waiting >= 8 {
            self.waiting -= 8;
            self.bytes.push((self.buffer >> self.waiting) as u8);
        }
    }

    /// Any number below 65 535; small ones are short.
    pub(super) fn unsigned(&mut self, value: u32) {
        let code = value + 1;
        let length = u32::BITS - code.leading_zeros();
        self.put(0, length - 1);
        self.put(code, length);
    }

    fn signed(&mut self, value: i32) {
        let magnitude = value.unsigned_abs() * 2;
        self.unsigned(if value > 0 { magnitude - 1 } else { magnitude });
    }

    /// A block whose predecessor in its plane began with `before`.
    pub(super) fn block(&mut self, quantised: &[i16; 64], before: i16) {
        self.signed(i32::from(quantised[0]) - i32::from(before));
        let mut run = 0;
        for &value in &quantised[1..] {
            if value == 0 {
                run += 1;
            } else {
                // 0 is the end of the block.
                self.unsigned(run + 1);
                self.signed(i32::from(value));
                run = 0;
            }
        }
        self.unsigned(0);
    }

    /// All bytes; the last one is filled up with zeros.
    pub(super) fn finish(mut self) -> Vec<u8> {
        let rest = (8 - self.waiting % 8) % 8;
        self.put(0, rest);
        self.bytes
    }
}

impl<'a> Reader<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Reader { bytes, bit: 0 }
    }

    fn bit(&mut self) -> Option<u32> {
        let byte = self.bytes.get(self.bit / 8)?;
        let bit = (byte >> (7 - self.bit % 8)) & 1;
        self.bit += 1;
        Some(u32::from(bit))
    }

    pub(super) fn unsigned(&mut self) -> Option<u32> {
        let mut zeros = 0;
        while self.bit()? == 0 {
            zeros += 1;
            if zeros > 24 {
                return None;
            }
        }
        let mut code = 1;
        for _ in 0..zeros {
            code = code << 1 | self.bit()?;
        }
        Some(code - 1)
    }

    fn signed(&mut self) -> Option<i32> {
        let code = self.unsigned()?;
        let magnitude = code.div_ceil(2).cast_signed();
        Some(if code % 2 == 1 { magnitude } else { -magnitude })
    }

    /// None: this is no block.
    pub(super) fn block(&mut self, before: i16) -> Option<[i16; 64]> {
        let mut quantised = [0; 64];
        quantised[0] = i16::try_from(i32::from(before) + self.signed()?).ok()?;
        let mut at = 0;
        loop {
            match self.unsigned()? {
                0 => return Some(quantised),
                step => at += step as usize,
            }
            *quantised.get_mut(at)? = i16::try_from(self.signed()?).ok()?;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn numbers_come_back() {
        let numbers = [0, 1, -1, 2, -2, 255, -255, 4095, -4096];
        let mut writer = Writer::default();
        for n in numbers {
            writer.signed(n);
        }
        let bytes = writer.finish();
        let mut reader = Reader::new(&bytes);
        assert_eq!(numbers.map(|_| reader.signed()), numbers.map(Some));
    }

    #[test]
    fn blocks_come_back() {
        let mut rng = Rng::new(5);
        let blocks: Vec<[i16; 64]> = (0..50)
            .map(|_| {
                [0; 64]
                    .map(|_: i16| if rng.below(4) == 0 { rng.below(400) as i16 - 200 } else { 0 })
            })
            .collect();
        let mut writer = Writer::default();
        let mut before = 0;
        for block in &blocks {
            writer.block(block, before);
            before = block[0];
        }
        let bytes = writer.finish();
        let mut reader = Reader::new(&bytes);
        let mut before = 0;
        for block in &blocks {
            let read = reader.block(before).expect("a block");
            assert_eq!(&read, block);
            before = read[0];
        }
    }

    #[test]
    fn nonsense_is_no_block() {
        assert_eq!(Reader::new(&[]).block(0), None);
        assert_eq!(Reader::new(&[0; 100]).block(0), None);
        assert_eq!(Reader::new(&[0b1010_1010; 4]).block(0), None, "it ends too early");
    }
}
