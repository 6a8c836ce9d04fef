//! Compiles the protobuf files to plain prost messages, without a `protoc` on the machine.
//!
//! Service stubs are not made here: they need a transport, and this crate has none. The controller
//! and the agent compile the same files for their own side of each service.
//!
//! The framework session also travels as JSON lines, so its messages have protobuf's JSON mapping (pbjson).

use std::path::Path;

use prost::Message as _;

const FRAMEWORK: &str = ".muster.framework.v1";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = Path::new("proto");
    println!("cargo:rerun-if-changed=proto");
    let package = |name: &str| root.join(format!("muster/{name}/v1/{name}.proto"));
    let agent = protox::compile([package("agent")], [root])?;
    let sessions = protox::compile([package("framework"), package("executor")], [root])?;
    let poses = protox::compile([package("pose")], [root])?;
    let gate = protox::compile([package("gate")], [root])?;
    let sensor = protox::compile([package("sensor")], [root])?;
    let plain = || tonic_prost_build::configure().build_client(false).build_server(false);
    // Values of Secrets, and tickets: `wire::secret` says how they are shown.
    plain()
        .bytes(".muster.agent.v1.Message.data")
        .bytes(".muster.agent.v1.File.data")
        .bytes(".muster.agent.v1.ExecOutput")
        .bytes(".muster.agent.v1.ExecInput")
        .skip_debug([
            ".muster.agent.v1.Variable",
            ".muster.agent.v1.File",
            ".muster.agent.v1.Ticket",
        ])
        .compile_fds(agent)?;
    plain().compile_fds(poses)?;
    // Tokens of tasks: `wire::secret` says how they are shown.
    plain()
        .bytes(".muster.gate.v1.Command.data")
        .skip_debug([".muster.gate.v1.Register", ".muster.gate.v1.Seat"])
        .compile_fds(gate)?;
    plain()
        .bytes(".muster.sensor.v1.Frame.data")
        .skip_debug([".muster.sensor.v1.Open"])
        .compile_fds(sensor)?;
    plain()
        .bytes(".")
        .skip_debug([".muster.framework.v1.Direct"])
        .compile_well_known_types(true)
        .extern_path(".google.protobuf", "::pbjson_types")
        .compile_fds(sessions.clone())?;
    pbjson_build::Builder::new()
        .register_descriptors(&sessions.encode_to_vec())?
        .build(&[FRAMEWORK])?;
    Ok(())
}
