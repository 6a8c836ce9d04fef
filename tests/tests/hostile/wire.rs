use muster_api::direct::frame::{HEADER, Header, Hello};
use muster_api::direct::{Line, SECRET_BYTES, Secret};
use muster_api::wire::agent_session;
use muster_api::wire::framework::v1 as framework;
use muster_api::wire::framework_session::{self, json_of, struct_of};
use prost::Message as _;
use serde_json::json;

/// A Subscribe with everything, as the SDKs send it.
fn subscribe() -> framework::Call {
    let subscribe = json!({"subscribe": {
        "name": "deliver", "namespace": "hall", "frameworkId": "f-1", "failoverTimeoutSeconds": 90,
        "position": {"map": "hall", "x": 3.0, "y": 4.0, "radius": 20.0, "cost": "COST_TRAVEL_TIME"},
        "filter": {"kind": "NODE_KIND_ROBOT", "minimum": {"cpuMillis": "500", "memoryBytes": "67108864"}, "anyActuator": true},
    }});
    serde_json::from_value(subscribe).expect("a call")
}

fn accept() -> framework::Call {
    let spec = json!({"resources": {"cpu": "500m", "actuators": ["base:Drive"]}, "run": {"process": {"command": ["drive"]}}});
    let accept = json!({"id": "7", "accept": {"offers": ["1-2"], "refuseSeconds": 5.0, "launches": [{"name": "drive", "spec": spec}]}});
    serde_json::from_value(accept).expect("a call")
}

/// Calls of frameworks: as protobuf, and as a line of JSON.
#[test]
fn calls_of_frameworks_are_taken_or_refused() {
    let seeds = [subscribe(), accept()];
    let seeds = seeds
        .iter()
        .flat_map(|call| [call.encode_to_vec(), serde_json::to_vec(call).expect("it is JSON")]);
    let inputs = muster_hostile::inputs("framework").and(seeds);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let call =
            framework::Call::decode(&**bytes).ok().or_else(|| serde_json::from_slice(bytes).ok());
        match call.and_then(|call: framework::Call| call.call) {
            Some(framework::call::Call::Subscribe(subscribe)) => {
                if let Ok(spec) = framework_session::spec_from_wire(&subscribe) {
                    drop(spec.violations());
                }
            }
            Some(framework::call::Call::Accept(accept)) => {
                for fields in accept.launches.iter().filter_map(|launch| launch.spec.as_ref()) {
                    let json = json_of(fields);
                    assert_eq!(json_of(&struct_of(&json)), json);
                }
            }
            _ => {}
        }
    });
}

/// The specification of a task, as the controller sends it to agents.
#[test]
fn specifications_are_read_as_they_are_written() {
    let seed = json!({"placement": {"on": "Robot"}, "resources": {"cpu": "500m", "memory": "64Mi"}, "run": {"process": {"command": ["true"]}}});
    let inputs =
        muster_hostile::inputs("framework").and([serde_json::to_vec(&seed).expect("it is JSON")]);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        if let Ok(spec) = agent_session::spec_from_wire(bytes) {
            let again = agent_session::spec_from_wire(&agent_session::spec_to_wire(&spec));
            assert_eq!(again.expect("it is one of ours"), spec);
        }
    });
}

/// The frames of direct messages, from whoever reaches an agent's port.
#[test]
fn frames_of_strangers_are_bounded() {
    let secret = Secret::new([7; SECRET_BYTES]);
    let hello = Hello { line: Line::new(3).expect("not 0"), executor: "uid".to_owned(), secret };
    let inputs = muster_hostile::inputs("framework").and([hello.encode()]);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let Some((header, payload)) = bytes.split_first_chunk::<HEADER>() else { return };
        let Ok(header) = Header::decode(*header) else { return };
        assert_eq!(Header::decode(header.encode()), Ok(header));
        let Some(payload) = payload.get(..header.length) else { return };
        if let Ok(hello) = Hello::decode(header, payload) {
            assert_eq!(hello.encode()[HEADER..], *payload);
        }
    });
}
