//! Places where a test lets a process die, as `kill -9` would: before and after each durable step of controller, agent, shim
//! and gate.
//!
//! A test starts a daemon with `MUSTER_FAILPOINT=NAME:N:FILE`. The process that comes to NAME for the N-th time makes FILE, writes
//! its number into it, and kills itself. FILE is made once, so one process dies at it, whatever is started anew meanwhile: an
//! agent hands its environment on to shims, gate and simulator, of which each comes only to points of its own. Tasks' programs
//! do not have it.
//!
//! This is there in debug builds only: in a release build nothing is looked at, and [`reach`] is empty.
//!
//! Each is tested (`tests/tests/crash`): [`Failpoint`] is what the tests match over, so one without a test does not compile.

use std::fmt;

/// How far something has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Step {
    /// Nothing is done.
    Before,
    /// The file that will take the place of the other is there, and empty.
    Created,
    /// It is whole, and not in its place.
    Written,
    /// What was there is gone, and what comes is not in its place.
    Removed,
    /// One part of it is in its place.
    Half,
    /// It is done, and nobody was told.
    After,
}

/// A file that is replaced whole.
const FILE: &[Step] = &[Step::Before, Step::Created, Step::Written, Step::After];
/// One call.
const CALL: &[Step] = &[Step::Before, Step::After];
/// A key and its certificate.
const PAIR: &[Step] =
    &[Step::Before, Step::Created, Step::Written, Step::Removed, Step::Half, Step::After];
/// Something in two parts.
const PARTS: &[Step] = &[Step::Before, Step::Half, Step::After];

macro_rules! failpoints {
    ($($(#[$doc:meta])+ $point:ident = $name:literal $steps:ident,)+) => {
        /// What is made durable, or is done once and for all, and by whom.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Failpoint {
            $($(#[$doc])+ $point,)+
        }

        impl Failpoint {
            /// Every one.
            pub const ALL: &[Failpoint] = &[$(Failpoint::$point),+];

            fn name(self) -> &'static str {
                match self {
                    $(Failpoint::$point => $name,)+
                }
            }

            /// How far it can have come.
            #[must_use]
            pub fn steps(self) -> &'static [Step] {
                match self {
                    $(Failpoint::$point => $steps,)+
                }
            }
        }
    };
}

failpoints! {
    /// Controller: the store's tables.
    StoreSchema = "store-schema" CALL,
    /// Controller: a batch of objects, and who wrote them is not answered.
    StoreCommit = "store-commit" CALL,
    /// Controller: history is forgotten.
    StoreCompaction = "store-compaction" CALL,
    /// Controller: rows that were sealed with an older key are sealed anew.
    StoreReseal = "store-reseal" CALL,
    /// Controller: the keys of Secrets.
    EncryptionKey = "encryption-key" FILE,
    /// Controller: the authority's certificate and key.
    CaPair = "ca-pair" PAIR,
    /// Controller: the server's.
    ServerPair = "server-pair" PAIR,
    /// Controller: the administrator's.
    AdminPair = "admin-pair" PAIR,
    /// Controller: the administrator's kubeconfig.
    Kubeconfig = "kubeconfig" FILE,
    /// Controller: a line of the audit log.
    AuditLine = "audit-line" CALL,
    /// Controller: the audit log's files get the next numbers. Half: all but the present one have theirs.
    AuditRotation = "audit-rotation" PARTS,

    /// Agent: whose data directory it is.
    AgentIdentity = "agent-identity" FILE,
    /// Agent: what it declared.
    AgentDeclared = "agent-declared" FILE,
    /// Agent: the key that a join asks with.
    AskedKey = "asked-key" FILE,
    /// Agent: what an earlier join gave is removed.
    FormerJoin = "former-join" PARTS,
    /// Agent: the key of a join.
    JoinKey = "join-key" FILE,
    /// Agent: the authority of a join.
    JoinCa = "join-ca" FILE,
    /// Agent: by which token it joined.
    JoinToken = "join-token" FILE,
    /// Agent: the certificate of a join.
    JoinCertificate = "join-certificate" FILE,
    /// Agent: what a renewal gave.
    Renewal = "renewal" FILE,
    /// Agent: the key of what tasks are given.
    VaultKey = "vault-key" FILE,

    /// Agent: a task's directory.
    TaskDir = "task-dir" CALL,
    /// Agent: what is known of a task.
    TaskRecord = "task-record" FILE,
    /// Agent: what a task is given of ConfigMaps and Secrets.
    TaskGiven = "task-given" FILE,
    /// Agent: an attempt's directories.
    AttemptDirs = "attempt-dirs" CALL,
    /// Agent: an attempt's files of ConfigMaps and Secrets.
    AttemptFiles = "attempt-files" CALL,
    /// Agent: those of attempts that are over are removed.
    FilesRemoval = "files-removal" CALL,
    /// Agent: an attempt's control group. Half: made, without its limits.
    Group = "group" PARTS,
    /// Agent: what a shim is to start.
    ShimOrder = "shim-order" FILE,
    /// Agent: a shim is started.
    ShimStart = "shim-start" CALL,
    /// Agent: the order to end an attempt.
    StopOrder = "stop-order" FILE,
    /// Agent: the end of an attempt whose shim was killed.
    LostShimExit = "lost-shim-exit" FILE,
    /// Agent: the directories of a task's attempts are removed.
    AttemptsRemoval = "attempts-removal" CALL,
    /// Agent: a task is dropped. Half: its record is gone.
    TaskRemoval = "task-removal" PARTS,
    /// Agent: a work that is handed to an executor, and what became of it.
    WorkRecord = "work-record" FILE,
    /// Agent: how the sensors of a task stand.
    SensorStatus = "sensor-status" FILE,
    /// Agent: what the ROS master of a task's view knows.
    RosView = "ros-view" FILE,
    /// Agent: what a gate is set up with.
    GateSettings = "gate-settings" FILE,
    /// Agent: the world of a simulated robot.
    SimWorld = "sim-world" FILE,

    /// Agent: a container is made.
    ContainerCreation = "container-creation" CALL,
    /// Agent: a container is started.
    ContainerStart = "container-start" CALL,
    /// Agent: a container is removed.
    ContainerRemoval = "container-removal" CALL,
    /// Agent: what a container's guard is to do.
    GuardOrder = "guard-order" FILE,

    /// Shim: from here on a process may have been started.
    ShimBegun = "shim-begun" FILE,
    /// Shim: the program runs.
    ShimStarted = "shim-started" FILE,
    /// Shim: the attempt's control group is removed.
    GroupRemoval = "group-removal" CALL,
    /// Shim: how the attempt ended.
    ShimExit = "shim-exit" FILE,
    /// Guard: the attempt is ended for want of contact.
    Disconnected = "disconnected" FILE,

    /// Gate: the newest token, and what stops the robot.
    GateRecord = "gate-record" FILE,
    /// Simulator: where the robot is.
    SimRobot = "sim-robot" FILE,
}

/// One step of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Moment(pub Failpoint, pub Step);

impl fmt::Display for Moment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let step = match self.1 {
            Step::Before => "before",
            Step::Created => "created",
            Step::Written => "written",
            Step::Removed => "removed",
            Step::Half => "half",
            Step::After => "after",
        };
        write!(f, "{}.{step}", self.0.name())
    }
}

