//! An Application: for each part where it is and why, and what stands between it and the other scales.

use muster_api::condition::MANAGED;
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
    let managed = status.condition(MANAGED);
    let said = managed.map_or("nobody has looked at it yet", |c| c.message.as_str());
    let said = if said.is_empty() { "its parts are run and moved" } else { said };
    let mut text = format!("application/{}: {said}.\n", asked.name);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_says_why_and_what_it_would_take() {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Application", "metadata": {"name": "a"},
            "spec": {"home": "r", "parts": [{"name": "ar", "template": {"spec": {}}}]},
            "status": {
                "conditions": [{"type": "Managed", "status": "False", "message": "nothing is run"}],
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
            "application/a: nothing is run.\n\
             \nPART   CLASS        NOW   WHY\n\
             ar     Migratable   r     is at home\n\
             \nPART   SCALE   GAIN     BINDS               WHY\n\
             ar     c       +0.825   BandwidthExceeded   4Mbit/s more\n"
        );
        assert_eq!(value["status"]["parts"][0]["name"], "ar");
    }
}
