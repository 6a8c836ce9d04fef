//! Access: which role, where, for whom.

use jiff::Timestamp;
use muster_api::kind::access::{Access, SubjectKind};

use super::begin;
use crate::output::sheet::Sheet;

pub(super) fn describe(sheet: &mut Sheet, access: &Access, now: Timestamp) {
    begin(sheet, &access.metadata, now);
    sheet.field("Role", access.spec.role.to_string());
    match &access.spec.namespaces {
        Some(namespaces) => sheet.field("Namespaces", namespaces.join(", ")),
        None => sheet.field("Namespaces", "(the whole cluster)"),
    };
    if access.spec.host_access {
        sheet.field("Hosts", "their tasks may reach into the nodes that they run on");
    }
    let subjects = access.spec.subjects.iter().map(|subject| match subject.kind {
        SubjectKind::User => format!("user {}", subject.name),
        SubjectKind::Group => format!("group {}", subject.name),
    });
    sheet.list("Subjects", subjects);
}
