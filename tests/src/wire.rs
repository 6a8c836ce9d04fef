//! A wire between two network namespaces, with a delay, losses, a rate and cuts of its own in each direction.
//!
//! ```text
//!   near namespace ── tun ──▶ reader ── cut? lost? queue full? ──▶ (when it is due) ──▶ writer ── tun ──▶ far namespace
//!                     tun ◀── writer ◀─────────────────────────────────────────────── reader ◀── tun
//! ```
//!
//! It is what `tc netem` does, on kernels that have no netem, and each direction can be cut alone while packets are on their
//! way: nothing is answered then, as when a robot drives behind a lift. One thread carries both directions.

use std::io;
use std::os::fd::{AsFd as _, OwnedFd};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rustix::fs::{Mode, OFlags};
use tokio::io::unix::AsyncFd;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::dice::Dice;
use crate::netns::{Namespace, ip};

/// Packets that wait where the rate is the bottleneck, bytes: a Wi-Fi router's buffer.
const QUEUE: f64 = 256.0 * 1024.0;
/// The longest packet of a TUN device.
const MTU: usize = 1_500;

/// What one direction does to packets.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Way {
    /// Nothing arrives.
    pub cut: bool,
    /// The share of packets that are lost, 0 to 1.
    pub loss: f64,
    /// How long a packet is on its way.
    pub delay: Duration,
    /// Bits per second; none: as fast as the machine.
    pub rate: Option<f64>,
}

impl Way {
    /// At once, and all.
    pub const CLEAR: Way = Way { cut: false, loss: 0.0, delay: Duration::ZERO, rate: None };
    /// Nothing.
    pub const CUT: Way = Way { cut: true, ..Way::CLEAR };
}

/// What one direction does now.
type Lane = Arc<Mutex<Way>>;

