//! The poll loop: everything that can happen to a running attempt.

use std::io;
use std::os::fd::{AsFd, FromRawFd, OwnedFd};
use std::time::Duration;

use muster_agent_core::desired::StopTimes;
use muster_agent_core::observed::End;
use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, timerfd_create, timerfd_settime,
};

use super::output::{Log, Pump};
use super::start::Started;
use super::{Birth, FULL_PAUSE, SIGNALS, ShimError};
use crate::clock;
use crate::runtime::contact::ContactFile;
use crate::runtime::process::attempt::{AttemptDir, Order};
use crate::runtime::process::reach::{Ladder, Reach};

/// Signals as a descriptor.
#[derive(Debug)]
pub(super) struct Signals(pub(super) OwnedFd);

impl Signals {
    /// Blocks the shim's signals and opens their descriptor.
    pub(super) fn open() -> io::Result<Signals> {
        // SAFETY: the set is initialised by sigemptyset before anything reads it.
        let fd = unsafe {
            let mut set = std::mem::zeroed::<libc::sigset_t>();
            libc::sigemptyset(&raw mut set);
            for signal in SIGNALS {
                libc::sigaddset(&raw mut set, signal);
            }
            if libc::sigprocmask(libc::SIG_BLOCK, &raw const set, std::ptr::null_mut()) == -1 {
                return Err(io::Error::last_os_error());
            }
            libc::signalfd(-1, &raw const set, libc::SFD_CLOEXEC | libc::SFD_NONBLOCK)
        };
        if fd == -1 {
            return Err(io::Error::last_os_error());
        }
        // SAFETY: a new descriptor that nothing else owns.
        Ok(Signals(unsafe { OwnedFd::from_raw_fd(fd) }))
    }

    pub(super) fn take(&self) -> Option<i32> {
        let mut info = [0_u8; size_of::<libc::signalfd_siginfo>()];
        match rustix::io::read(&self.0, &mut info) {
            Ok(size) if size == info.len() => {
                Some(i32::from_ne_bytes([info[0], info[1], info[2], info[3]]))
            }
            _ => None,
        }
    }
}

/// How the attempt ended.
#[derive(Debug)]
pub(super) struct Ended {
    pub(super) end: End,
    pub(super) disconnected: bool,
}

struct Watch<'a> {
    dir: &'a AttemptDir,
    order: &'a Order,
    main: i32,
    end: Option<End>,
    ladder: Ladder,
    contact: Option<Contact>,
    disconnected: bool,
}

/// Returns when no process of the attempt is left.
pub(super) fn watch(
    birth: &mut Birth<'_>,
    order: &Order,
    reach: &Reach,
    started: Started,
    signals: &Signals,
) -> Result<Ended, ShimError> {
    let dir = birth.dir;
    let mut log = Log::open(dir.log(), order.log);
    let pump = |fd, name| Pump::new(fd, name).map_err(ShimError::system("read its output"));
    let mut pumps = [pump(started.stdout, "stdout")?, pump(started.stderr, "stderr")?];
    let mut watch = Watch {
        dir,
        order,
        main: started.pid,
        end: None,
        ladder: Ladder::Idle,
        contact: Contact::open(order).map_err(ShimError::system("watch the contact"))?,
        disconnected: false,
    };
    let stop = order.launch.stop_signal;
    // An order may have come before anybody listened.
    watch.look_for_order();
    let end = loop {
        watch.reap();
        let pause = match (&watch.end, reach) {
            (Some(end), reach) if reach.is_empty() => break end.clone(),
            (Some(_), _) => {
                // The program is the attempt: what it leaves behind does not live on.
                if watch.ladder.is_idle() {
                    watch.ladder.kill();
                }
                watch.ladder.signal_now();
                watch.ladder.step(reach, stop)
            }
            _ => watch.ladder.step(reach, stop),
        };
        let again = (!birth.tell()).then_some(FULL_PAUSE);
        let pause = [pause, again].into_iter().flatten().min();
        watch.pause(signals, &mut pumps, &mut log, pause)?;
    };
    for pump in &mut pumps {
        pump.drain(&mut log);
        pump.finish(&mut log);
    }
    Ok(Ended { end, disconnected: watch.disconnected })
}

