//! The Docker Engine of this machine, and one small image in it.

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output, Stdio};

/// The image that [`image`] makes: a static busybox and its applets.
pub const IMAGE: &str = "muster-e2e/busybox:1";

fn docker(args: &[&str]) -> Output {
    Command::new("docker")
        .args(args)
        .output()
        .expect("the docker client is installed (tests/run installs docker.io)")
}

/// The image that [`bare_image`] makes: nothing but the places where a node's own system is mounted.
pub const BARE_IMAGE: &str = "muster-e2e/bare:1";

/// Makes the image when it is not there; registries are not asked.
///
/// # Panics
///
/// When no engine answers, or busybox-static is not installed.
pub fn image() {
    import(IMAGE, root);
}

/// The same of an image whose programs are the node's, by mounts of its `/usr` and of what in `/etc` belongs to it.
///
/// # Panics
///
/// When no engine answers.
pub fn bare_image() {
    import(BARE_IMAGE, bare_root);
}

fn import(image: &str, root: fn() -> Vec<u8>) {
    if docker(&["image", "inspect", image]).status.success() {
        return;
    }
    let engine = docker(&["version"]);
    assert!(
        engine.status.success(),
        "no Docker Engine answers (tests/run starts one): {}",
        String::from_utf8_lossy(&engine.stderr)
    );
    let tar = root();
    let mut import = Command::new("docker")
        .args(["import", "-", image])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .expect("the docker client runs");
    import.stdin.take().expect("piped").write_all(&tar).expect("docker reads it");
    assert!(import.wait().expect("it is ours").success(), "docker import failed");
}

/// The files of a small system as a tar: a static busybox and its applets.
pub(crate) fn root() -> Vec<u8> {
    let root = tempfile::tempdir().expect("a temporary directory");
    let bin = root.path().join("bin");
    std::fs::create_dir(&bin).expect("it is empty");
    std::fs::copy("/bin/busybox", bin.join("busybox"))
        .expect("busybox-static is installed (tests/run does)");
    for applet in ["sh", "sleep", "awk", "echo", "cat", "true", "false"] {
        std::os::unix::fs::symlink("busybox", bin.join(applet)).expect("a new name");
    }
    packed(root.path())
}

fn bare_root() -> Vec<u8> {
    let root = tempfile::tempdir().expect("a temporary directory");
    for name in ["usr", "etc", "tmp"] {
        std::fs::create_dir(root.path().join(name)).expect("it is empty");
    }
    for name in ["bin", "lib", "lib64", "sbin"] {
        std::os::unix::fs::symlink(format!("usr/{name}"), root.path().join(name))
            .expect("a new name");
    }
    packed(root.path())
}

fn packed(root: &Path) -> Vec<u8> {
    let tar = Command::new("tar").arg("-C").arg(root).args(["-c", "."]).output().expect("tar");
    assert!(tar.status.success(), "{}", String::from_utf8_lossy(&tar.stderr));
    tar.stdout
}

/// Removes an image, when it is there.
pub(crate) fn remove_image(image: &str) {
    drop(docker(&["image", "rm", "--force", image]));
}

/// Whether a container of a task is left, running or not.
#[must_use]
pub fn containers_of(uid: &str) -> Vec<String> {
    let listed = docker(&["ps", "-aq", "--filter", &format!("label=muster.dev/task-uid={uid}")]);
    String::from_utf8_lossy(&listed.stdout).lines().map(str::to_owned).collect()
}
