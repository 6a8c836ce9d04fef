//! The process runtime on cgroup v2, which is what robots run: a small guest with Debian's kernel, an
//! initramfs with the daemons, and in it the same end-to-end tests as on this machine: at the tree's
//! root, and in a group of the agent's own, as systemd makes one for a service.
//!
//! The guest has no disk and no network; what it says comes over its serial line.

mod archive;

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use archive::Archive;

/// Printed by the guest's init before the exit codes of the tests at the root and in a group.
const VERDICT: &str = "guest tests ended with ";

const INIT: &str = r#"#!/bin/sh
export PATH=/bin HOME=/tmp
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
mount -t cgroup2 cgroup /sys/fs/cgroup
mount -t tmpfs tmp /tmp
ip link set lo up
ln -s /t/agent/muster-agent /t/muster-agent
/t/deps/e2e quotas::process --nocapture --test-threads=1
plain=$?
rm /t/muster-agent

# As under systemd: a group for each start of the service, and the agent alone in it.
slice=/sys/fs/cgroup/system.slice
mkdir $slice
for controller in cpu memory pids io; do
  for dir in /sys/fs/cgroup $slice; do echo +$controller > $dir/cgroup.subtree_control; done
done
cat > /t/muster-agent <<'EOF'
#!/bin/sh
service=/sys/fs/cgroup/system.slice/muster-agent-$$.service
mkdir $service && echo $$ > $service/cgroup.procs && exec /t/agent/muster-agent "$@"
EOF
chmod 755 /t/muster-agent
rmdir /sys/fs/cgroup/muster/* /sys/fs/cgroup/muster
/t/deps/e2e process::a_spinning --nocapture --test-threads=1
service=$?
ls -d $slice/muster-agent-*.service/muster/*/agent || service=1
[ ! -e /sys/fs/cgroup/muster ] || service=1

echo "guest tests ended with $plain$service"
poweroff -f
"#;

/// A kernel image: that of tests/run, or one of this machine.
fn kernel() -> PathBuf {
    if let Some(path) = std::env::var_os("MUSTER_GUEST_KERNEL") {
        return path.into();
    }
    let cached = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/guest/vmlinuz");
    assert!(
        cached.exists(),
        "no guest kernel at {} (tests/run fetches it from Debian)",
        cached.display()
    );
    cached
}

/// A binary without its symbols: the guest holds everything in memory.
fn stripped(path: &Path) -> Vec<u8> {
    let to = tempfile::NamedTempFile::new().expect("a temporary file");
    let strip = Command::new("strip")
        .arg("-o")
        .arg(to.path())
        .arg(path)
        .status()
        .expect("binutils come with gcc");
    assert!(strip.success());
    fs::read(to.path()).expect("strip wrote it")
}

/// The shared libraries that a binary needs, by their paths here.
fn libraries(path: &Path) -> Vec<PathBuf> {
    let ldd = Command::new("ldd").arg(path).output().expect("ldd comes with libc");
    let text = String::from_utf8_lossy(&ldd.stdout).into_owned();
    text.split_whitespace().filter(|w| w.starts_with('/')).map(PathBuf::from).collect()
}

/// The newest end-to-end test binary beside this one; it is the one that this build made.
fn e2e() -> PathBuf {
    let here = std::env::current_exe().expect("a test has a path");
    let deps = here.parent().expect("tests are in target/PROFILE/deps");
    let candidates = fs::read_dir(deps).expect("readable").flatten().filter(|entry| {
        let name = entry.file_name().to_string_lossy().into_owned();
        let runs =
            entry.metadata().is_ok_and(|m| m.is_file() && m.permissions().mode() & 0o111 != 0);
        runs && name.starts_with("e2e-") && !name.contains('.')
    });
    let newest = candidates.max_by_key(|e| e.metadata().and_then(|m| m.modified()).ok());
    newest.expect("the e2e tests are built with this one").path()
}

fn initramfs() -> Vec<u8> {
    let e2e = e2e();
    let profile = e2e.parent().and_then(Path::parent).expect("target/PROFILE/deps").to_owned();
    let mut archive = Archive::default();
    for dir in ["bin", "dev", "proc", "sys", "tmp", "t", "t/deps", "t/agent", "lib", "lib64"] {
        archive.directory(dir);
    }
    archive.file("init", INIT.as_bytes(), 0o755);
    archive.file(
        "bin/busybox",
        &fs::read("/bin/busybox").expect("busybox-static is installed"),
        0o755,
    );
    for applet in [
        "sh", "mount", "ip", "echo", "poweroff", "sleep", "awk", "kill", "setsid", "ln", "rm",
        "rmdir", "mkdir", "cat", "chmod", "ls", "[",
    ] {
        archive.link(&format!("bin/{applet}"), "busybox");
    }
    let binaries = [
        ("t/deps/e2e", e2e),
        ("t/agent/muster-agent", profile.join("muster-agent")),
        ("t/muster-controller", profile.join("muster-controller")),
    ];
    let mut needed: Vec<PathBuf> = Vec::new();
    for (name, path) in &binaries {
        archive.file(name, &stripped(path), 0o755);
        needed.extend(libraries(path));
    }
    needed.sort();
    needed.dedup();
    for library in needed {
        let bytes = fs::read(&library).expect("ldd named it");
        // Into the directory that the loader looks in, and its own fixed place.
        let name = library.file_name().expect("a file").to_string_lossy().into_owned();
        let dir = if name.starts_with("ld-linux") { "lib64" } else { "lib" };
        archive.file(&format!("{dir}/{name}"), &bytes, 0o755);
    }
    archive.finish()
}

#[test]
fn the_process_runtime_holds_quotas_on_cgroup_v2() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let initrd = dir.path().join("initrd");
    fs::write(&initrd, initramfs()).expect("space for the guest's files");
    let guest = Command::new("qemu-system-x86_64")
        // Software emulation: slower than hardware, and the same wherever the tests run.
        .args(["-accel", "tcg,thread=multi", "-smp", "2", "-m", "1536", "-nographic", "-no-reboot"])
        .args(["-nic", "none", "-append", "console=ttyS0 quiet panic=-1 cgroup_no_v1=all"])
        .arg("-kernel")
        .arg(kernel())
        .arg("-initrd")
        .arg(&initrd)
        .stdin(Stdio::null())
        .output()
        .expect("qemu is installed (tests/run installs qemu-system-x86)");
    let said = String::from_utf8_lossy(&guest.stdout);
    let verdict = said.lines().find_map(|l| l.trim().strip_prefix(VERDICT));
    assert_eq!(verdict, Some("00"), "{said}\n{}", String::from_utf8_lossy(&guest.stderr));
    assert!(said.contains("test result: ok. 2 passed"), "both tests ran at the root: {said}");
    assert!(said.contains("test result: ok. 1 passed"), "one ran in a service's group: {said}");
}
