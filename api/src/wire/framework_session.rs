//! Messages of the framework session ↔ the types of this crate.

use std::collections::BTreeMap;

use pbjson_types::Struct;
use pbjson_types::value::Kind;
use serde_json::{Map, Number, Value};

use super::WireError;
use super::framework::v1 as wire;
use crate::duration::Span;
use crate::kind::framework::{FailoverTimeout, FrameworkSpec, OfferFilter};
use crate::kind::task::{Cost, NodeChoice};
use crate::name::FunctionName;
use crate::pose::{DEFAULT_MAP, OperationPosition, Pose};
use crate::quantity::{Bytes, MilliCpu};
use crate::resource::Compute;
use crate::selector::LabelSelector;

/// Largest whole number that a protobuf `Struct`, whose numbers are doubles, holds exactly: 2^53.
const MAX_EXACT: f64 = 9_007_199_254_740_992.0;

/// What a Subscribe says of the framework's wishes.
///
/// # Errors
///
/// The first field that means nothing.
pub fn spec_from_wire(subscribe: &wire::Subscribe) -> Result<FrameworkSpec, WireError> {
    let mut spec = FrameworkSpec::default();
    set_position(&mut spec, subscribe.position.as_ref())?;
    set_filter(&mut spec, subscribe.filter.as_ref())?;
    if let Some(seconds) = subscribe.failover_timeout_seconds {
        let duration = std::time::Duration::try_from_secs_f64(seconds)
            .map_err(|e| WireError::invalid("subscribe.failover_timeout_seconds", e))?;
        let millis = u64::try_from(duration.as_millis())
            .map_err(|e| WireError::invalid("subscribe.failover_timeout_seconds", e))?;
        spec.failover_timeout = FailoverTimeout(Span::from_millis(millis));
    }
    Ok(spec)
}

/// Puts a position into a spec; none: everywhere.
///
/// # Errors
///
/// When the cost is not known.
pub fn set_position(
    spec: &mut FrameworkSpec,
    position: Option<&wire::Position>,
) -> Result<(), WireError> {
    let cost = position.map_or(0, |p| p.cost);
    spec.cost = match wire::Cost::try_from(cost) {
        Ok(wire::Cost::Unspecified | wire::Cost::Distance) => Cost::Distance,
        Ok(wire::Cost::TravelTime) => Cost::TravelTime,
        Err(_) => return Err(WireError::UnknownEnum { field: "position.cost", value: cost }),
    };
    spec.radius = position.and_then(|p| p.radius);
    spec.position = position.map(|p| OperationPosition {
        map: if p.map.is_empty() { DEFAULT_MAP.to_owned() } else { p.map.clone() },
        x: p.x,
        y: p.y,
        z: p.z,
    });
    Ok(())
}

/// The position of a spec; none: everywhere.
#[must_use]
pub fn position_to_wire(spec: &FrameworkSpec) -> Option<wire::Position> {
    let cost = match spec.cost {
        Cost::Distance => wire::Cost::Distance,
        Cost::TravelTime => wire::Cost::TravelTime,
    };
    spec.position.as_ref().map(|p| wire::Position {
        map: p.map.clone(),
        x: p.x,
        y: p.y,
        z: p.z,
        radius: spec.radius,
        cost: cost.into(),
    })
}

/// Puts a filter into a spec; none: everything.
///
/// # Errors
///
/// The first field that means nothing.
pub fn set_filter(
    spec: &mut FrameworkSpec,
    filter: Option<&wire::Filter>,
) -> Result<(), WireError> {
    let Some(filter) = filter else {
        spec.filter = OfferFilter::default();
        return Ok(());
    };
    let on = match wire::NodeKind::try_from(filter.kind) {
        Ok(wire::NodeKind::Unspecified) => NodeChoice::Any,
        Ok(wire::NodeKind::Robot) => NodeChoice::Robot,
        Ok(wire::NodeKind::Cloud) => NodeChoice::Cloud,
        Err(_) => return Err(WireError::UnknownEnum { field: "filter.kind", value: filter.kind }),
    };
    let selector = LabelSelector::parse(&filter.selector)
        .map_err(|e| WireError::invalid("filter.selector", e))?;
    spec.filter = OfferFilter {
        on,
        selector,
        minimum: compute_from_wire(filter.minimum.as_ref()),
        sensors: functions("filter.sensors", &filter.sensors)?,
        actuators: functions("filter.actuators", &filter.actuators)?,
        any_actuator: filter.any_actuator,
        most: filter.most,
    };
    Ok(())
}

fn functions(field: &'static str, names: &[String]) -> Result<Vec<FunctionName>, WireError> {
    names.iter().map(|n| n.parse().map_err(|e| WireError::invalid(field, e))).collect()
}

