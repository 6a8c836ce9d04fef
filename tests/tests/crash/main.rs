//! Every durable step, and a process that is killed there: `muster_failpoint` lists them all. The process is started again
//! (by whoever starts it when it ends: the test, the agent), and everything is as it should be: nothing that was acknowledged is
//! lost, no attempt was begun twice, tasks come to their ends, leases come free, and nothing is left on the disk.
//!
//! What `kill -9` leaves is what the kernel was told so far, synced or not: a power cut is another matter, and not tested here.

mod containers;
mod controller;
mod crash;
mod executor;
mod joining;
mod robot;
mod tasks;

use muster_failpoint::Failpoint;

/// A test each, and what is killed in it. One that is missing here does not compile.
macro_rules! tests {
    ($($test:ident: $scenario:path => $($point:ident),+;)+) => {
        $(
            #[tokio::test(flavor = "multi_thread")]
            async fn $test() {
                $scenario(&[$(Failpoint::$point),+]).await;
            }
        )+

        const _: fn(Failpoint) = |point| match point {
            $($(Failpoint::$point)|+ => {})+
        };
    };
}

tests! {
    certificates_of_a_first_start: controller::first_start => CaPair, ServerPair, AdminPair;
    keys_and_kubeconfig_of_a_first_start: controller::first_start => EncryptionKey, Kubeconfig, StoreSchema;
    commits: controller::commits => StoreCommit;
    audit_lines: controller::audit_lines => AuditLine;
    full_audit_files: controller::audit_rotation => AuditRotation;
    older_keys: controller::reseal => StoreReseal;
    history: controller::compaction => StoreCompaction;

    joining: joining::join => AgentIdentity, AskedKey, JoinKey, JoinCa, JoinToken, JoinCertificate;
    after_joining: joining::join => AgentDeclared, VaultKey;
    joining_anew: joining::join_anew => FormerJoin;
    renewal: joining::renew => Renewal;

    records: tasks::records => TaskRecord;
    assignments: tasks::to_its_end => TaskDir, TaskGiven;
    launches: tasks::to_its_end => AttemptDirs, AttemptFiles, Group;
    orders_to_shims: tasks::to_its_end => ShimOrder, ShimStart;
    shims_that_begin: tasks::to_its_end => ShimBegun, ShimStarted;
    shims_that_end: tasks::to_its_end => GroupRemoval, ShimExit;
    removals: tasks::to_its_end => FilesRemoval, AttemptsRemoval, TaskRemoval;
    stops: tasks::stopped => StopOrder;
    lost_shims: tasks::shim_lost => LostShimExit;

    works: executor::works => WorkRecord;
    gates_simulators_and_sensors: robot::robot => SensorStatus, RosView, GateSettings, SimWorld, GateRecord, SimRobot;

    containers: containers::to_its_end => ContainerCreation, ContainerStart, ContainerRemoval;
    guards: containers::guarded => GuardOrder, Disconnected;
}
