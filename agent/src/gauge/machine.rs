//! Labels that say what the machine is made of, beside its architecture and system:
//!
//! | label | is |
//! |---|---|
//! | `muster.dev/gpu` | `nvidia`, `amd` or `intel`: the first graphics processor that the kernel drives |
//! | `muster.dev/ros-distro` | `$ROS_DISTRO`, else the only distribution in `/opt/ros`, else `debian` for Debian's own packages |

use std::path::Path;

/// PCI's numbers of those who make graphics processors. NVIDIA comes first where there are several: the other one
/// mostly drives the screen.
const VENDORS: [(&str, &str); 3] = [("0x10de", "nvidia"), ("0x1002", "amd"), ("0x8086", "intel")];

/// The labels of this machine.
pub(crate) fn labels() -> Vec<(String, String)> {
    let distro = std::env::var("ROS_DISTRO").ok();
    found(Path::new("/"), distro)
}

fn found(root: &Path, ros_distro: Option<String>) -> Vec<(String, String)> {
    let gpu = gpu(root).map(|vendor| ("muster.dev/gpu".to_owned(), vendor.to_owned()));
    let said = ros_distro.filter(|name| !name.is_empty());
    let distro = said.or_else(|| installed_ros(root));
    let distro = distro.map(|name| ("muster.dev/ros-distro".to_owned(), name));
    gpu.into_iter().chain(distro).collect()
}

fn gpu(root: &Path) -> Option<&'static str> {
    if root.join("proc/driver/nvidia/version").exists() {
        return Some("nvidia");
    }
    let cards = std::fs::read_dir(root.join("sys/class/drm")).ok()?;
    let vendors: Vec<String> = cards
        .flatten()
        .filter_map(|card| std::fs::read_to_string(card.path().join("device/vendor")).ok())
        .map(|vendor| vendor.trim().to_owned())
        .collect();
    let known = VENDORS.iter().find(|(number, _)| vendors.iter().any(|vendor| vendor == number));
    known.map(|(_, name)| *name)
}

fn installed_ros(root: &Path) -> Option<String> {
    let entries = std::fs::read_dir(root.join("opt/ros")).into_iter().flatten().flatten();
    let mut names: Vec<String> =
        entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    match (names.pop(), names.is_empty()) {
        (Some(only), true) => Some(only),
        // Several: which one a task uses is for the task to say.
        (Some(_), false) => None,
        (None, _) => root.join("usr/bin/roscore").exists().then(|| "debian".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_found_where_systems_keep_them() {
        let root = tempfile::tempdir().unwrap();
        let put = |path: &str, text: &str| {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let labels = |distro: Option<&str>| -> Vec<String> {
            let found = found(root.path(), distro.map(str::to_owned));
            found.into_iter().map(|(key, value)| format!("{key}={value}")).collect()
        };
        assert_eq!(labels(None), [""; 0]);
        assert_eq!(labels(Some("")), [""; 0]);
        put("usr/bin/roscore", "");
        put("sys/class/drm/card0/device/vendor", "0x8086\n");
        assert_eq!(labels(None), ["muster.dev/gpu=intel", "muster.dev/ros-distro=debian"]);
        put("opt/ros/noetic/setup.sh", "");
        put("sys/class/drm/card1/device/vendor", "0x10de\n");
        assert_eq!(labels(None), ["muster.dev/gpu=nvidia", "muster.dev/ros-distro=noetic"]);
        put("opt/ros/humble/setup.sh", "");
        assert_eq!(labels(None), ["muster.dev/gpu=nvidia"]);
        assert_eq!(
            labels(Some("humble")),
            ["muster.dev/gpu=nvidia", "muster.dev/ros-distro=humble"]
        );
    }
}
