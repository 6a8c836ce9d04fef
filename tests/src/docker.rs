//! The Docker Engine of this machine, and one small image in it.

use std::io::Write as _;
use std::process::{Command, Output, Stdio};

/// The image that [`image`] makes: a static busybox and its applets.
pub const IMAGE: &str = "muster-e2e/busybox:1";

fn docker(args: &[&str]) -> Output {
    Command::new("docker")
        .args(args)
        .output()
        .expect("the docker client is installed (tests/run installs docker.io)")
}

/// Makes the image when it is not there; registries are not asked.
///
/// # Panics
///
/// When no engine answers, or busybox-static is not installed.
pub fn image() {
    if docker(&["image", "inspect", IMAGE]).status.success() {
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
        .args(["import", "-", IMAGE])
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
    let tar = Command::new("tar")
        .args(["-C", &root.path().display().to_string(), "-c", "."])
        .output()
        .expect("tar");
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
