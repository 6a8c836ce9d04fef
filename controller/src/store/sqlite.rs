//! SQLite: one append-only table, one connection, one durable commit a batch.
//!
//! A batch is one `INSERT … SELECT … FROM json_each(?)`: each statement costs a hop to SQLite's thread, which is dearer
//! than parsing the JSON of a few short columns. The objects themselves come as one blob that is cut up, so that
//! SQLite does not parse and render them. The present state of an object is its newest row unless that row is a tombstone; the whole
//! table is read once, at start, in revision order, so no index but the primary key is kept. Rows of Secrets are sealed
//! ([`super::seal`]); those of an older key are written anew when they are read.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use futures::future::BoxFuture;
use futures::{FutureExt as _, TryStreamExt as _};
use muster_failpoint::{Failpoint, Step, reach};
use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions as _, Connection as _, Row as _, SqlSafeStr as _};

use super::backend::{Backend, BackendError, Batch, Compaction, Row};
use super::error::OpenError;
use super::seal::{self, Keyring};
use super::state::RingLimits;
use super::{Change, Event, Key, Store, Writer, writer};
use crate::configs::SECRETS;

const SCHEMA: &[(i64, &str, &str)] = &[(
    1,
    "revisioned objects",
    "CREATE TABLE kv (
        revision  INTEGER PRIMARY KEY,
        resource  TEXT NOT NULL,
        namespace TEXT NOT NULL,
        name      TEXT NOT NULL,
        uid       TEXT NOT NULL,
        deleted   INTEGER NOT NULL,
        value     TEXT NOT NULL
    ) STRICT;
    CREATE TABLE meta (name TEXT PRIMARY KEY, value INTEGER NOT NULL) STRICT, WITHOUT ROWID;
    INSERT INTO meta (name, value) VALUES ('compacted', 0);",
)];

const INSERT: &str = "INSERT INTO kv (revision, resource, namespace, name, uid, deleted, value)
    SELECT value ->> 0, value ->> 1, value ->> 2, value ->> 3, value ->> 4, value ->> 5,
        CAST(substr(?2, value ->> 6, value ->> 7) AS TEXT)
    FROM json_each(?1)";

const COMPACT_META: &str = "UPDATE meta SET value = ? WHERE name = 'compacted'";
const COMPACT_ROWS: &str = "DELETE FROM kv WHERE revision IN (SELECT value FROM json_each(?))";

#[derive(Debug)]
struct Sqlite {
    options: SqliteConnectOptions,
    /// `None` after a failure: a connection whose commit failed is not trusted again.
    connection: Option<SqliteConnection>,
    keys: Arc<Keyring>,
}

/// Name of the file with the keys of Secrets, beside the store, when no other is named.
pub const KEY_FILE: &str = "encryption.key";
/// Bytes of sealed rows that are written anew in one transaction.
const RESEAL_AT_ONCE: usize = 4 << 20;

/// Opens or creates the store in the file `path`, with the keys beside it.
///
/// # Errors
/// When the file was written by a newer version, is not a store, or cannot be read.
pub async fn open(path: &Path) -> Result<(Store, Writer), OpenError> {
    open_with(path, &path.with_file_name(KEY_FILE), RingLimits::DEFAULT).await
}

/// The same with the keys of Secrets in another file.
///
/// # Errors
/// As [`open`], and when the keys are not those of the store.
pub async fn open_with_keys(path: &Path, keys: &Path) -> Result<(Store, Writer), OpenError> {
    open_with(path, keys, RingLimits::DEFAULT).await
}

pub(super) async fn open_with(
    path: &Path,
    keys: &Path,
    limits: RingLimits,
) -> Result<(Store, Writer), OpenError> {
    let options = SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .busy_timeout(Duration::from_secs(5))
        // 16 MiB of log between checkpoints: a checkpoint syncs twice and runs inside some caller's commit.
        .pragma("wal_autocheckpoint", "4096")
        .disable_statement_logging();
    let failed = |source| OpenError::Backend { path: path.to_owned(), source };
    let mut connection =
        SqliteConnection::connect_with(&options).await.map_err(|e| failed(e.into()))?;
    migrate(&mut connection, path).await?;
    let needed = has_sealed(&mut connection).await.map_err(|e| failed(e.into()))?;
    let keys = Arc::new(Keyring::open(keys, needed).map_err(OpenError::Keys)?);
    let backend = Sqlite { options, connection: Some(connection), keys };
    writer::open(Box::new(backend), limits).await.map_err(failed)
}

