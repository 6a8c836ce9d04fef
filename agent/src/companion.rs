//! A process beside the agent that outlives it: a robot's gate, a simulated robot. It is the agent's binary again, under a hidden
//! verb, with a directory of its own: its lock, its log, and a socket at which the agent finds it.
//!
//! [`main`] and [`lock`] are its side; [`start`] and [`keep`] are the agent's.

use std::error::Error;
use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write as _};
use std::os::fd::AsFd as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rustix::fs::FlockOperation;
use tokio::net::UnixStream;

use crate::driver::chain;
use crate::durable::FileError;

/// Between two looks for one that is not there. A robot may stand meanwhile, so it is short.
const AGAIN: Duration = Duration::from_millis(20);

/// Runs one with the arguments after its verb, which are its directory, and ends the process.
pub(crate) fn main<E: Error + 'static>(
    verb: &str,
    args: impl IntoIterator<Item = OsString>,
    run: impl FnOnce(PathBuf) -> Result<(), E>,
) -> ! {
    let args: Vec<OsString> = args.into_iter().collect();
    let ended = match args.as_slice() {
        [dir] => {
            let filter = tracing_subscriber::EnvFilter::try_from_default_env()
                .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
            tracing_subscriber::fmt().with_env_filter(filter).with_writer(io::stderr).init();
            run(PathBuf::from(dir)).map_err(|error| chain(&error))
        }
        _ => Err(format!("usage: {verb} DIR")),
    };
    if let Err(why) = &ended {
        // Its log; nobody else is listening.
        let _ = writeln!(io::stderr(), "muster {verb}: {why}");
    }
    std::process::exit(i32::from(ended.is_err()))
}

/// One event loop, one thread, and so many for files.
pub(crate) fn runtime(files: usize) -> io::Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_current_thread().enable_all().max_blocking_threads(files).build()
}

/// There is one in a directory. None: another one has it.
pub(crate) fn lock(dir: &Path) -> Result<Option<File>, FileError> {
    let path = dir.join("lock");
    let file = File::options().create(true).truncate(false).write(true).open(&path);
    let file = file.map_err(FileError::at("open", &path))?;
    match rustix::fs::flock(file.as_fd(), FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(Some(file)),
        Err(rustix::io::Errno::WOULDBLOCK) => Ok(None),
        Err(errno) => Err(FileError::at("lock", &path)(errno.into())),
    }
}

/// What it is set up with, in short.
pub(crate) fn digest(settings: &[u8]) -> String {
    let digest = ring::digest::digest(&ring::digest::SHA256, settings);
    digest.as_ref().iter().take(12).map(|byte| format!("{byte:02x}")).collect()
}

/// Starts one in `dir`, in a session of its own: what ends the agent's terminal or its group does not end it.
pub(crate) fn start(program: &Path, verb: &str, dir: &Path, log: File) -> io::Result<Child> {
    let mut command = Command::new(program);
    command.arg(verb).arg(dir).stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
    // SAFETY: setsid is async-signal-safe, and nothing else happens between fork and exec.
    unsafe {
        command.pre_exec(|| match libc::setsid() {
            -1 => Err(io::Error::last_os_error()),
            _ => Ok(()),
        });
    }
    command.spawn()
}

/// One that an agent keeps.
pub(crate) trait Kept {
    /// What it is called.
    const NAME: &str;
    /// Between two starts of one that ends before it has served.
    const START_AGAIN: Duration;

    /// Where it is found.
    fn socket(&self) -> PathBuf;

    /// Makes its directory what it has to be, and starts it there.
    fn start(&self) -> Result<Child, FileError>;

    /// Is with it until it is gone; whether it has served.
    fn attend(&self, stream: UnixStream) -> impl Future<Output = bool> + Send;

    /// It has ended before it has served.
    fn has_failed(&self) {}
}

/// Keeps one until dropped; the process stays. One that has served is started again at once.
pub(crate) async fn keep<K: Kept + Sync>(kept: &K) {
    let mut child: Option<Child> = None;
    let mut served = false;
    loop {
        // One that has ended must not stay a zombie.
        if let Some(process) = &mut child
            && matches!(process.try_wait(), Ok(Some(_)))
        {
            if !std::mem::take(&mut served) {
                kept.has_failed();
                tokio::time::sleep(K::START_AGAIN).await;
            }
            child = None;
        }
        match UnixStream::connect(kept.socket()).await {
            Ok(stream) => served |= kept.attend(stream).await,
            Err(_) if child.is_none() => {
                tracing::info!("starting the {}", K::NAME);
                match kept.start() {
                    Ok(started) => child = Some(started),
                    Err(error) => {
                        tracing::error!(error = chain(&error), "the {} does not start", K::NAME);
                        tokio::time::sleep(K::START_AGAIN).await;
                    }
                }
            }
            Err(_) => {}
        }
        tokio::time::sleep(AGAIN).await;
    }
}
