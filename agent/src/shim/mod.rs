//! The shim: the small process that stands over one attempt and outlives the agent. Synchronous, one
//! thread, no runtime.
//!
//! It starts the program inside its group, keeps its output, and when the program ends, or the agent
//! orders it, or contact was lost for too long, it ends *everything* of the attempt and then writes
//! the exit record. An exit record therefore says that no process is left.
//!
//! | module | holds |
//! |---|---|
//! | `guard` | the same for a container: only the deadline of contact |
//! | `start` | fork, the steps between fork and exec, and which of them failed |
//! | `watch` | signals, timer, pipes: one poll loop around the kill ladder |
//! | `output` | pipes → rotated log files |
//!
//! It is a hidden verb of the agent's binary: `… shim DIR --lock-fd N`. Its standard input holds the variables of
//! ConfigMaps and Secrets, which are in no file. Its standard output is a pipe
//! to the agent, which gets one byte: `R` the program runs, `E` it is over already.

mod guard;
mod output;
pub(crate) mod start;
mod watch;

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::File;
use std::io::{Read as _, Write};
use std::os::fd::{AsFd, FromRawFd, OwnedFd, RawFd};
use std::path::PathBuf;
use std::time::Duration;

use muster_agent_core::observed::{End, Exit};
use muster_failpoint::{self as failpoint, Failpoint, Step};
use rustix::io::FdFlags;

use crate::clock;
use crate::durable::FileError;
use crate::runtime::process::attempt::{AttemptDir, Begun, Order, Process, Running};
use crate::runtime::process::reach::{Reach, mark};
use crate::runtime::process::scan;
use start::StartError;

/// The verb that both binaries know.
pub const VERB: &str = "shim";

/// Signals that the shim reads from a descriptor; blocked before it is executed, so that none can
/// end it before it listens.
pub(crate) const SIGNALS: [i32; 6] =
    [libc::SIGCHLD, libc::SIGUSR1, libc::SIGTERM, libc::SIGINT, libc::SIGHUP, libc::SIGQUIT];

/// Told to the agent when the program runs.
pub(crate) const RUNNING: u8 = b'R';
/// Told to the agent when there is an exit record already.
pub(crate) const ENDED: u8 = b'E';

#[derive(Debug, thiserror::Error)]
enum ShimError {
    #[error("usage: {VERB} DIR --lock-fd N")]
    Usage,
    #[error("there is no order in {0}")]
    NoOrder(PathBuf),
    #[error("the attempt's files failed")]
    File(#[from] FileError),
    #[error("failed to {what}")]
    System {
        what: &'static str,
        #[source]
        source: std::io::Error,
    },
}

impl ShimError {
    fn system<E: Into<std::io::Error>>(what: &'static str) -> impl FnOnce(E) -> ShimError {
        move |source| ShimError::System { what, source: source.into() }
    }
}

/// Runs the shim with the arguments after the verb, and ends the process.
pub fn main(args: impl IntoIterator<Item = OsString>) -> ! {
    let code = match parse(args).and_then(|(dir, lock)| run(&dir, &lock)) {
        Ok(()) => 0,
        Err(error) => {
            let mut text = format!("muster shim: {error}");
            let mut cause = std::error::Error::source(&error);
            while let Some(source) = cause {
                text.push_str(": ");
                text.push_str(&source.to_string());
                cause = source.source();
            }
            // Standard error is a file beside the attempt; nobody else is listening.
            let _ = writeln!(std::io::stderr(), "{text}");
            1
        }
    };
    std::process::exit(code)
}

fn parse(args: impl IntoIterator<Item = OsString>) -> Result<(AttemptDir, OwnedFd), ShimError> {
    let args: Vec<OsString> = args.into_iter().collect();
    let [dir, flag, fd] = args.as_slice() else { return Err(ShimError::Usage) };
    let fd: RawFd = fd.to_str().and_then(|fd| fd.parse().ok()).ok_or(ShimError::Usage)?;
    if flag != "--lock-fd" || fd <= 2 {
        return Err(ShimError::Usage);
    }
    // SAFETY: the agent left exactly this descriptor open for the shim; nothing else here owns it.
    let lock = unsafe { OwnedFd::from_raw_fd(fd) };
    // The lock must end with the shim, so the program must not inherit it.
    rustix::io::fcntl_setfd(&lock, FdFlags::CLOEXEC).map_err(ShimError::system("keep the lock"))?;
    Ok((AttemptDir::new(PathBuf::from(dir)), lock))
}

fn run(dir: &AttemptDir, lock: &OwnedFd) -> Result<(), ShimError> {
    let order = dir.order()?.ok_or_else(|| ShimError::NoOrder(dir.path().to_owned()))?;
    // Orphans of the attempt come to the shim and not to init: it reaps them, and finds them even
    // without a group.
    let me = rustix::process::getpid();
    rustix::process::set_child_subreaper(Some(me)).map_err(ShimError::system("adopt orphans"))?;
    let signals = watch::Signals::open().map_err(ShimError::system("open the signals"))?;
    let shim = scan::process(me.as_raw_nonzero().get())
        .unwrap_or_else(|| Process { pid: me.as_raw_nonzero().get(), start_time: 0 });
    dir.write_begun(&Begun { shim, boot_id: order.boot_id.clone() })?;

    if let Some(guarded) = order.guarded {
        return guard::guard(dir, &order, guarded, &signals);
    }
    let started = match take_variables().and_then(|given| start::start(&order, &given)) {
        Ok(started) => started,
        Err(error) => {
            remove_group(&order);
            let exit = Exit {
                end: End::NotStarted { message: error.to_string() },
                oom_killed: false,
                disconnected: false,
                started_at: None,
                finished_at: clock::wall(),
            };
            write_exit(dir, &exit)?;
            tell(ENDED);
            return Ok(());
        }
    };
    let at = clock::wall();
    let process = scan::process(started.pid).unwrap_or(Process { pid: started.pid, start_time: 0 });
    let mut birth = Birth { dir, running: Running { process, at }, told: false };
    birth.tell();

    let reach = reach(&order, shim.pid, Some(started.pid));
    let ended = watch::watch(&mut birth, &order, &reach, started, &signals)?;
    let exit = Exit {
        end: ended.end,
        oom_killed: reach.oom_kills() > 0,
        disconnected: ended.disconnected,
        started_at: Some(at),
        finished_at: clock::wall(),
    };
    remove_group(&order);
    write_exit(dir, &exit)?;
    if !birth.told {
        tell(ENDED);
    }
    // Held to here on purpose: whoever gets the lock finds the record.
    let _ = lock.as_fd();
    Ok(())
}

/// The record that the program runs, and the word about it to the agent.
#[derive(Debug)]
struct Birth<'a> {
    dir: &'a AttemptDir,
    running: Running,
    told: bool,
}

