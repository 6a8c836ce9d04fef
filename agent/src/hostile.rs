//! What tasks, executors, gates and settings say, fed with what a stranger may say: see `muster-hostile`.

use futures::FutureExt as _;
use muster_api::wire::{executor, gate, sensor};
use prost::Message;

use crate::config::Args;
use crate::declared::Declared;
use crate::executor::frame;
use crate::sim::settings::Settings;

/// Frames to their end: each is a message that says the same when it is written, or the connection ends.
fn read_all<M: Message + Default + PartialEq + std::fmt::Debug>(mut bytes: &[u8]) {
    loop {
        // Memory never waits.
        let read = frame::read::<M, _>(&mut bytes).now_or_never().expect("it is all there");
        let Ok(Some(message)) = read else { return };
        let again = M::decode(&*message.encode_to_vec()).expect("it is one of ours");
        // What is no number is not its own equal.
        assert!(again == message || format!("{again:?}") == format!("{message:?}"));
    }
}

fn framed(message: &impl Message) -> Vec<u8> {
    let bytes = message.encode_to_vec();
    let length = u32::try_from(bytes.len()).expect("a short message");
    [&length.to_be_bytes()[..], &bytes].concat()
}

#[test]
fn frames_of_tasks_and_executors_are_read_or_end_the_connection() {
    use executor::v1 as of_executor;
    use gate::v1 as of_gate;
    use sensor::v1 as of_sensor;
    let message = of_executor::Message { data: b"hello".to_vec().into() };
    let said = of_executor::Call { call: Some(of_executor::call::Call::Message(message)) };
    let command = of_gate::Command { actuator: "base:Drive".to_owned(), ..Default::default() };
    let drive = of_gate::Call { call: Some(of_gate::call::Call::Command(command)) };
    let holder = of_gate::Holder { task: "uid".to_owned(), epoch: 3 };
    let wanted = of_gate::Wanted { id: 7, grant: Some(holder), ..Default::default() };
    let status = of_gate::Status { wanted: 7, settings: "digest".to_owned(), ..Default::default() };
    let open = of_sensor::Open { queue: 3, ..Default::default() };
    let open = of_sensor::Call { call: Some(of_sensor::call::Call::Open(open)) };
    let seeds = [framed(&said), framed(&drive), framed(&open), framed(&wanted), framed(&status)];
    let seeds = seeds.iter().map(|seed| seed.repeat(2)).chain(seeds.clone());
    let inputs = muster_hostile::inputs("headers").and(seeds);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        read_all::<of_executor::Call>(bytes);
        read_all::<of_gate::Call>(bytes);
        read_all::<of_gate::Wanted>(bytes);
        read_all::<of_gate::Status>(bytes);
        read_all::<of_sensor::Call>(bytes);
    });
}

#[test]
fn worlds_are_read_or_refused() {
    let lab = concat!(env!("CARGO_MANIFEST_DIR"), "/../manifests/lab");
    let dir = tempfile::tempdir().expect("a directory");
    std::fs::copy(format!("{lab}/lab.yaml"), dir.path().join("lab.yaml")).expect("it is there");
    std::fs::copy(format!("{lab}/lab.pgm"), dir.path().join("lab.pgm")).expect("it is there");
    let path = dir.path().join("world.yaml");
    let world = std::fs::read(format!("{lab}/world.yaml")).expect("it is there");
    let inputs = muster_hostile::inputs("agent").and([world]);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        std::fs::write(&path, bytes).expect("it is ours");
        if let Err(error) = Settings::read(&path) {
            assert!(!error.to_string().is_empty());
        }
    });
}

#[test]
fn agents_settings_are_kept_as_they_are_read_or_refused() {
    let lab = concat!(env!("CARGO_MANIFEST_DIR"), "/../manifests/lab");
    let dir = tempfile::tempdir().expect("a directory");
    for file in ["world.yaml", "lab.yaml", "lab.pgm"] {
        std::fs::copy(format!("{lab}/{file}"), dir.path().join(file)).expect("it is there");
    }
    let (path, none) = (dir.path().join("agent.yaml"), dir.path().join("none"));
    let settings = |bytes: &[u8]| {
        std::fs::write(&path, bytes).expect("it is ours");
        let (config, data_dir) = (Some(path.clone()), Some(none.clone()));
        Args { config, data_dir, ..Args::default() }.resolve()
    };
    let simulated = std::fs::read(format!("{lab}/agent.yaml")).expect("it is there");
    assert!(settings(&simulated).is_ok_and(|config| config.simulated.is_some()));
    let inputs = muster_hostile::inputs("agent").and([simulated]);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| match settings(bytes) {
        Ok(config) => {
            let kept = serde_json::to_vec(&config.declared).expect("it is JSON");
            let read: Declared = serde_json::from_slice(&kept).expect("it is one of ours");
            assert_eq!(read, config.declared, "for the next start");
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    });
}