async fn migrate(connection: &mut SqliteConnection, path: &Path) -> Result<(), OpenError> {
    let migrations = SCHEMA.iter().map(|&(version, description, sql)| {
        let description = Cow::Borrowed(description);
        Migration::new(version, description, MigrationType::Simple, sql.into_sql_str(), false)
    });
    let supported = SCHEMA.iter().map(|(version, ..)| *version).max().unwrap_or_default();
    let migrator = Migrator::with_migrations(migrations.collect());
    reach(Failpoint::StoreSchema, Step::Before);
    let migrated = migrator.run_direct(None, connection, false).await;
    reach(Failpoint::StoreSchema, Step::After);
    match migrated {
        Ok(()) => Ok(()),
        Err(MigrateError::VersionMissing(found)) if found > supported => {
            Err(OpenError::Newer { path: PathBuf::from(path), found, supported })
        }
        Err(error) => Err(OpenError::Backend { path: path.to_owned(), source: error.into() }),
    }
}

async fn has_sealed(connection: &mut SqliteConnection) -> Result<bool, sqlx::Error> {
    let row = sqlx::query("SELECT EXISTS (SELECT 1 FROM kv WHERE resource = 'secrets')");
    row.fetch_one(connection).await?.try_get(0)
}

impl Sqlite {
    /// Writes rows anew that were sealed with an older key.
    async fn reseal(&mut self, mut rows: Vec<(i64, String)>) -> Result<(), BackendError> {
        if rows.is_empty() {
            return Ok(());
        }
        tracing::info!(rows = rows.len(), "Secrets of an older key are sealed anew");
        let connection = self.connection().await?;
        // What is overwritten is zeroed, not only forgotten.
        sqlx::query("PRAGMA secure_delete = ON").execute(&mut *connection).await?;
        while !rows.is_empty() {
            let mut bytes = 0;
            let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
            while bytes < RESEAL_AT_ONCE
                && let Some((revision, value)) = rows.pop()
            {
                bytes += value.len();
                let update = sqlx::query("UPDATE kv SET value = ? WHERE revision = ?");
                update.bind(value).bind(revision).execute(&mut *transaction).await?;
            }
            reach(Failpoint::StoreReseal, Step::Before);
            transaction.commit().await?;
            reach(Failpoint::StoreReseal, Step::After);
        }
        sqlx::query("PRAGMA secure_delete = OFF").execute(connection).await?;
        Ok(())
    }

    /// Puts everything into the database itself. What stands in the log after a sync that failed may be there in the kernel's
    /// memory alone, and later syncs pass over it: what follows it in the log would be lost with it.
    async fn empty_log(&mut self) -> Result<(), BackendError> {
        let checkpoint = sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)");
        let row = checkpoint.fetch_one(self.connection().await?).await?;
        match row.try_get(0)? {
            false => Ok(()),
            true => Err(BackendError::LogInUse),
        }
    }

    async fn connection(&mut self) -> Result<&mut SqliteConnection, BackendError> {
        if self.connection.is_none() {
            self.connection = Some(SqliteConnection::connect_with(&self.options).await?);
        }
        Ok(self.connection.as_mut().expect("connected above"))
    }

    async fn write(&mut self, batch: Batch<'_>) -> Result<(), BackendError> {
        let keys = Arc::clone(&self.keys);
        let connection = self.connection().await?;
        let Some(Compaction { through, garbage }) = batch.compaction else {
            // One statement is a transaction by itself, and two hops to SQLite's thread are saved.
            insert(&keys, batch.events, connection).await?;
            return Ok(());
        };
        let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
        if !batch.events.is_empty() {
            insert(&keys, batch.events, &mut transaction).await?;
        }
        sqlx::query(COMPACT_META).bind(signed(*through)?).execute(&mut *transaction).await?;
        let garbage = serde_json::to_string(garbage).expect("numbers serialize");
        sqlx::query(COMPACT_ROWS).bind(garbage).execute(&mut *transaction).await?;
        transaction.commit().await?;
        Ok(())
    }
}