/// The variable that says where to die.
pub const VARIABLE: &str = "MUSTER_FAILPOINT";

/// Dies here, if that is where this process is to die.
#[cfg(not(debug_assertions))]
#[inline(always)]
pub fn reach(_: Failpoint, _: Step) {}

/// Dies here, if that is where this process is to die.
#[cfg(debug_assertions)]
pub fn reach(point: Failpoint, step: Step) {
    armed::reach(Moment(point, step));
}

#[cfg(debug_assertions)]
mod armed {
    use std::fs::OpenOptions;
    use std::io::Write as _;
    use std::path::PathBuf;
    use std::sync::OnceLock;
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::time::Duration;

    use rustix::process::{Signal, getpid, kill_process};

    use super::{Moment, VARIABLE};

    /// Where this process is to die.
    struct Target {
        name: String,
        /// How often it is to come there first.
        left: AtomicU32,
        file: PathBuf,
    }

    impl Target {
        fn read(text: &str) -> Option<Target> {
            let (name, rest) = text.split_once(':')?;
            let (times, file) = rest.split_once(':')?;
            let left = AtomicU32::new(times.parse().ok()?);
            Some(Target { name: name.to_owned(), left, file: file.into() })
        }
    }

    static TARGET: OnceLock<Option<Target>> = OnceLock::new();

    pub(super) fn reach(moment: Moment) {
        let read = || {
            let text = std::env::var(VARIABLE).ok()?;
            Some(Target::read(&text).unwrap_or_else(|| panic!("{VARIABLE}={text}: NAME:N:FILE")))
        };
        let Some(target) = TARGET.get_or_init(read) else { return };
        if target.name == moment.to_string() && target.left.fetch_sub(1, Ordering::Relaxed) == 1 {
            die(target);
        }
    }

    fn die(target: &Target) {
        // Whoever makes it dies; another process of this environment goes on.
        let made = OpenOptions::new().write(true).create_new(true).open(&target.file);
        let Ok(mut file) = made else { return };
        let pid = getpid();
        // It is dead whether that is written or not; the test finds an empty file then, and fails.
        let _ = writeln!(file, "{}", pid.as_raw_nonzero());
        let _ = kill_process(pid, Signal::KILL);
        loop {
            std::thread::sleep(Duration::from_secs(1));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn each_point_has_a_name_of_its_own() {
        let points = Failpoint::ALL
            .iter()
            .flat_map(|point| point.steps().iter().map(|step| Moment(*point, *step).to_string()));
        let names: Vec<String> = points.collect();
        let distinct: BTreeSet<&String> = names.iter().collect();
        assert_eq!(distinct.len(), names.len(), "{names:?}");
    }
}