impl Birth<'_> {
    /// Whether it is written and told. A disk that is full may have room later: the program is watched meanwhile, and what
    /// is not written is not said to run.
    fn tell(&mut self) -> bool {
        if !self.told && self.dir.write_running(&self.running).is_ok() {
            tell(RUNNING);
            self.told = true;
        }
        self.told
    }
}

/// Between two tries to write on a disk that is full.
const FULL_PAUSE: Duration = Duration::from_millis(200);

/// Keeps how the attempt ended; nobody else knows it. A disk that is full is waited for.
fn write_exit(dir: &AttemptDir, exit: &Exit) -> Result<(), FileError> {
    loop {
        match dir.write_exit(exit) {
            Err(error) if error.is_full() => std::thread::sleep(FULL_PAUSE),
            done => return done,
        }
    }
}

/// How the processes of an attempt are found.
pub(crate) fn reach(order: &Order, shim: i32, session: Option<i32>) -> Reach {
    match &order.group {
        Some(group) => Reach::Group(group.clone()),
        None => Reach::Tree { shim, session, mark: mark(&order.launch.id) },
    }
}

/// The numbers of a `user` field, if there is such a user.
pub(crate) fn user_ids(user: &str) -> Option<(u32, u32)> {
    start::ids(user)
}

/// Variables that are in no file. Afterwards they are nowhere but in the program's environment.
fn take_variables() -> Result<BTreeMap<OsString, OsString>, StartError> {
    let failed = |source| StartError::Step { step: "read its variables", source };
    let mut text = Vec::new();
    std::io::stdin().read_to_end(&mut text).map_err(failed)?;
    if text.is_empty() {
        return Ok(BTreeMap::new());
    }
    let null = File::open("/dev/null").map_err(failed)?;
    rustix::stdio::dup2_stdin(null).map_err(|errno| failed(errno.into()))?;
    let given: BTreeMap<String, String> = serde_json::from_slice(&text)
        .map_err(|_| StartError::Order("its variables cannot be read".to_owned()))?;
    Ok(given.into_iter().map(|(name, value)| (name.into(), value.into())).collect())
}

fn remove_group(order: &Order) {
    failpoint::reach(Failpoint::GroupRemoval, Step::Before);
    if let Some(group) = &order.group
        && let Err(error) = group.remove()
    {
        // The agent's next sweep takes it away; the attempt has ended all the same.
        let _ = writeln!(std::io::stderr(), "muster shim: the group stays behind: {error}");
    }
    failpoint::reach(Failpoint::GroupRemoval, Step::After);
}

/// One byte to the agent, which may be gone; then the pipe is let go.
fn tell(byte: u8) {
    let mut out = std::io::stdout();
    let _ = out.write_all(&[byte]);
    let _ = out.flush();
    if let Ok(null) = File::options().write(true).open("/dev/null") {
        let _ = rustix::stdio::dup2_stdout(null);
    }
}
