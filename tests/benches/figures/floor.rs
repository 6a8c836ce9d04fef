//! What the machine itself can do: the floors that figures are ratios of.

use std::fs::File;
use std::io::Write as _;
use std::path::Path;
use std::time::{Duration, Instant};

use sqlx::Connection as _;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteSynchronous};

use crate::stats::{Samples, millis};

/// Median of `fdatasync` after a write of 4 KiB, in `dir`.
pub(crate) fn fdatasync(dir: &Path) -> Duration {
    let mut file = File::create(dir.join("fdatasync")).expect("writable");
    let mut samples = Samples::default();
    for _ in 0..200 {
        file.write_all(&[7; 4096]).expect("space");
        let begin = Instant::now();
        file.sync_data().expect("the disk takes it");
        samples.push(begin.elapsed());
    }
    samples.median()
}

/// Runs `work` between two measurements of `fdatasync`, and says when the disk swung too much for
/// the figures in between to mean anything.
pub(crate) async fn between_syncs<T>(dir: &Path, work: impl Future<Output = T>) -> T {
    let before = fdatasync(dir);
    let value = work.await;
    let after = fdatasync(dir);
    let swing = before.max(after).as_secs_f64() / before.min(after).as_secs_f64();
    println!(
        "  fdatasync 4 KiB p50: {:.3} ms before, {:.3} ms after",
        millis(before),
        millis(after)
    );
    if swing > 2.0 {
        println!("  VOID: the disk swung by {swing:.1}x during the run");
    }
    value
}

/// A SQLite database as the store's, WAL and FULL.
pub(crate) struct Rows {
    connection: SqliteConnection,
    next: i64,
}

impl Rows {
    pub(crate) async fn open(dir: &Path) -> Self {
        let options = SqliteConnectOptions::new()
            .filename(dir.join("floor.db"))
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full);
        let mut connection = SqliteConnection::connect_with(&options).await.expect("SQLite");
        for statement in
            ["DROP TABLE IF EXISTS rows", "CREATE TABLE rows(id INTEGER PRIMARY KEY, value TEXT)"]
        {
            sqlx::query(statement).execute(&mut connection).await.expect("a new table");
        }
        Rows { connection, next: 0 }
    }

    /// One durable transaction of `rows` rows of 1.5 kB, one statement a row.
    pub(crate) async fn commit(&mut self, rows: usize) -> Duration {
        let value = "x".repeat(1500);
        let begin = Instant::now();
        let mut transaction =
            self.connection.begin_with("BEGIN IMMEDIATE").await.expect("the only writer");
        for _ in 0..rows {
            self.next += 1;
            sqlx::query("INSERT INTO rows VALUES (?, ?)")
                .bind(self.next)
                .bind(&value)
                .execute(&mut *transaction)
                .await
                .expect("a row");
        }
        transaction.commit().await.expect("durable");
        begin.elapsed()
    }
}
