//! The serialisation of ROS 1: little-endian, packed, lengths as `uint32`.

use bytes::Bytes;

/// Why bytes are not a message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// It ends within a field.
    #[error("the message ends {missing} bytes too early")]
    Short {
        /// How many more are needed, at least.
        missing: usize,
    },
    /// Something follows.
    #[error("{0} bytes follow the message")]
    Long(usize),
    /// A string of it is in another encoding.
    #[error("a string of the message is not UTF-8")]
    Text,
}

/// Reads fields, one after the other.
#[derive(Debug)]
pub struct Reader(Bytes);

impl Reader {
    /// At the start of `body`.
    #[must_use]
    pub fn new(body: Bytes) -> Self {
        Reader(body)
    }

    /// The next `length` bytes, shared with the body.
    ///
    /// # Errors
    ///
    /// There are fewer.
    pub fn take(&mut self, length: usize) -> Result<Bytes, DecodeError> {
        self.needs(length)?;
        Ok(self.0.split_to(length))
    }

    fn needs(&self, length: usize) -> Result<(), DecodeError> {
        match length.checked_sub(self.0.len()) {
            None | Some(0) => Ok(()),
            Some(missing) => Err(DecodeError::Short { missing }),
        }
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], DecodeError> {
        self.needs(N)?;
        let mut array = [0; N];
        array.copy_from_slice(&self.0[..N]);
        bytes::Buf::advance(&mut self.0, N);
        Ok(array)
    }

    /// The number of elements that follow, when so many can.
    pub(crate) fn count(&mut self, least: usize) -> Result<usize, DecodeError> {
        let count = u32::read(self)? as usize;
        // An element without content still takes a turn of the loop that reads it.
        self.needs(count.saturating_mul(least.max(1)))?;
        Ok(count)
    }

    /// Nothing may follow.
    ///
    /// # Errors
    ///
    /// Something does.
    pub fn finish(self) -> Result<(), DecodeError> {
        if self.0.is_empty() { Ok(()) } else { Err(DecodeError::Long(self.0.len())) }
    }
}

/// A field, or a message.
pub trait Wire: Sized {
    /// How many bytes it takes at least: what a length claims is checked before memory is taken for it.
    const LEAST: usize;

    /// ROS's value of a field that nobody set.
    fn nothing() -> Self;

    /// Reads one.
    ///
    /// # Errors
    ///
    /// The bytes are none.
    fn read(from: &mut Reader) -> Result<Self, DecodeError>;

    /// Writes it.
    fn write(&self, to: &mut Vec<u8>);
}

macro_rules! number {
    ($($kind:ty),*) => { $(
        impl Wire for $kind {
            const LEAST: usize = size_of::<$kind>();

            fn nothing() -> Self {
                Self::default()
            }

            fn read(from: &mut Reader) -> Result<Self, DecodeError> {
                from.array().map(Self::from_le_bytes)
            }

            fn write(&self, to: &mut Vec<u8>) {
                to.extend_from_slice(&self.to_le_bytes());
            }
        }
    )* };
}
number!(i8, u8, i16, u16, i32, u32, i64, u64, f32, f64);

impl Wire for bool {
    const LEAST: usize = 1;

    fn nothing() -> Self {
        false
    }

    fn read(from: &mut Reader) -> Result<Self, DecodeError> {
        u8::read(from).map(|byte| byte != 0)
    }

    fn write(&self, to: &mut Vec<u8>) {
        to.push(u8::from(*self));
    }
}

/// Longer than any field may be: it would not fit its length.
fn length(of: usize) -> u32 {
    u32::try_from(of).expect("no field of 4 GiB fits a frame, which has the same length field")
}

impl Wire for Bytes {
    const LEAST: usize = 4;

    fn nothing() -> Self {
        Bytes::new()
    }

    fn read(from: &mut Reader) -> Result<Self, DecodeError> {
        let count = from.count(1)?;
        from.take(count)
    }

    fn write(&self, to: &mut Vec<u8>) {
        length(self.len()).write(to);
        to.extend_from_slice(self);
    }
}

impl Wire for String {
    const LEAST: usize = 4;

    fn nothing() -> Self {
        String::new()
    }

    fn read(from: &mut Reader) -> Result<Self, DecodeError> {
        let bytes = Bytes::read(from)?;
        std::str::from_utf8(&bytes).map(str::to_owned).map_err(|_| DecodeError::Text)
    }

    fn write(&self, to: &mut Vec<u8>) {
        length(self.len()).write(to);
        to.extend_from_slice(self.as_bytes());
    }
}

impl<T: Wire> Wire for Vec<T> {
    const LEAST: usize = 4;

    fn nothing() -> Self {
        Vec::new()
    }

    fn read(from: &mut Reader) -> Result<Self, DecodeError> {
        let count = from.count(T::LEAST)?;
        (0..count).map(|_| T::read(from)).collect()
    }

    fn write(&self, to: &mut Vec<u8>) {
        length(self.len()).write(to);
        self.iter().for_each(|one| one.write(to));
    }
}

impl<T: Wire, const N: usize> Wire for [T; N] {
    const LEAST: usize = N * T::LEAST;

    fn nothing() -> Self {
        std::array::from_fn(|_| T::nothing())
    }

    fn read(from: &mut Reader) -> Result<Self, DecodeError> {
        from.needs(Self::LEAST)?;
        let mut array = Self::nothing();
        for one in &mut array {
            *one = T::read(from)?;
        }
        Ok(array)
    }

