//! The simulator's sockets, and its end.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};

use super::robot::Robot;
use super::settings::Settings;
use super::{CAMERA, DRIVE, LASER, STATE, SimError};
use crate::durable::FileError;
use crate::socket::listen;

/// A simulator to which nobody is connected ends after this; a restarted agent is back sooner.
pub(super) const LINGERS: Duration = Duration::from_secs(60);

/// Between two looks at where the robot is: twice as often as the controller is told.
const LOOK: Duration = Duration::from_millis(50);

/// It is said again at least so often, so that the agent knows that this simulator is not stuck.
const SAY_EVERY: Duration = Duration::from_secs(1);

/// Between two records of where it is: what a crash of the simulator takes it back.
const KEEP_EVERY: Duration = Duration::from_secs(1);

/// A command is at most so long, bytes.
const LONGEST: u64 = 4096;

/// How many are connected.
type Guests = watch::Sender<usize>;

/// One that is.
struct Guest<'a>(&'a Guests);

impl<'a> Guest<'a> {
    fn enter(guests: &'a Guests) -> Guest<'a> {
        guests.send_modify(|count| *count += 1);
        Guest(guests)
    }
}

impl Drop for Guest<'_> {
    fn drop(&mut self) {
        self.0.send_modify(|count| *count -= 1);
    }
}

/// What a connection is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stream {
    State,
    Laser,
    Camera,
}

/// Runs the robot of `dir` until it is told to end, or nobody is there.
pub(super) async fn serve(dir: &Path, settings: &Settings) -> Result<(), SimError> {
    let robot = Arc::new(Robot::open(dir, settings)?);
    let guests = Arc::new(Guests::default());
    let socket = |name: &str| {
        let path = dir.join(name);
        listen(&path, 0o600).map_err(FileError::at("listen at", &path))
    };
    let drive = socket(DRIVE)?;
    let every = |hz: f64| Duration::try_from_secs_f64(hz.recip()).unwrap_or(Duration::from_secs(1));
    let streams = [
        (Stream::State, socket(STATE)?, LOOK),
        (Stream::Laser, socket(LASER)?, every(settings.laser.hz)),
        (Stream::Camera, socket(CAMERA)?, every(settings.camera.hz)),
    ];
    let mut term = signal(SignalKind::terminate())
        .map_err(|source| SimError::System { what: "listen for signals", source })?;
    let mut tasks = JoinSet::new();
    for (stream, listener, every) in streams {
        tasks.spawn(offer(stream, listener, every, Arc::clone(&robot), Arc::clone(&guests)));
    }
    let driven = (Arc::clone(&robot), Arc::clone(&guests));
    tasks.spawn(async move { obey(drive, &driven.0, &driven.1).await });
    tracing::info!(at = ?robot.say(), "the robot is there");
    let ends = lonely(&guests);
    tokio::pin!(ends);
    let mut keeps = tokio::time::interval(KEEP_EVERY);
    keeps.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut kept = None;
    loop {
        // Cancel-safe: a signal, a future that is polled in place, and a tick.
        tokio::select! {
            _ = term.recv() => break,
            () = &mut ends => {
                tracing::info!("nobody is connected; the simulator ends");
                break;
            }
            _ = keeps.tick() => {
                let said = Some(robot.say());
                if said != kept {
                    keep(&robot).await;
                    kept = said;
                }
            }
        }
    }
    robot.stop();
    keep(&robot).await;
    Ok(())
}

async fn keep(robot: &Arc<Robot>) {
    let robot = Arc::clone(robot);
    let kept = tokio::task::spawn_blocking(move || robot.keep()).await;
    if let Ok(Err(error)) = kept {
        tracing::warn!(error = crate::driver::chain(&error), "where the robot is was not kept");
    }
}

