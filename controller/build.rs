//! Compiles the server side of the gRPC services, without a `protoc` on the machine. The messages are
//! `muster_api`'s.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = Path::new("../api/proto");
    println!("cargo:rerun-if-changed=../api/proto");
    let package = |name: &str| root.join(format!("muster/{name}/v1/{name}.proto"));
    let files = protox::compile([package("agent"), package("framework")], [root])?;
    tonic_prost_build::configure()
        .build_client(false)
        .server_mod_attribute(
            ".",
            "#[allow(clippy::allow_attributes_without_reason, reason = \"generated\")]",
        )
        .extern_path(".muster.agent.v1", "::muster_api::wire::agent::v1")
        .extern_path(".muster.framework.v1", "::muster_api::wire::framework::v1")
        .compile_fds(files)?;
    Ok(())
}