/// A wire, until it is dropped.
#[derive(Debug)]
pub struct Wire {
    down: Lane,
    up: Lane,
    stop: CancellationToken,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Wire {
    /// Lays the `number`th wire from the calling thread's namespace to `far`, whose default route it becomes.
    ///
    /// # Panics
    ///
    /// When the kernel refuses it.
    #[must_use]
    pub fn lay(number: u8, far: &Namespace) -> Wire {
        let (here, there) = (format!("10.99.{number}.1"), format!("10.99.{number}.2"));
        let name = format!("wire{number}");
        let near_end = device(&name, &here, &there);
        let far_end = far.run({
            let name = name.clone();
            move || {
                let end = device(&name, &there, &here);
                ip(&format!("route add default via {here}"));
                end
            }
        });
        let (down, up, stop) = (Lane::default(), Lane::default(), CancellationToken::new());
        let thread = std::thread::Builder::new().name(name).spawn({
            let (down, up, stop) = (down.clone(), up.clone(), stop.clone());
            move || {
                let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
                runtime.expect("a runtime").block_on(async {
                    let (near, far) = (watched(near_end), watched(far_end));
                    tokio::select! {
                        () = carry(near.clone(), far.clone(), down, u64::from(number) * 2 + 1) => {}
                        () = carry(far, near, up, u64::from(number) * 2 + 2) => {}
                        () = stop.cancelled() => {}
                    }
                });
            }
        });
        Wire { down, up, stop, thread: Some(thread.expect("a thread")) }
    }

    /// What happens from now on to packets towards the far end, and to those that come from it.
    pub fn shape(&self, down: Way, up: Way) {
        *self.down.lock().expect("nobody panics with it") = down;
        *self.up.lock().expect("nobody panics with it") = up;
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        self.stop.cancel();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// To be read and written when the kernel says so.
fn watched(end: OwnedFd) -> Arc<AsyncFd<OwnedFd>> {
    // SAFETY: the `AsyncFd` owns the descriptor, and nobody takes it out or closes it meanwhile.
    #[expect(unsafe_code, reason = "the safe constructor is deprecated as unsound")]
    let end = unsafe { AsyncFd::register(end) };
    Arc::new(end.expect("a TUN device can be polled"))
}

/// Carries packets one way, for ever.
async fn carry(from: Arc<AsyncFd<OwnedFd>>, to: Arc<AsyncFd<OwnedFd>>, lane: Lane, seed: u64) {
    let (send, mut due) = mpsc::unbounded_channel::<(Instant, Vec<u8>)>();
    let arrive = async move {
        while let Some((at, packet)) = due.recv().await {
            tokio::time::sleep_until(at).await;
            let _ = write(&to, &packet).await;
        }
    };
    let leave = async move {
        let mut dice = Dice::new(seed);
        let (mut free_at, mut last) = (Instant::now(), Instant::now());
        loop {
            let Ok(packet) = read(&from).await else { return };
            let way = *lane.lock().expect("nobody panics with it");
            if way.cut || dice.share() < way.loss {
                continue;
            }
            let now = Instant::now();
            free_at = free_at.max(now);
            if let Some(rate) = way.rate {
                let waiting = (free_at - now).as_secs_f64() * rate / 8.0;
                if waiting > QUEUE {
                    continue;
                }
                free_at += Duration::from_secs_f64(packet.len() as f64 * 8.0 / rate);
            }
            // In order, also when the delay has become shorter.
            last = last.max(free_at + way.delay);
            let _ = send.send((last, packet));
        }
    };
    tokio::join!(arrive, leave);
}

async fn read(end: &AsyncFd<OwnedFd>) -> io::Result<Vec<u8>> {
    let mut packet = vec![0; MTU];
    loop {
        let mut ready = end.readable().await?;
        match ready.try_io(|end| Ok(rustix::io::read(end.get_ref().as_fd(), &mut packet)?)) {
            Ok(read) => {
                packet.truncate(read?);
                return Ok(packet);
            }
            Err(_not_yet) => {}
        }
    }
}

async fn write(end: &AsyncFd<OwnedFd>, packet: &[u8]) -> io::Result<()> {
    loop {
        let mut ready = end.writable().await?;
        match ready.try_io(|end| Ok(rustix::io::write(end.get_ref().as_fd(), packet)?)) {
            Ok(written) => return written.map(drop),
            Err(_not_yet) => {}
        }
    }
}

/// A TUN device in the calling thread's namespace, with an address, whose only neighbour is `peer`.
fn device(name: &str, address: &str, peer: &str) -> OwnedFd {
    let flags = OFlags::RDWR | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let end = rustix::fs::open("/dev/net/tun", flags, Mode::empty());
    let end = end.expect("the kernel has TUN devices, and root may open them");
    attach(&end, name).expect("a name that is free");
    ip(&format!("addr add {address} peer {peer} dev {name}"));
    ip(&format!("link set {name} up mtu {MTU}"));
    end
}

/// `struct ifreq` of `TUNSETIFF`: a name, and flags.
#[repr(C)]
struct Request {
    name: [u8; 16],
    flags: u16,
    rest: [u8; 22],
}

/// `IFF_TUN | IFF_NO_PI`: packets of IP, and nothing before them.
const TUN_BARE: u16 = 0x1001;

fn attach(end: &OwnedFd, name: &str) -> rustix::io::Result<()> {
    const TUNSETIFF: rustix::ioctl::Opcode = rustix::ioctl::opcode::write::<i32>(b'T', 202);
    let mut request = Request { name: [0; 16], flags: TUN_BARE, rest: [0; 22] };
    request.name[..name.len()].copy_from_slice(name.as_bytes());
    // SAFETY: the call reads (and writes) one `struct ifreq`, which this is laid out as.
    #[expect(unsafe_code, reason = "no crate of ours wraps this call")]
    unsafe {
        rustix::ioctl::ioctl(end, rustix::ioctl::Updater::<TUNSETIFF, Request>::new(&mut request))
    }
}
