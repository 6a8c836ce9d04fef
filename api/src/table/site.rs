//! Sites: whose floor plan it is, and how large.

use crate::kind::site::Site;

use super::{Column, age};

pub(super) const COLUMNS: &[Column<Site>] = &[
    Column::new("MAP", |site, _| {
        let name = site.metadata.name.as_deref().unwrap_or_default();
        site.spec.map.as_deref().unwrap_or(name).into()
    }),
    Column::new("SIZE", |site, _| {
        let size = site.spec.grid.as_ref().map(|grid| {
            let metres = |cells: u32| f64::from(cells) * grid.resolution;
            format!("{:.1}x{:.1}m", metres(grid.width), metres(grid.height))
        });
        size.unwrap_or_default().into()
    }),
    Column::new("RESOLUTION", |site, _| {
        let resolution = site.spec.grid.as_ref().map(|grid| format!("{}m", grid.resolution));
        resolution.unwrap_or_default().into()
    }),
    Column::new("INFLATION", |site, _| format!("{}m", site.spec.inflation).into()),
    Column::new("AGE", |site, now| age(site.metadata.creation_timestamp.as_ref(), now)),
];
