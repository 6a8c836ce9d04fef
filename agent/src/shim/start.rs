//! From fork to exec.
//!
//! Order in the child: enter the group and the network (while it still has the rights to), new session, user,
//! directory, exec. The program is in its group before its first instruction. A check of a running task (see
//! [`crate::runtime::process`]) goes the same way, so that it finds what the task's program finds.

use std::collections::BTreeMap;
use std::ffi::{CString, OsString};
use std::fmt;
use std::io;
use std::os::fd::{AsRawFd, OwnedFd, RawFd};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use rustix::pipe::PipeFlags;

use crate::runtime::launch::{Network, Program};
use crate::runtime::process::attempt::{Order, Process};
use crate::runtime::process::reach::mark;
use crate::runtime::process::scan;

/// A program that runs.
#[derive(Debug)]
pub(super) struct Started {
    /// Also its session and process group.
    pub(super) pid: i32,
    pub(super) stdout: OwnedFd,
    pub(super) stderr: OwnedFd,
}

/// Why the program does not run.
#[derive(Debug)]
pub(crate) enum StartError {
    /// The order cannot be carried out at all.
    Order(String),
    /// The kernel refused a step.
    Step { step: &'static str, source: io::Error },
}

impl fmt::Display for StartError {
    /// For the task's owner, who sees no chain of causes: the kernel's words are part of it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            StartError::Order(text) => f.write_str(text),
            StartError::Step { step, source } => write!(f, "failed to {step}: {source}"),
        }
    }
}

/// Steps in the child, told to the parent by number.
const STEPS: [&str; 10] = [
    "execute",
    "enter its control group",
    "make its network",
    "make its session",
    "take its groups",
    "become its user",
    "enter its working directory",
    "reset its signals",
    "tie it to the agent",
    "give up new privileges",
];

#[derive(Debug)]
struct Identity {
    uid: u32,
    gid: u32,
    groups: Vec<libc::gid_t>,
    home: Option<String>,
}

pub(super) fn start(
    order: &Order,
    given: &BTreeMap<OsString, OsString>,
) -> Result<Started, StartError> {
    let Program::Process { argv, .. } = &order.launch.program else {
        return Err(StartError::Order("the order is for a container".to_owned()));
    };
    let pipe = || {
        rustix::pipe::pipe_with(PipeFlags::CLOEXEC)
            .map_err(|source| StartError::Step { step: "make its pipes", source: source.into() })
    };
    let ((stdout, child_stdout), (stderr, child_stderr)) = (pipe()?, pipe()?);
    let streams = Streams {
        stdin: Stdio::null(),
        stdout: child_stdout,
        stderr: child_stderr,
        terminal: false,
    };
    let child = spawn((order, given), argv, streams, None)?;
    Ok(Started { pid: child.id().cast_signed(), stdout, stderr })
}

/// A program's streams.
#[derive(Debug)]
pub(crate) struct Streams {
    pub(crate) stdin: Stdio,
    pub(crate) stdout: OwnedFd,
    pub(crate) stderr: OwnedFd,
    /// They are a terminal, and become that of its session.
    pub(crate) terminal: bool,
}

/// Starts `argv` where and as whom the order's own program was started, with these as its streams. `given`: variables that
/// are not in the order. `beside`: the order's own program, which runs; this one is in its network, and is killed when the
/// thread that called this ends.
pub(crate) fn spawn(
    (order, given): (&Order, &BTreeMap<OsString, OsString>),
    argv: &[String],
    streams: Streams,
    beside: Option<Process>,
) -> Result<std::process::Child, StartError> {
    let Program::Process { working_dir, user, network, .. } = &order.launch.program else {
        return Err(StartError::Order("the order is for a container".to_owned()));
    };
    let Some((program, args)) = argv.split_first() else {
        return Err(StartError::Order("the command is empty".to_owned()));
    };
    let system =
        |step| move |source: rustix::io::Errno| StartError::Step { step, source: source.into() };
    let identity = user.as_deref().map(identity).transpose()?;
    let dir = working_dir.clone().unwrap_or_else(|| order.work_dir.clone());
    let entrances = match &order.group {
        Some(group) => group
            .entrances()
            .map_err(|source| StartError::Step { step: "open its control group", source })?,
        None => Vec::new(),
    };
    let place = match (network, beside) {
        (Network::Host | Network::Bridge, _) => Place::Here,
        (Network::None, None) => Place::New,
        (Network::None, Some(process)) => {
            let open = |which| {
                scan::namespace(process, which)
                    .map_err(|source| StartError::Step { step: "find its network", source })
            };
            Place::Of([open("net")?, open("ipc")?])
        }
    };
    let (step_read, step_write) =
        rustix::pipe::pipe_with(PipeFlags::CLOEXEC).map_err(system("make its pipes"))?;

    let mut command = Command::new(program);
    command.args(args).env_clear();
    for name in ["PATH", "HOME"] {
        if let Some(value) = std::env::var_os(name) {
            command.env(name, value);
        }
    }
    if let Some(home) = identity.as_ref().and_then(|identity| identity.home.as_ref()) {
        command.env("HOME", home);
    }
    command.envs(&order.launch.env);
    command.envs(given);
    if let Some((name, value)) = mark(&order.launch.id).split_once('=') {
        command.env(name, value);
    }
    command.stdin(streams.stdin).stdout(streams.stdout).stderr(streams.stderr);
    let child = Child {
        terminal: streams.terminal,
        entrances: entrances.iter().map(AsRawFd::as_raw_fd).collect(),
        identity,
        dir: CString::new(dir.as_os_str().as_encoded_bytes())
            .map_err(|_| StartError::Order("the working directory holds a zero byte".to_owned()))?,
        step: step_write.as_raw_fd(),
        tied_to: beside.map(|_| std::process::id().cast_signed()),
        place,
    };
    // SAFETY: `Child::enter` makes only async-signal-safe system calls on memory made above.
    unsafe { command.pre_exec(move || child.enter()) };
    let spawned = command.spawn();
    drop((command, step_write, entrances));
    spawned.map_err(|source| failed_step(&step_read, program, &dir, source))
}

