//! Compiles the agent's side of the session service. The messages themselves are `muster-api`'s.
//! The server's side is compiled as well, to a file of its own that only tests include.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = Path::new("../api/proto");
    println!("cargo:rerun-if-changed=../api/proto/muster/agent");
    let out = std::env::var("OUT_DIR")?;
    let server = Path::new(&out).join("server");
    std::fs::create_dir_all(&server)?;
    let files = || protox::compile([root.join("muster/agent/v1/agent.proto")], [root]);
    let messages = "::muster_api::wire::agent::v1";
    tonic_prost_build::configure()
        .build_server(false)
        .build_transport(false)
        .extern_path(".muster.agent.v1", messages)
        .compile_fds(files()?)?;
    tonic_prost_build::configure()
        .build_client(false)
        .build_transport(false)
        .extern_path(".muster.agent.v1", messages)
        .out_dir(server)
        .compile_fds(files()?)?;
    Ok(())
}
