//! Avalon's data-driven task (SR): takes camera frames, compresses them and sends them away.
//!
//! ```text
//!   scene ─▶ YCbCr 4:2:0 ─▶ 8×8 DCT, quantised ([`dct`]) ─▶ bits ([`bits`]) ─▶ socket ─▶ whoever watches
//! ```
//!
//! Without `--to` the watcher is a thread of this program behind a socket pair: bytes really pass
//! through the kernel. Once a second one frame is decoded, to say how good the picture is.

mod bits;
mod dct;
mod picture;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde_json::{Map, Value, json};

use super::run::{self, Pacing, Work, rounded};
use super::scene::{Image, Scene};
use crate::exit;

/// A Kinect's colour camera.
const CAMERA_HZ: f64 = 30.0;

/// Flags of `muster workload monitoring`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pacing: Pacing,
    /// Pixels across
    #[arg(long, value_name = "N", default_value_t = 320, value_parser = clap::value_parser!(u32).range(16..=4096))]
    width: u32,
    /// Pixels down
    #[arg(long, value_name = "N", default_value_t = 240, value_parser = clap::value_parser!(u32).range(16..=4096))]
    height: u32,
    /// Quality of the picture, 1 to 100
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=100))]
    quality: u32,
    /// Send the frames to this address over TCP; default: to a reader in this program
    #[arg(long, value_name = "HOST:PORT")]
    to: Option<String>,
}

pub(super) fn run(args: &Args) -> u8 {
    let sink = match Sink::open(args.to.as_deref()) {
        Ok(sink) => sink,
        Err(error) => {
            eprintln!("error: cannot send frames: {error}");
            return exit::FAILURE;
        }
    };
    let work = Monitoring {
        scene: Scene::new(args.width as usize, args.height as usize, args.pacing.seed),
        coder: picture::Coder::new(args.quality),
        sink,
        views: 1,
        sent: 0,
        frames: 0,
        last: None,
    };
    run::run(work, &args.pacing, Some(CAMERA_HZ))
}

/// A unit is one view of the scene: a frame of two units is a stereo camera's.
struct Monitoring {
    scene: Scene,
    coder: picture::Coder,
    sink: Sink,
    views: u32,
    sent: u64,
    frames: u64,
    /// The last view and its code.
    last: Option<(Image, Vec<u8>)>,
}

impl Work for Monitoring {
    fn name(&self) -> &'static str {
        "monitoring"
    }

    fn set_units(&mut self, units: u32) {
        self.views = units;
    }

    fn frame(&mut self) {
        for _ in 0..self.views {
            let image = self.scene.frame();
            let code = self.coder.encode(image);
            self.sent += self.sink.send(&code) as u64;
            self.frames += 1;
            // A view a second is plenty for the quality; copying each would be work of no use.
            if self.last.is_none() {
                self.last = Some((image.clone(), code));
            }
        }
    }

    fn findings(&mut self) -> Map<String, Value> {
        let mut found = Map::new();
        if let Some((image, code)) = self.last.take() {
            let raw = image.width * image.height * 3;
            found.insert("ratio".into(), json!(rounded(raw as f64 / code.len() as f64, 1)));
            if let Some(psnr) = self.coder.decode(&code).map(|seen| picture::psnr(&image, &seen)) {
                found.insert("psnr_db".into(), json!(rounded(psnr, 1)));
            }
        }
        found.insert("bytes_sent".into(), json!(self.sent));
        found.insert("bytes_received".into(), self.sink.received());
        found.insert("lost".into(), json!(self.sink.lost));
        found
    }
}

/// Where frames go: a length, then the code.
struct Sink {
    to: Box<dyn Write>,
    /// What the reader in this program has read.
    read: Option<Arc<AtomicU64>>,
    /// Frames that nobody took.
    lost: u64,
}

impl Sink {
    fn open(to: Option<&str>) -> std::io::Result<Self> {
        if let Some(address) = to {
            let stream = TcpStream::connect(address)?;
            stream.set_nodelay(true)?;
            return Ok(Sink { to: Box::new(stream), read: None, lost: 0 });
        }
        let (near, mut far) = UnixStream::pair()?;
        let read = Arc::new(AtomicU64::new(0));
        let count = Arc::clone(&read);
        // Ends with the process: its other end lives in this program's only loop.
        std::thread::spawn(move || {
            let mut buffer = vec![0; 1 << 16];
            while let Ok(n @ 1..) = far.read(&mut buffer) {
                count.fetch_add(n as u64, Ordering::Relaxed);
            }
        });
        Ok(Sink { to: Box::new(near), read: Some(read), lost: 0 })
    }

    /// Returns how many bytes went.
    fn send(&mut self, code: &[u8]) -> usize {
        let length = u32::try_from(code.len()).unwrap_or(u32::MAX).to_be_bytes();
        match self.to.write_all(&length).and_then(|()| self.to.write_all(code)) {
            Ok(()) => length.len() + code.len(),
            // A camera without a watcher still watches.
            Err(_) => {
                self.lost += 1;
                0
            }
        }
    }

    fn received(&self) -> Value {
        self.read.as_ref().map_or(Value::Null, |n| json!(n.load(Ordering::Relaxed)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_sent_arrives() {
        let mut sink = Sink::open(None).unwrap();
        assert_eq!(sink.send(&[7; 1000]), 1004);
        let until = std::time::Instant::now() + std::time::Duration::from_secs(10);
        while sink.received() != json!(1004) && std::time::Instant::now() < until {
            std::thread::yield_now();
        }
        assert_eq!((sink.received(), sink.lost), (json!(1004), 0));
    }

    #[test]
    fn a_watcher_that_left_costs_frames_and_no_more() {
        let (near, far) = UnixStream::pair().unwrap();
        drop(far);
        let mut sink = Sink { to: Box::new(near), read: None, lost: 0 };
        assert_eq!((sink.send(&[1]), sink.lost), (0, 1));
    }
}