fn failed_step(
    read: &OwnedFd,
    program: &str,
    dir: &std::path::Path,
    source: io::Error,
) -> StartError {
    let mut byte = [0];
    let step = match rustix::io::read(read, &mut byte) {
        Ok(1) => usize::from(byte[0]),
        _ => 0,
    };
    let what = STEPS.get(step).copied().unwrap_or(STEPS[0]);
    match step {
        0 => StartError::Order(format!("failed to {what} {program:?}: {source}")),
        6 => StartError::Order(format!("failed to {what} {}: {source}", dir.display())),
        _ => StartError::Step { step: what, source },
    }
}

/// What the child needs between fork and exec. All of it was made before the fork.
struct Child {
    entrances: Vec<RawFd>,
    identity: Option<Identity>,
    dir: CString,
    step: RawFd,
    /// Its standard input is a terminal.
    terminal: bool,
    /// The process whose end is its end.
    tied_to: Option<i32>,
    place: Place,
}

/// Which network the child is in.
enum Place {
    /// That of whoever starts it.
    Here,
    /// One of its own, with a loopback.
    New,
    /// Another's: the namespaces.
    Of([OwnedFd; 2]),
}

/// The loopback of a new network is down, and without it there is no 127.0.0.1.
fn raise_loopback() -> bool {
    // SAFETY: a request that is all zeros is one; the name fits with its end, and both calls read and write that request alone.
    unsafe {
        let mut request = std::mem::zeroed::<libc::ifreq>();
        for (to, from) in request.ifr_name.iter_mut().zip(*b"lo") {
            *to = libc::c_char::from_ne_bytes([from]);
        }
        let socket = libc::socket(libc::AF_INET, libc::SOCK_DGRAM | libc::SOCK_CLOEXEC, 0);
        if socket == -1 || libc::ioctl(socket, libc::SIOCGIFFLAGS, &raw mut request) == -1 {
            return false;
        }
        request.ifr_ifru.ifru_flags |= libc::IFF_UP as libc::c_short;
        libc::ioctl(socket, libc::SIOCSIFFLAGS, &raw const request) != -1
            && libc::close(socket) == 0
    }
}

impl Child {
    fn enter(&self) -> io::Result<()> {
        for (step, done) in (1_u8..).zip([
            Child::enter_group as fn(&Child) -> bool,
            Child::enter_network,
            Child::make_session,
            Child::take_groups,
            Child::become_user,
            Child::enter_dir,
            Child::reset_signals,
            Child::tie,
            Child::renounce,
        ]) {
            if !done(self) {
                let error = io::Error::last_os_error();
                // SAFETY: a live descriptor and one byte on the stack.
                unsafe { libc::write(self.step, (&raw const step).cast(), 1) };
                return Err(error);
            }
        }
        Ok(())
    }

    fn enter_group(&self) -> bool {
        // SAFETY: live descriptors and one static byte. "0" is the writer itself.
        self.entrances.iter().all(|fd| unsafe { libc::write(*fd, c"0".as_ptr().cast(), 1) } == 1)
    }

    fn enter_network(&self) -> bool {
        // SAFETY: numbers only, and live descriptors.
        match &self.place {
            Place::Here => true,
            Place::New => unsafe {
                libc::unshare(libc::CLONE_NEWNET | libc::CLONE_NEWIPC) == 0 && raise_loopback()
            },
            Place::Of(both) => both.iter().all(|of| unsafe { libc::setns(of.as_raw_fd(), 0) } == 0),
        }
    }

    /// With a terminal of its own, which belongs to whom the program will be.
    fn make_session(&self) -> bool {
        let owner = self.identity.as_ref().map(|identity| identity.uid);
        // SAFETY: numbers only, and a descriptor that every program has.
        unsafe {
            libc::setsid() != -1
                && (!self.terminal
                    || libc::ioctl(0, libc::TIOCSCTTY, 0) == 0
                        && owner.is_none_or(|uid| libc::fchown(0, uid, libc::gid_t::MAX) == 0))
        }
    }