/// Returns when nobody has been connected for [`LINGERS`].
async fn lonely(guests: &Guests) {
    let mut count = guests.subscribe();
    loop {
        // Closed: never, the caller holds the sender.
        let _ = count.wait_for(|count| *count == 0).await;
        if tokio::time::timeout(LINGERS, count.wait_for(|count| *count > 0)).await.is_err() {
            return;
        }
    }
}

/// Takes commands of one connection after the other. The end of each stops the robot.
async fn obey(listener: UnixListener, robot: &Robot, guests: &Guests) {
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            // Out of descriptors; the robot stands meanwhile.
            tokio::time::sleep(LOOK).await;
            continue;
        };
        let _guest = Guest::enter(guests);
        let mut lines = BufReader::new(stream);
        let mut line = Vec::new();
        loop {
            line.clear();
            match (&mut lines).take(LONGEST).read_until(b'\n', &mut line).await {
                Ok(1..) if line.ends_with(b"\n") => {}
                _ => break,
            }
            if let Err(why) = robot.command(&line) {
                tracing::warn!(why, "a command that is none; the robot stops");
                robot.stop();
            }
        }
        robot.stop();
    }
}

/// Serves everybody who comes for a stream.
async fn offer(
    stream: Stream,
    listener: UnixListener,
    every: Duration,
    robot: Arc<Robot>,
    guests: Arc<Guests>,
) {
    let mut talks = JoinSet::new();
    loop {
        // Cancel-safe: a listener and a join.
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((to, _)) => {
                    let (robot, guests) = (Arc::clone(&robot), Arc::clone(&guests));
                    talks.spawn(async move {
                        let _guest = Guest::enter(&guests);
                        // Whoever listened is gone.
                        let _ = match stream {
                            Stream::State => state(to, &robot).await,
                            Stream::Laser => frames(to, every, |number| robot.scan(number)).await,
                            Stream::Camera => frames(to, every, |number| robot.picture(number)).await,
                        };
                    });
                }
                Err(_) => tokio::time::sleep(LOOK).await,
            },
            Some(_) = talks.join_next() => {}
        }
    }
}

fn ticks(every: Duration) -> tokio::time::Interval {
    let mut ticks = tokio::time::interval(every);
    // Frames that nobody took in time are dropped, as a camera's would be.
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    ticks
}

async fn state(to: UnixStream, robot: &Robot) -> io::Result<()> {
    let (mut gone, mut to) = to.into_split();
    let mut ticks = ticks(LOOK);
    let (mut told, mut told_at) = (None, Instant::now());
    let say = async {
        loop {
            ticks.tick().await;
            let said = Some(robot.say());
            if said == told && told_at.elapsed() < SAY_EVERY {
                continue;
            }
            let mut line = serde_json::to_vec(&said)?;
            line.push(b'\n');
            to.write_all(&line).await?;
            (told, told_at) = (said, Instant::now());
        }
    };
    // Neither is polled again after the other has ended.
    tokio::select! {
        ended = say => ended,
        ended = closed(&mut gone) => ended,
    }
}

/// Frames, a big-endian 32-bit length before each.
async fn frames(to: UnixStream, every: Duration, frame: impl Fn(u64) -> Vec<u8>) -> io::Result<()> {
    let (mut gone, mut to) = to.into_split();
    let mut ticks = ticks(every);
    let send = async {
        for number in 0.. {
            ticks.tick().await;
            let frame = frame(number);
            let length = u32::try_from(frame.len()).map_err(io::Error::other)?;
            to.write_all(&length.to_be_bytes()).await?;
            to.write_all(&frame).await?;
        }
        Ok(())
    };
    // Neither is polled again after the other has ended.
    tokio::select! {
        ended = send => ended,
        ended = closed(&mut gone) => ended,
    }
}

/// Returns when the other side has gone; it has nothing to say.
async fn closed(from: &mut tokio::net::unix::OwnedReadHalf) -> io::Result<()> {
    let mut heard = [0; 64];
    while from.read(&mut heard).await? > 0 {}
    Ok(())
}
