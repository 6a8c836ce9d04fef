//! Makes Rust types, their checksums and their protobuf conversions from the message definitions in `msgs/`.
//!
//! | module | does |
//! |---|---|
//! | [`definition`] | reads `.msg` texts; checksums and full texts as ROS makes them |
//! | [`rust`] | a struct for each message, with its serialisation |
//! | [`proto`] | what `api/proto/muster/ros/v1` must say for them, and the conversions |
//!
//! The protobuf files themselves are kept in `api/proto`, where their readers look; a test compares them with what is
//! made here.

mod definition;
mod proto;
mod rust;

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use definition::Definitions;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=msgs");
    println!("cargo:rerun-if-changed=build");
    println!("cargo:rerun-if-changed=../api/proto/muster/ros");
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    let all = Definitions::read(Path::new("msgs"))?;
    fs::write(out.join("messages.rs"), rust::messages(&all)?)?;
    fs::write(out.join("convert.rs"), proto::conversions(&all))?;
    let expected = out.join("proto");
    fs::create_dir_all(&expected)?;
    let mut made = String::from("&[\n");
    for package in all.packages() {
        fs::write(expected.join(format!("{package}.proto")), proto::file(&all, package))?;
        made.push_str(&format!(
            "({package:?}, include_str!(concat!(env!(\"OUT_DIR\"), \"/proto/{package}.proto\")), \
             include_str!(concat!(env!(\"CARGO_MANIFEST_DIR\"), \"/../api/proto/muster/ros/v1/{package}.proto\"))),\n"
        ));
    }
    made.push(']');
    fs::write(out.join("protos.rs"), made)?;
    let root = Path::new("../api/proto");
    let files = all.packages().map(|p| root.join(format!("muster/ros/v1/{p}.proto")));
    let compiled = protox::compile(files, [root])?;
    tonic_prost_build::configure()
        .build_client(false)
        .build_server(false)
        .bytes(".")
        .compile_fds(compiled)?;
    fs::write(out.join("wire.rs"), proto::modules(&all))?;
    Ok(())
}
