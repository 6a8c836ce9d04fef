//! Compiles the framework's side of the session service, and the publisher's of a stream of poses. The messages themselves are `muster-api`'s.
//! The controller's side is compiled as well, to a file of its own that only tests include.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = Path::new("../proto");
    println!("cargo:rerun-if-changed=../proto/muster/framework");
    println!("cargo:rerun-if-changed=../proto/muster/pose");
    let out = std::env::var("OUT_DIR")?;
    let server = Path::new(&out).join("server");
    std::fs::create_dir_all(&server)?;
    let files = || protox::compile([root.join("muster/framework/v1/framework.proto")], [root]);
    let stub = || {
        tonic_prost_build::configure()
            .build_transport(false)
            .extern_path(".muster.framework.v1", "::muster_api::wire::framework::v1")
            .extern_path(".muster.pose.v1", "::muster_api::wire::pose::v1")
    };
    stub().build_server(false).compile_fds(files()?)?;
    let poses = protox::compile([root.join("muster/pose/v1/pose.proto")], [root])?;
    stub().build_server(false).compile_fds(poses)?;
    stub().build_client(false).out_dir(server).compile_fds(files()?)?;
    Ok(())
}
