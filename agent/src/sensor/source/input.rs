//! Bytes of a descriptor, cut into frames. A frame of known length is read straight into the memory that readers see.

use std::io;
use std::os::fd::OwnedFd;

use bytes::{Buf as _, BytesMut};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::Pace;
use crate::sensor::channel::Channel;
use crate::sensor::settings::Cut;

/// What is read at once of lines, bytes.
const CHUNK: usize = 16 << 10;

fn torn() -> io::Error {
    io::Error::other("it ended within a frame")
}

/// Something that is read.
#[derive(Debug)]
pub(super) enum Input {
    /// The kernel says when there is more.
    Told(AsyncFd<OwnedFd>),
    /// There is always more, or the end: a file.
    There(OwnedFd),
}

impl Input {
    /// From a descriptor that does not block.
    pub(super) fn new(fd: OwnedFd) -> io::Result<Input> {
        // SAFETY: the descriptor is owned by what it is given to, which gives it back only when it does not take it.
        match unsafe { AsyncFd::register_with_interest(fd, Interest::READABLE) } {
            Ok(fd) => Ok(Input::Told(fd)),
            Err(error) => {
                let (fd, error) = error.into_parts();
                match error.raw_os_error() {
                    // Files are always ready, and so nothing to wait for.
                    Some(libc::EPERM) => Ok(Input::There(fd)),
                    _ => Err(error),
                }
            }
        }
    }

    /// 0: its end.
    async fn read(&self, to: &mut [u8]) -> io::Result<usize> {
        match self {
            Input::Told(fd) => loop {
                let mut guard = fd.readable().await?;
                if let Ok(read) = guard.try_io(|fd| Ok(rustix::io::read(fd, &mut *to)?)) {
                    match read {
                        Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                        read => return read,
                    }
                }
            },
            Input::There(fd) => {
                tokio::task::yield_now().await;
                Ok(rustix::io::read(fd, to)?)
            }
        }
    }

    /// Whether all of it came; not, when its end came first.
    async fn fill(&self, to: &mut [u8]) -> io::Result<bool> {
        let mut filled = 0;
        while filled < to.len() {
            match self.read(&mut to[filled..]).await? {
                0 if filled == 0 => return Ok(false),
                0 => return Err(torn()),
                more => filled += more,
            }
        }
        Ok(true)
    }

    /// Publishes its frames until it ends: why, if that says anything.
    pub(super) async fn frames(&self, channel: &Channel) -> Option<String> {
        let settings = channel.settings();
        if matches!(self, Input::There(_)) && settings.max_hz.is_none() {
            let why =
                "there is always more in it: say with maxHz how many frames a second are taken";
            return Some(why.to_owned());
        }
        let mut pace = Pace::new(settings.max_hz);
        let ended = match settings.cut() {
            Cut::Lines => self.lines(channel, &mut pace).await,
            Cut::Length => self.counted(None, channel, &mut pace).await,
            Cut::Fixed(size) => self.counted(Some(size), channel, &mut pace).await,
        };
        ended.err().map(|error| error.to_string())
    }

    async fn counted(
        &self,
        size: Option<usize>,
        channel: &Channel,
        pace: &mut Pace,
    ) -> io::Result<()> {
        loop {
            pace.ready().await;
            pace.took();
            let length = match size {
                Some(size) => size,
                None => {
                    let mut length = [0; 4];
                    if !self.fill(&mut length).await? {
                        return Ok(());
                    }
                    u32::from_be_bytes(length) as usize
                }
            };
            let mut blank = channel.blank(length).map_err(io::Error::other)?;
            if !self.fill(blank.bytes()).await? {
                return if size.is_some() { Ok(()) } else { Err(torn()) };
            }
            channel.publish(blank);
        }
    }