impl Watch<'_> {
    /// Waits for something to happen and takes it in.
    fn pause(
        &mut self,
        signals: &Signals,
        pumps: &mut [Pump; 2],
        log: &mut Log,
        pause: Option<Duration>,
    ) -> Result<(), ShimError> {
        let timeout = pause.map(|pause| Timespec {
            tv_sec: i64::try_from(pause.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: pause.subsec_nanos().into(),
        });
        let mut fds = vec![PollFd::new(&signals.0, PollFlags::IN)];
        fds.extend(self.contact.as_ref().map(|contact| PollFd::new(&contact.timer, PollFlags::IN)));
        fds.extend(
            pumps.iter().filter_map(Pump::fd).map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN)),
        );
        match rustix::event::poll(&mut fds, timeout.as_ref()) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(errno) => return Err(ShimError::system("wait")(errno)),
        }
        // All sources are non-blocking: each is simply asked.
        while let Some(signal) = signals.take() {
            if signal == libc::SIGUSR1 {
                self.look_for_order();
            }
        }
        if self.contact.as_mut().is_some_and(Contact::is_lost) && !self.disconnected {
            self.disconnected = true;
            self.ladder.stop(StopTimes { signal_ms: 0, kill_ms: self.order.launch.grace_ms });
        }
        for pump in pumps {
            pump.drain(log);
        }
        Ok(())
    }

    fn look_for_order(&mut self) {
        // A file that cannot be read is an order all the same, without grace to wait for.
        let times = match self.dir.stop() {
            Ok(None) => return,
            Ok(Some(stop)) => StopTimes { signal_ms: stop.signal_ms, kill_ms: stop.grace_ms },
            Err(_) => StopTimes { signal_ms: 0, kill_ms: 0 },
        };
        self.ladder.stop(times);
    }

    fn reap(&mut self) {
        loop {
            let mut status = 0;
            // SAFETY: a pointer to a local.
            let pid = unsafe { libc::waitpid(-1, &raw mut status, libc::WNOHANG) };
            if pid <= 0 {
                return;
            }
            if pid == self.main {
                self.end = Some(if libc::WIFSIGNALED(status) {
                    End::Signaled(libc::WTERMSIG(status))
                } else {
                    End::Exited(libc::WEXITSTATUS(status))
                });
            }
        }
    }
}

/// The deadline of a task that may not run without contact.
pub(super) struct Contact {
    file: ContactFile,
    pub(super) timer: OwnedFd,
    after_ms: u64,
    /// Contact before the attempt began does not count against it.
    floor: muster_agent_core::time::Boot,
}

impl Contact {
    pub(super) fn open(order: &Order) -> io::Result<Option<Contact>> {
        let Some(after_ms) = order.launch.stop_after_ms else { return Ok(None) };
        let file = ContactFile::open(&order.contact, &order.boot_id)?;
        let timer = timerfd_create(
            TimerfdClockId::Boottime,
            TimerfdFlags::CLOEXEC | TimerfdFlags::NONBLOCK,
        )?;
        let floor = if file.read().is_some() { Default::default() } else { clock::boot() };
        let mut contact = Contact { file, timer, after_ms, floor };
        contact.is_lost();
        Ok(Some(contact))
    }

    /// Whether the time has passed; if not, the timer is set for when it may.
    pub(super) fn is_lost(&mut self) -> bool {
        let mut expirations = [0; 8];
        let _ = rustix::io::read(&self.timer, &mut expirations);
        let last = self.file.read().unwrap_or_default().max(self.floor);
        let until = last.plus(self.after_ms);
        if clock::boot() >= until {
            return true;
        }
        let at = Timespec {
            tv_sec: i64::try_from(until.0 / 1_000).unwrap_or(i64::MAX),
            tv_nsec: i64::try_from(until.0 % 1_000 * 1_000_000).unwrap_or(0),
        };
        let never = Timespec { tv_sec: 0, tv_nsec: 0 };
        let spec = Itimerspec { it_interval: never, it_value: at };
        // A timer that cannot be set counts as contact lost: the side that is safe.
        timerfd_settime(self.timer.as_fd(), TimerfdTimerFlags::ABSTIME, &spec).is_err()
    }
}
