//! SQLite: one append-only table, one connection, one durable commit a batch.
//!
//! A batch is one `INSERT … SELECT … FROM json_each(?)`: each statement costs a hop to SQLite's thread, which is dearer
//! than parsing the JSON of a few short columns. The objects themselves come as one blob that is cut up, so that
//! SQLite does not parse and render them. The present state of an object is its newest row unless that row is a tombstone; the whole
//! table is read once, at start, in revision order, so no index but the primary key is kept.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures::future::BoxFuture;
use futures::{FutureExt as _, TryStreamExt as _};
use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions as _, Connection as _, Row as _, SqlSafeStr as _};

use super::backend::{Backend, BackendError, Batch, Compaction, Row};
use super::error::OpenError;
use super::state::RingLimits;
use super::{Change, Event, Store, Writer, writer};

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
}

/// Opens or creates the store in the file `path`.
///
/// # Errors
/// When the file was written by a newer version, is not a store, or cannot be read.
pub async fn open(path: &Path) -> Result<(Store, Writer), OpenError> {
    open_with(path, RingLimits::DEFAULT).await
}

pub(super) async fn open_with(
    path: &Path,
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
    let backend = Sqlite { options, connection: Some(connection) };
    writer::open(Box::new(backend), limits).await.map_err(failed)
}

async fn migrate(connection: &mut SqliteConnection, path: &Path) -> Result<(), OpenError> {
    let migrations = SCHEMA.iter().map(|&(version, description, sql)| {
        let description = Cow::Borrowed(description);
        Migration::new(version, description, MigrationType::Simple, sql.into_sql_str(), false)
    });
    let supported = SCHEMA.iter().map(|(version, ..)| *version).max().unwrap_or_default();
    let migrator = Migrator::with_migrations(migrations.collect());
    match migrator.run_direct(None, connection, false).await {
        Ok(()) => Ok(()),
        Err(MigrateError::VersionMissing(found)) if found > supported => {
            Err(OpenError::Newer { path: PathBuf::from(path), found, supported })
        }
        Err(error) => Err(OpenError::Backend { path: path.to_owned(), source: error.into() }),
    }
}

impl Sqlite {
    async fn connection(&mut self) -> Result<&mut SqliteConnection, BackendError> {
        if self.connection.is_none() {
            self.connection = Some(SqliteConnection::connect_with(&self.options).await?);
        }
        Ok(self.connection.as_mut().expect("connected above"))
    }

    async fn write(&mut self, batch: Batch<'_>) -> Result<(), BackendError> {
        let connection = self.connection().await?;
        let Some(Compaction { through, garbage }) = batch.compaction else {
            // One statement is a transaction by itself, and two hops to SQLite's thread are saved.
            insert(batch.events, connection).await?;
            return Ok(());
        };
        let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
        if !batch.events.is_empty() {
            insert(batch.events, &mut transaction).await?;
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
            let connection = self.connection().await?;
            let mut rows = sqlx::query(
                "SELECT revision, resource, namespace, name, uid, deleted, value FROM kv ORDER BY revision",
            )
            .fetch(&mut *connection);
            while let Some(row) = rows.try_next().await? {
                sink(Row {
                    revision: unsigned(row.try_get(0)?)?,
                    resource: row.try_get(1)?,
                    namespace: row.try_get(2)?,
                    name: row.try_get(3)?,
                    uid: row.try_get(4)?,
                    deleted: row.try_get(5)?,
                    value: row.try_get(6)?,
                });
            }
            drop(rows);
            let compacted = sqlx::query("SELECT value FROM meta WHERE name = 'compacted'")
                .fetch_one(connection)
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

async fn insert(events: &[Event], connection: &mut SqliteConnection) -> Result<(), sqlx::Error> {
    let (columns, objects) = rows(events);
    sqlx::query(INSERT).bind(columns).bind(objects).execute(connection).await?;
    Ok(())
}

/// The columns of each row but the object as JSON, with where the object lies in the bytes beside it, from 1.
fn rows(events: &[Event]) -> (String, Vec<u8>) {
    let mut objects = Vec::with_capacity(events.iter().map(|e| e.object.bytes.len()).sum());
    let mut columns = Vec::with_capacity(events.len());
    for event in events {
        let object = &event.object;
        columns.push((
            object.revision,
            object.key.resource.as_str(),
            object.key.namespace().unwrap_or_default(),
            &*object.key.name,
            &*object.uid,
            u8::from(event.change == Change::Delete),
            objects.len() + 1,
            object.bytes.len(),
        ));
        objects.extend_from_slice(&object.bytes);
    }
    (serde_json::to_string(&columns).expect("tuples of scalars serialize"), objects)
}

fn signed(revision: u64) -> Result<i64, BackendError> {
    i64::try_from(revision).map_err(|_| BackendError::Damaged(format!("revision {revision}")))
}

fn unsigned(revision: i64) -> Result<u64, BackendError> {
    u64::try_from(revision).map_err(|_| BackendError::Damaged(format!("revision {revision}")))
}