fn compute_from_wire(compute: Option<&wire::Compute>) -> Compute {
    compute.map_or_else(Compute::default, |c| Compute {
        cpu: MilliCpu(c.cpu_millis),
        memory: Bytes(c.memory_bytes),
        extended: c.extended.iter().map(|(name, n)| (name.clone(), *n)).collect(),
    })
}

/// CR as frameworks see it.
#[must_use]
pub fn compute_to_wire(compute: &Compute) -> wire::Compute {
    wire::Compute {
        cpu_millis: compute.cpu.0,
        memory_bytes: compute.memory.0,
        extended: compute.extended.iter().map(|(name, n)| (name.clone(), *n)).collect(),
    }
}

/// A pose as frameworks see it.
#[must_use]
pub fn pose_to_wire(pose: &Pose) -> wire::Pose {
    wire::Pose {
        map: pose.map.clone(),
        x: pose.x,
        y: pose.y,
        z: pose.z,
        yaw: pose.yaw,
        stamp: pose.stamp.as_ref().map(|stamp| time_to_wire(stamp.0)),
    }
}

/// An instant.
#[must_use]
pub fn time_to_wire(at: jiff::Timestamp) -> pbjson_types::Timestamp {
    pbjson_types::Timestamp { seconds: at.as_second(), nanos: at.subsec_nanosecond() }
}

/// A protobuf Struct as JSON. Its numbers are doubles; whole ones become integers, as the API's fields want them.
#[must_use]
pub fn json_of(fields: &Struct) -> Map<String, Value> {
    let fields: BTreeMap<&String, &pbjson_types::Value> = fields.fields.iter().collect();
    fields.into_iter().map(|(name, value)| (name.clone(), value_of(value))).collect()
}

fn value_of(value: &pbjson_types::Value) -> Value {
    match &value.kind {
        None | Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::BoolValue(yes)) => Value::Bool(*yes),
        Some(Kind::StringValue(text)) => Value::String(text.clone()),
        Some(Kind::NumberValue(number)) => number_of(*number),
        Some(Kind::ListValue(list)) => list.values.iter().map(value_of).collect(),
        Some(Kind::StructValue(fields)) => Value::Object(json_of(fields)),
    }
}

fn number_of(number: f64) -> Value {
    if number.fract() == 0.0 && number.abs() < MAX_EXACT {
        // Whole and below 2^53: exact.
        return Value::from(number as i64);
    }
    Number::from_f64(number).map_or(Value::Null, Value::Number)
}

/// JSON as a protobuf Struct.
#[must_use]
pub fn struct_of(fields: &Map<String, Value>) -> Struct {
    Struct { fields: fields.iter().map(|(name, v)| (name.clone(), value_to_wire(v))).collect() }
}

fn value_to_wire(value: &Value) -> pbjson_types::Value {
    let kind = match value {
        Value::Null => Kind::NullValue(0),
        Value::Bool(yes) => Kind::BoolValue(*yes),
        Value::Number(number) => Kind::NumberValue(number.as_f64().unwrap_or(f64::NAN)),
        Value::String(text) => Kind::StringValue(text.clone()),
        Value::Array(list) => Kind::ListValue(pbjson_types::ListValue {
            values: list.iter().map(value_to_wire).collect(),
        }),
        Value::Object(fields) => Kind::StructValue(struct_of(fields)),
    };
    pbjson_types::Value { kind: Some(kind) }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_struct_keeps_json_and_whole_numbers_stay_whole() {
        let json = json!({"a": 3, "b": 0.5, "c": [true, null, "x", {"d": -7}], "e": {}});
        let fields = json.as_object().expect("an object");
        assert_eq!(Value::Object(json_of(&struct_of(fields))), json);
    }

    #[test]
    fn calls_are_protobufs_json() {
        let line = r#"{"id":"1","subscribe":{"name":"deliver","position":{"x":1.5,"radius":20},
            "filter":{"kind":"NODE_KIND_ROBOT","selector":"floor in (1,2)","minimum":{"cpuMillis":"500"}},"failoverTimeoutSeconds":2.5}}"#;
        let call: wire::Call = serde_json::from_str(line).expect("a call");
        let Some(wire::call::Call::Subscribe(subscribe)) = call.call else { panic!("{call:?}") };
        let spec = spec_from_wire(&subscribe).expect("a spec");
        assert_eq!(spec.radius, Some(20.0));
        assert_eq!(spec.filter.minimum.cpu, MilliCpu(500));
        assert_eq!(spec.filter.on, NodeChoice::Robot);
        assert_eq!(spec.failover_timeout.0.to_string(), "2s500ms");
        let bad = wire::Subscribe {
            filter: Some(wire::Filter {
                sensors: vec!["kinect".into()],
                ..wire::Filter::default()
            }),
            ..wire::Subscribe::default()
        };
        assert!(matches!(
            spec_from_wire(&bad),
            Err(WireError::Invalid { field: "filter.sensors", .. })
        ));
    }
}
