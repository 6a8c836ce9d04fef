//! ConfigMaps and Secrets: how many keys, never what stands under them.

use crate::kind::config_map::ConfigMap;
use crate::kind::secret::Secret;

use super::{Column, age};

pub(super) const CONFIG_MAP: &[Column<ConfigMap>] = &[
    Column::new("DATA", |map, _| {
        let binary = map.binary_data.iter().flatten().count();
        (map.data.iter().flatten().count() + binary).to_string().into()
    }),
    Column::new("AGE", |map, now| age(map.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("IMMUTABLE", |map, _| map.immutable.unwrap_or_default().to_string().into()),
];

pub(super) const SECRET: &[Column<Secret>] = &[
    Column::new("TYPE", |secret, _| secret.type_.clone().unwrap_or_default().into()),
    Column::new("DATA", |secret, _| secret.data.iter().flatten().count().to_string().into()),
    Column::new("AGE", |secret, now| age(secret.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("IMMUTABLE", |secret, _| secret.immutable.unwrap_or_default().to_string().into()),
];
