//! The guard of a container: waits until the container is gone, or contact is; then it ends the
//! container's processes, and says that it was it.

use muster_agent_core::desired::StopTimes;
use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::process::{Pid, PidfdFlags, pidfd_open};

use super::ShimError;
use super::watch::{Contact, Signals};
use crate::runtime::process::attempt::{AttemptDir, Order, Process};
use crate::runtime::process::reach::{Ladder, Reach};
use crate::runtime::process::scan;

pub(super) fn guard(
    dir: &AttemptDir,
    order: &Order,
    guarded: Process,
    signals: &Signals,
) -> Result<(), ShimError> {
    let contact = Contact::open(order).map_err(ShimError::system("watch the contact"))?;
    let (Some(mut contact), Some(group)) = (contact, order.group.clone()) else { return Ok(()) };
    let reach = Reach::Group(group);
    let Some(pid) = Pid::from_raw(guarded.pid) else { return Ok(()) };
    let first = match pidfd_open(pid, PidfdFlags::NONBLOCK) {
        Ok(fd) if scan::is_alive(guarded) => fd,
        // Over already.
        _ => return Ok(()),
    };
    let mut ladder = Ladder::Idle;
    loop {
        if ladder.is_idle() && contact.is_lost() {
            // Said first: whoever sees the end must find the reason.
            dir.write_disconnected()?;
            ladder.stop(StopTimes { signal_ms: 0, kill_ms: order.launch.grace_ms });
        }
        let pause = ladder.step(&reach, order.launch.stop_signal).map(|pause| Timespec {
            tv_sec: i64::try_from(pause.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: pause.subsec_nanos().into(),
        });
        let mut fds = [
            PollFd::new(&first, PollFlags::IN),
            PollFd::new(&contact.timer, PollFlags::IN),
            PollFd::new(&signals.0, PollFlags::IN),
        ];
        match rustix::event::poll(&mut fds, pause.as_ref()) {
            // A container ends with its first process.
            Ok(_) if fds[0].revents().contains(PollFlags::IN) => return Ok(()),
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(errno) => return Err(ShimError::system("wait")(errno)),
        }
        // A guard obeys nobody: signals are only taken off their queue.
        while signals.take().is_some() {}
    }
}
