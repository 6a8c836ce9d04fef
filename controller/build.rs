//! Compiles the server side of the gRPC services, without a `protoc` on the machine. The messages are
//! `muster_api`'s. The client's side is compiled as well, to a file of its own that only tests include.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = Path::new("../api/proto");
    println!("cargo:rerun-if-changed=../api/proto");
    let package = |name: &str| root.join(format!("muster/{name}/v1/{name}.proto"));
    let packages = ["agent", "framework", "pose"];
    let files = || protox::compile(packages.map(package), [root]);
    let messages = "::muster_api::wire::agent::v1";
    let framework = "::muster_api::wire::framework::v1";
    let pose = "::muster_api::wire::pose::v1";
    let client = Path::new(&std::env::var("OUT_DIR")?).join("client");
    std::fs::create_dir_all(&client)?;
    tonic_prost_build::configure()
        .build_server(false)
        .build_transport(false)
        .extern_path(".muster.agent.v1", messages)
        .extern_path(".muster.framework.v1", framework)
        .extern_path(".muster.pose.v1", pose)
        .out_dir(client)
        .compile_fds(files()?)?;
    tonic_prost_build::configure()
        .build_client(false)
        .server_mod_attribute(
            ".",
            "#[allow(clippy::allow_attributes_without_reason, reason = \"generated\")]",
        )
        .extern_path(".muster.agent.v1", messages)
        .extern_path(".muster.framework.v1", framework)
        .extern_path(".muster.pose.v1", pose)
        .compile_fds(files()?)?;
    Ok(())
}