impl Backend for Sqlite {
    fn load<'a>(
        &'a mut self,
        sink: &'a mut (dyn FnMut(Row) + Send),
    ) -> BoxFuture<'a, Result<u64, BackendError>> {
        async move {
            let keys = Arc::clone(&self.keys);
            let mut old = Vec::new();
            let connection = self.connection().await?;
            let mut rows = sqlx::query(
                "SELECT revision, resource, namespace, name, uid, deleted, value FROM kv ORDER BY revision",
            )
            .fetch(&mut *connection);
            while let Some(row) = rows.try_next().await? {
                let mut row = Row {
                    revision: unsigned(row.try_get(0)?)?,
                    resource: row.try_get(1)?,
                    namespace: row.try_get(2)?,
                    name: row.try_get(3)?,
                    uid: row.try_get(4)?,
                    deleted: row.try_get(5)?,
                    value: row.try_get(6)?,
                };
                if seal::is_sealed(&row.resource) {
                    let opened =
                        keys.unseal((&row.namespace, &row.name, &row.uid), &row.value)?;
                    row.value = opened.value;
                    if opened.old {
                        let key = Key::namespaced(SECRETS, &*row.namespace, &*row.name);
                        let anew = keys.seal(&key, &row.uid, row.value.as_bytes())?;
                        old.push((signed(row.revision)?, anew));
                    }
                }
                sink(row);
            }
            drop(rows);
            self.reseal(old).await?;
            // The log still has the rows as they were, also of a life that was killed before it came to this.
            let connection = self.connection().await?;
            sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)").execute(&mut *connection).await?;
            let compacted = sqlx::query("SELECT value FROM meta WHERE name = 'compacted'")
                .fetch_one(self.connection().await?)
                .await?;
            unsigned(compacted.try_get(0)?)
        }
        .boxed()
    }

    fn commit<'a>(&'a mut self, batch: Batch<'a>) -> BoxFuture<'a, Result<(), BackendError>> {
        async move {
            let result = self.write(batch).await;
            if result.is_err() {
                self.connection = None;
            }
            result
        }
        .boxed()
    }

    fn last_revision(&mut self) -> BoxFuture<'_, Result<u64, BackendError>> {
        async move {
            self.empty_log().await?;
            let row = sqlx::query(
                // The newest row may be a tombstone that a compaction took.
                "SELECT max(value, (SELECT coalesce(max(revision), 0) FROM kv)) FROM meta
                 WHERE name = 'compacted'",
            )
            .fetch_one(self.connection().await?)
            .await?;
            unsigned(row.try_get(0)?)
        }
        .boxed()
    }
}

async fn insert(
    keys: &Keyring,
    events: &[Event],
    connection: &mut SqliteConnection,
) -> Result<(), BackendError> {
    let (columns, objects) = rows(keys, events)?;
    sqlx::query(INSERT).bind(columns).bind(objects).execute(connection).await?;
    Ok(())
}

/// The columns of each row but the object as JSON, with where the object lies in the bytes beside it, from 1.
fn rows(keys: &Keyring, events: &[Event]) -> Result<(String, Vec<u8>), BackendError> {
    let mut objects = Vec::with_capacity(events.iter().map(|e| e.object.bytes.len()).sum());
    let mut columns = Vec::with_capacity(events.len());
    for event in events {
        let object = &event.object;
        let value = match seal::is_sealed(object.key.resource.as_str()) {
            true => keys.seal(&object.key, &object.uid, &object.bytes)?.into_bytes().into(),
            false => object.bytes.clone(),
        };
        columns.push((
            object.revision,
            object.key.resource.as_str(),
            object.key.namespace().unwrap_or_default(),
            &*object.key.name,
            &*object.uid,
            u8::from(event.change == Change::Delete),
            objects.len() + 1,
            value.len(),
        ));
        objects.extend_from_slice(&value);
    }
    Ok((serde_json::to_string(&columns).expect("tuples of scalars serialize"), objects))
}

fn signed(revision: u64) -> Result<i64, BackendError> {
    i64::try_from(revision).map_err(|_| BackendError::Damaged(format!("revision {revision}")))
}

fn unsigned(revision: i64) -> Result<u64, BackendError> {
    u64::try_from(revision).map_err(|_| BackendError::Damaged(format!("revision {revision}")))
}