    fn take_groups(&self) -> bool {
        let Some(identity) = &self.identity else { return true };
        // SAFETY: a list and its length, made before the fork.
        unsafe {
            libc::setgroups(identity.groups.len(), identity.groups.as_ptr()) == 0
                && libc::setgid(identity.gid) == 0
        }
    }

    fn become_user(&self) -> bool {
        let Some(identity) = &self.identity else { return true };
        // SAFETY: a number.
        unsafe { libc::setuid(identity.uid) == 0 }
    }

    fn enter_dir(&self) -> bool {
        // SAFETY: a text that ends in zero, made before the fork.
        unsafe { libc::chdir(self.dir.as_ptr()) == 0 }
    }

    /// After the change of user, which would undo it.
    fn tie(&self) -> bool {
        let Some(parent) = self.tied_to else { return true };
        // SAFETY: numbers only. A parent that was gone before the call is seen by the second.
        unsafe {
            libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) == 0 && libc::getppid() == parent
        }
    }
}

impl Child {
    /// No program that it runs gains what it has not: `setuid` bits and capabilities of files count for nothing.
    fn renounce(&self) -> bool {
        // SAFETY: numbers only.
        unsafe { libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 }
    }

    /// The shim blocks what it reads from a descriptor, and may itself have been started with signals
    /// ignored. Both pass through exec, and a program that never hears SIGTERM would always be killed.
    fn reset_signals(&self) -> bool {
        // SAFETY: numbers, and a set that sigemptyset initialises before anything reads it.
        unsafe {
            for signal in 1..=libc::SIGRTMAX() {
                // Refused for SIGKILL, SIGSTOP and those that libc keeps; none of them can be ignored.
                libc::signal(signal, libc::SIG_DFL);
            }
            let mut none = std::mem::zeroed::<libc::sigset_t>();
            libc::sigemptyset(&raw mut none);
            libc::sigprocmask(libc::SIG_SETMASK, &raw const none, std::ptr::null_mut()) == 0
        }
    }
}

/// `name`, `name:group`, `uid` or `uid:gid` as numbers.
fn identity(user: &str) -> Result<Identity, StartError> {
    let (name, group) = match user.split_once(':') {
        Some((name, group)) => (name, Some(group)),
        None => (user, None),
    };
    let unknown =
        |what: &str, name: &str| StartError::Order(format!("there is no {what} {name:?}"));
    let passwd = passwd_line(name);
    let uid = match (&passwd, name.parse()) {
        (Some(line), _) => line.uid,
        (None, Ok(uid)) => uid,
        (None, Err(_)) => return Err(unknown("user", name)),
    };
    let gid = match group {
        None => passwd.as_ref().map_or(uid, |line| line.gid),
        Some(group) => match (group_line(group), group.parse()) {
            (Some(gid), _) | (None, Ok(gid)) => gid,
            (None, Err(_)) => return Err(unknown("group", group)),
        },
    };
    let mut groups = vec![gid];
    if let Some(line) = &passwd {
        groups.extend(groups_of(&line.name));
    }
    Ok(Identity { uid, gid, groups, home: passwd.map(|line| line.home) })
}

pub(super) fn ids(user: &str) -> Option<(u32, u32)> {
    identity(user).ok().map(|identity| (identity.uid, identity.gid))
}

struct Passwd {
    name: String,
    uid: u32,
    gid: u32,
    home: String,
}

/// By name or number, from the file: name services need threads and sockets that a shim has not.
fn passwd_line(wanted: &str) -> Option<Passwd> {
    let text = std::fs::read_to_string(PathBuf::from("/etc/passwd")).ok()?;
    text.lines().find_map(|line| {
        let fields: Vec<&str> = line.split(':').collect();
        let [name, _, uid, gid, _, home, ..] = fields.as_slice() else { return None };
        (*name == wanted || *uid == wanted).then_some(())?;
        Some(Passwd {
            name: (*name).to_owned(),
            uid: uid.parse().ok()?,
            gid: gid.parse().ok()?,
            home: (*home).to_owned(),
        })
    })
}

fn group_line(wanted: &str) -> Option<u32> {
    let text = std::fs::read_to_string("/etc/group").ok()?;
    text.lines().find_map(|line| {
        let fields: Vec<&str> = line.split(':').collect();
        (fields.first() == Some(&wanted)).then(|| fields.get(2)?.parse().ok()).flatten()
    })
}

fn groups_of(user: &str) -> Vec<libc::gid_t> {
    let text = std::fs::read_to_string("/etc/group").unwrap_or_default();
    text.lines()
        .filter_map(|line| {
            let fields: Vec<&str> = line.split(':').collect();
            let member = fields.get(3)?.split(',').any(|member| member == user);
            if member { fields.get(2)?.parse().ok() } else { None }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn users_by_name_and_number() {
        let root = identity("root").expect("every system has it");
        assert_eq!((root.uid, root.gid), (0, 0));
        let numbers = identity("12345:54321").expect("numbers need no entry");
        assert_eq!((numbers.uid, numbers.gid, numbers.groups), (12345, 54321, vec![54321]));
        let error = identity("nobody-of-that-name").expect_err("unknown");
        assert!(error.to_string().contains("nobody-of-that-name"), "{error}");
    }
}