    fn write(&self, to: &mut Vec<u8>) {
        self.iter().for_each(|one| one.write(to));
    }
}

/// Any message at all, for property tests: made from bytes that proptest chooses and shrinks.
#[cfg(test)]
pub(crate) mod sample {
    use super::*;
    use crate::time::{Duration, Time};

    /// Bytes to make values from; zeros, when they are used up.
    pub(crate) struct Entropy(pub(crate) std::vec::IntoIter<u8>);

    impl Entropy {
        pub(crate) fn new(bytes: Vec<u8>) -> Self {
            Entropy(bytes.into_iter())
        }

        fn byte(&mut self) -> u8 {
            self.0.next().unwrap_or(0)
        }
    }

    pub(crate) trait Sample {
        fn sample(from: &mut Entropy) -> Self;
    }

    macro_rules! number {
        ($($kind:ty),*) => { $(
            impl Sample for $kind {
                fn sample(from: &mut Entropy) -> Self {
                    Self::from_le_bytes(std::array::from_fn(|_| from.byte()))
                }
            }
        )* };
    }
    number!(i8, u8, i16, u16, i32, u32, i64, u64, f32, f64);

    impl Sample for bool {
        fn sample(from: &mut Entropy) -> Self {
            from.byte() % 2 == 1
        }
    }

    impl Sample for String {
        fn sample(from: &mut Entropy) -> Self {
            (0..from.byte() % 5).map(|_| char::from(from.byte())).collect()
        }
    }

    impl Sample for Bytes {
        fn sample(from: &mut Entropy) -> Self {
            (0..from.byte() % 9).map(|_| from.byte()).collect()
        }
    }

    impl<T: Sample> Sample for Vec<T> {
        fn sample(from: &mut Entropy) -> Self {
            (0..from.byte() % 4).map(|_| T::sample(from)).collect()
        }
    }

    impl<T: Sample, const N: usize> Sample for [T; N] {
        fn sample(from: &mut Entropy) -> Self {
            std::array::from_fn(|_| T::sample(from))
        }
    }

    impl Sample for Time {
        fn sample(from: &mut Entropy) -> Self {
            Time { sec: Sample::sample(from), nsec: Sample::sample(from) }
        }
    }

    impl Sample for Duration {
        fn sample(from: &mut Entropy) -> Self {
            Duration { sec: Sample::sample(from), nsec: Sample::sample(from) }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::sample::{Entropy, Sample};
    use super::*;
    use crate::message::Message;
    use crate::{geometry_msgs, nav_msgs, sensor_msgs, std_msgs, tf2_msgs};

    fn round_trip<M: Message + Sample>(entropy: &[u8]) {
        let message = M::sample(&mut Entropy::new(entropy.to_vec()));
        let bytes = message.encode();
        assert!(bytes.len() >= M::LEAST, "{}", M::TYPE);
        // Compared as bytes: a NaN is not equal to itself.
        let again = M::decode(Bytes::from(bytes.clone())).expect("what was written is a message");
        assert_eq!(again.encode(), bytes, "{}", M::TYPE);
        if let Some(last) = bytes.len().checked_sub(1) {
            let short = M::decode(Bytes::copy_from_slice(&bytes[..last]));
            assert!(short.is_err(), "{}: a byte is missing", M::TYPE);
        }
        let long = M::decode(Bytes::from([&*bytes, &[0]].concat()));
        assert_eq!(long.err(), Some(DecodeError::Long(1)), "{}", M::TYPE);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(entropy in prop::collection::vec(any::<u8>(), 0..900)) {
            round_trip::<std_msgs::Header>(&entropy);
            round_trip::<std_msgs::Empty>(&entropy);
            round_trip::<nav_msgs::Odometry>(&entropy);
            round_trip::<nav_msgs::OccupancyGrid>(&entropy);
            round_trip::<sensor_msgs::LaserScan>(&entropy);
            round_trip::<sensor_msgs::Image>(&entropy);
            round_trip::<sensor_msgs::CameraInfo>(&entropy);
            round_trip::<sensor_msgs::BatteryState>(&entropy);
            round_trip::<tf2_msgs::TFMessage>(&entropy);
            round_trip::<geometry_msgs::PoseWithCovarianceStamped>(&entropy);
        }

        /// Whatever comes, it is refused or read, and takes no more memory than came.
        #[test]
        fn any_bytes_are_a_message_or_an_error(body in prop::collection::vec(any::<u8>(), 0..300)) {
            let body = Bytes::from(body);
            drop(tf2_msgs::TFMessage::decode(body.clone()));
            drop(sensor_msgs::CameraInfo::decode(body.clone()));
            drop(nav_msgs::Path::decode(body));
        }
    }

    #[test]
    fn a_length_that_is_not_there_takes_no_memory() {
        let mut body = Vec::new();
        u32::MAX.write(&mut body);
        let error = tf2_msgs::TFMessage::decode(Bytes::from(body)).unwrap_err();
        assert!(matches!(error, DecodeError::Short { missing } if missing > 1 << 32));
    }

    #[test]
    fn bytes_of_an_image_are_not_copied() {
        let image = sensor_msgs::Image { data: vec![7; 100].into(), ..Default::default() };
        let body = Bytes::from(image.encode());
        let range = body.as_ptr_range();
        let read = sensor_msgs::Image::decode(body).unwrap();
        assert!(range.contains(&read.data.as_ptr()));
    }
}
