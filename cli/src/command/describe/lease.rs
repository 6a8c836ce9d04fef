//! A lease: who drives, since when.

use jiff::Timestamp;
use muster_api::kind::lease::{HolderKind, Lease};
use muster_api::resource::format_function_list;

use super::{begin, when};
use crate::output::sheet::Sheet;
use crate::output::style::Mood;
use crate::output::table::Cell;

pub(super) fn describe(sheet: &mut Sheet, lease: &Lease, now: Timestamp) {
    begin(sheet, &lease.metadata, now);
    sheet.field("Node", &lease.spec.node);
    sheet.field("Group", &lease.spec.group);
    let actuators = lease.spec.actuators.iter().cloned().collect();
    sheet.field("Actuators", format_function_list(&actuators));
    let Some(status) = &lease.status else { return };
    sheet.field("Epoch", status.epoch.to_string());
    match &status.holder {
        Some(holder) if holder.kind == HolderKind::User => {
            sheet.field("Holder", holder.to_string());
        }
        Some(holder) => {
            sheet.field(
                "Holder",
                format!("task/{} in {} (uid {})", holder.name, holder.namespace, holder.uid),
            );
        }
        None => {
            sheet.field("Holder", Cell::new("free", Mood::Dim));
        }
    }
    sheet.maybe("Acquired", status.acquired.as_ref().map(|t| when(t.0, now)));
    sheet.maybe("Renewed", status.renewed.as_ref().map(|t| when(t.0, now)));
}