    async fn lines(&self, channel: &Channel, pace: &mut Pace) -> io::Result<()> {
        let (mut kept, mut looked) = (BytesMut::new(), 0);
        loop {
            if let Some(at) = kept[looked..].iter().position(|byte| *byte == b'\n') {
                pace.ready().await;
                pace.took();
                let line = kept.split_to(looked + at);
                kept.advance(1);
                looked = 0;
                let mut blank = channel.blank(line.len()).map_err(io::Error::other)?;
                blank.bytes().copy_from_slice(&line);
                channel.publish(blank);
                continue;
            }
            looked = kept.len();
            // A line that goes on and on is refused before it is whole.
            if looked > channel.settings().longest() {
                return Err(io::Error::other(format!("a line of more than {looked} bytes")));
            }
            let end = kept.len();
            kept.resize(end + CHUNK, 0);
            let read = self.read(&mut kept[end..]).await?;
            kept.truncate(end + read);
            if read == 0 {
                return Ok(());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;
    use crate::sensor::channel::{Body, Channel};

    /// What a reader gets of these bytes, cut so, and why that ended.
    async fn cut(settings: &str, bytes: &[u8]) -> (Vec<Vec<u8>>, Option<String>) {
        let settings = format!("{{function: 'k:I', exec: [x], {settings}}}");
        let channel = std::sync::Arc::new(Channel::new(serde_saphyr::from_str(&settings).unwrap()));
        let reader = channel.subscribe(16);
        let (from, to) = std::io::pipe().unwrap();
        rustix::io::ioctl_fionbio(&from, true).unwrap();
        let bytes = bytes.to_vec();
        let writer = std::thread::spawn(move || (&to).write_all(&bytes));
        let why = Input::new(from.into()).unwrap().frames(&channel).await;
        let _ = writer.join().unwrap();
        let mut frames = Vec::new();
        while let Some(Ok(delivery)) = futures::FutureExt::now_or_never(reader.next()) {
            frames.push(match delivery.frame.body {
                Body::Inline(bytes) => bytes.to_vec(),
                Body::Shared { slot, length } => slot.bytes(length).to_vec(),
            });
            reader.done(delivery.sequence).unwrap();
        }
        (frames, why)
    }

    fn of(frames: &[&[u8]]) -> Vec<Vec<u8>> {
        frames.iter().map(|frame| frame.to_vec()).collect()
    }

    #[tokio::test]
    async fn frames_are_kept_apart_as_it_is_said() {
        let (frames, why) = cut("framing: Lines", b"one\n\nthree\nfour").await;
        assert_eq!((frames, why), (of(&[b"one", b"", b"three"]), None));
        let (frames, why) = cut("framing: Length", b"\0\0\0\x02ab\0\0\0\0\0\0\0\x01c").await;
        assert_eq!((frames, why), (of(&[b"ab", b"", b"c"]), None));
        let (frames, why) = cut("framing: Fixed, size: '3'", b"abcdef").await;
        assert_eq!((frames, why), (of(&[b"abc", b"def"]), None));
        let large = vec![5; 200_000];
        let (frames, why) = cut("framing: Fixed, size: '200000'", &large).await;
        assert_eq!((frames, why), (vec![large], None));
    }

    #[tokio::test]
    async fn what_is_torn_or_too_long_is_no_frame() {
        let torn = Some("it ended within a frame".to_owned());
        assert_eq!(cut("framing: Length", b"\0\0\0\x05ab").await, (Vec::new(), torn.clone()));
        assert_eq!(cut("framing: Length", b"\0\0\0\x05").await, (Vec::new(), torn.clone()));
        assert_eq!(cut("framing: Fixed, size: '3'", b"abcd").await, (of(&[b"abc"]), torn));
        let (frames, why) = cut("framing: Length, memory: 64Ki", b"\0\x01\0\0").await;
        assert!(frames.is_empty() && why.is_some_and(|why| why.contains("the longest is 16384")));
        let long = vec![b'x'; 100_000];
        let (frames, why) = cut("framing: Lines, memory: 64Ki", &long).await;
        assert!(frames.is_empty() && why.is_some_and(|why| why.contains("a line of more")));
    }

    #[test]
    fn a_file_is_read_at_a_pace() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("recorded");
        std::fs::write(&path, b"a\nb\n").unwrap();
        let open = || Input::new(std::fs::File::open(&path).unwrap().into()).unwrap();
        let channel = |text: &str| {
            let text = format!("{{function: 'k:I', device: /x, framing: Lines{text}}}");
            std::sync::Arc::new(Channel::new(serde_saphyr::from_str(&text).unwrap()))
        };
        runtime.block_on(async {
            let why = open().frames(&channel("")).await;
            assert!(why.is_some_and(|why| why.contains("maxHz")));
            let channel = channel(", maxHz: 100");
            let reader = channel.subscribe(4);
            assert_eq!(open().frames(&channel).await, None);
            assert_eq!(reader.next().await.unwrap().sequence, 1);
        });
    }
}
