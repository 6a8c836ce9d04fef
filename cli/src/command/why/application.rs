//! An Application: for each part where it is and why, and what stands between it and the other scales.

use muster_api::condition::{ConditionStatus, DEGRADED};
use muster_api::kind::application::{Application, ApplicationStatus};
use serde_json::{Value, json};

use super::Asked;
use crate::output::style::Styles;
use crate::output::table::Table;

/// The text, and what programs get.
pub(super) fn told(
    asked: &Asked<'_>,
    styles: &Styles,
) -> Result<(String, Value), serde_json::Error> {
    let app: Application = serde_json::from_value(asked.object.clone())?;
    let nothing = ApplicationStatus::default();
    let status = app.status.as_ref().unwrap_or(&nothing);
    let mut text = format!("application/{} {}.\n", asked.name, stands(status));
    if let Some(value) = status.value {
        let bound = status.bound.map(|b| format!("; no mapping is worth more than {b:.3}"));
        text.push_str(&format!("It is worth {value:.3}{}.\n", bound.unwrap_or_default()));
    }
    if !status.parts.is_empty() {
        let mut table = Table::new(["PART", "CLASS", "NOW", "WHY"]);
        for part in &status.parts {
            let now = part.scale.as_deref().unwrap_or_default();
            table.push([part.name.as_str(), &format!("{:?}", part.class), now, &part.message]);
        }
        text.push_str(&format!("\n{}", table.text(styles)));
    }
    let mut elsewhere = Table::new(["PART", "SCALE", "GAIN", "BINDS", "WHY"]);
    for part in &status.parts {
        for other in &part.elsewhere {
            let gain = format!("{:+.3}", other.gain);
            let row = [&part.name, &other.scale, &gain, &other.reason, &other.message];
            elsewhere.push(row);
        }
    }
    if !elsewhere.is_empty() {
        text.push_str(&format!("\n{}", elsewhere.text(styles)));
    }
    Ok((text, json!({"status": status})))
}

/// How it is, and where it is not as it should be.
fn stands(status: &ApplicationStatus) -> String {
    if status.observed_generation == 0 {
        return "waits: nobody has looked at it yet".to_owned();
    }
    let phase = format!("is {:?}", status.phase);
    let worry = status.condition(DEGRADED).filter(|c| c.status == ConditionStatus::True);
    match worry {
        None => phase,
        Some(worry) => format!("{phase}; {}: {}", worry.reason, worry.message),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_says_why_and_what_it_would_take() {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Application", "metadata": {"name": "a"},
            "spec": {"home": "r", "parts": [{"name": "ar", "template": {"spec": {}}}]},
            "status": {
                "observedGeneration": 1, "phase": "Running", "value": 1.5, "bound": 2.0,
                "conditions": [{"type": "Degraded", "status": "True", "reason": "TaskUnreachable", "message": "it may run"}],
                "parts": [{
                    "name": "ar", "class": "Migratable", "scale": "r", "message": "is at home",
                    "elsewhere": [{"scale": "c", "reason": "BandwidthExceeded", "message": "4Mbit/s more", "gain": 0.825}],
                }],
            },
        });
        let asked = Asked { name: "a", object, answer: None };
        let (text, value) = told(&asked, &Styles::default()).expect("it reads");
        assert_eq!(
            text,
            "application/a is Running; TaskUnreachable: it may run.\n\
             It is worth 1.500; no mapping is worth more than 2.000.\n\
             \nPART   CLASS        NOW   WHY\n\
             ar     Migratable   r     is at home\n\
             \nPART   SCALE   GAIN     BINDS               WHY\n\
             ar     c       +0.825   BandwidthExceeded   4Mbit/s more\n"
        );
        assert_eq!(value["status"]["parts"][0]["name"], "ar");
    }
}
