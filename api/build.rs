//! Compiles the protobuf files to plain prost messages, without a `protoc` on the machine.
//!
//! Service stubs are not made here: they need a transport, and this crate has none. The controller
//! and the agent compile the same files for their own side of each service.

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = Path::new("proto");
    println!("cargo:rerun-if-changed=proto");
    let files = protox::compile([root.join("muster/agent/v1/agent.proto")], [root])?;
    tonic_prost_build::configure().build_client(false).build_server(false).compile_fds(files)?;
    Ok(())
}
