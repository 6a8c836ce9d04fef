//! The suite that every backend passes, and what only SQLite can show: that acknowledged writes survive.

use std::path::Path;
use std::sync::Arc;

use serde_json::{Value, json};
use tokio::task::{JoinHandle, JoinSet};
use tokio_util::sync::CancellationToken;

use super::state::RingLimits;
use super::*;

const TASKS: Resource = Resource::new("tasks");
const NODES: Resource = Resource::new("nodes");

/// A store with its writer running, which ends the way the test says.
struct Running {
    store: Store,
    stop: CancellationToken,
    writer: JoinHandle<()>,
}

impl Running {
    fn new((store, writer): (Store, Writer)) -> Self {
        let stop = CancellationToken::new();
        let writer = tokio::spawn(writer.run(stop.clone()));
        Self { store, stop, writer }
    }

    async fn memory() -> Self {
        let (store, writer, _) = memory::open().await;
        Self::new((store, writer))
    }

    async fn sqlite(path: &Path) -> Self {
        Self::new(sqlite::open(path).await.unwrap())
    }

    async fn small(path: &Path, events: usize) -> Self {
        let limits = RingLimits { events, bytes: 1 << 20 };
        Self::new(sqlite::open_with(path, &path.with_file_name("keys"), limits).await.unwrap())
    }

    async fn shut_down(self) {
        self.stop.cancel();
        self.writer.await.unwrap();
    }

    async fn kill(self) {
        self.writer.abort();
        assert!(self.writer.await.unwrap_err().is_cancelled());
    }
}

fn task(name: &str) -> Key {
    Key::namespaced(TASKS, "default", name)
}

fn body(name: &str, n: u64) -> Value {
    json!({"kind": "Task", "metadata": {"name": name, "uid": format!("uid-{name}")}, "spec": {"n": n}})
}

fn names(snapshot: &Snapshot) -> Vec<String> {
    snapshot.items.iter().map(|stored| stored.key.name.to_string()).collect()
}

async fn create(store: &Store, name: &str) -> Arc<Stored> {
    store.create(task(name), body(name, 0)).await.unwrap()
}

async fn preconditions(store: &Store) {
    let a = create(store, "a").await;
    assert_eq!(a.value()["metadata"]["resourceVersion"], a.revision.to_string());
    assert_eq!(store.get(&a.key).unwrap(), a, "a write is visible before it is answered");
    let again = store.create(task("a"), body("a", 1)).await;
    assert!(matches!(again, Err(StoreError::AlreadyExists { .. })), "{again:?}");
    let stale = store.apply_one(Op::replace(task("a"), body("a", 1), a.revision + 7)).await;
    assert!(matches!(stale, Err(StoreError::Conflict { .. })), "{stale:?}");
    let other = store.delete(task("a"), Precondition::uid("other")).await;
    assert!(matches!(other, Err(StoreError::UidMismatch { .. })), "{other:?}");
    let missing = store.delete(task("b"), Precondition::Any).await;
    assert!(matches!(missing, Err(StoreError::NotFound { .. })), "{missing:?}");
    let both = Precondition::Match { revision: Some(a.revision), uid: Some("uid-a".into()) };
    let next = store.put(task("a"), body("a", 1), both).await.unwrap();
    assert_eq!(next.revision, a.revision + 1);
    let said = store.apply_one(Op::status(&next, &json!({"phase": "Bound"}))).await.unwrap();
    let mut expected = body("a", 1);
    expected["metadata"]["resourceVersion"] = said.revision.to_string().into();
    expected["status"] = json!({"phase": "Bound"});
    assert_eq!(said.value(), expected, "a status replaces nothing else");
    let late = store.apply_one(Op::status(&next, &json!({"phase": "Running"}))).await;
    assert!(matches!(late, Err(StoreError::Conflict { .. })), "{late:?}");
    let gone = store.delete(task("a"), Precondition::revision(said.revision)).await.unwrap();
    assert_eq!(gone.value()["metadata"]["resourceVersion"], gone.revision.to_string());
    assert_eq!(store.get(&task("a")), None);
}

async fn transactions_are_whole(store: &Store) {
    let before = store.revision();
    let refused = store
        .apply(vec![
            Op::create(task("t1"), body("t1", 0)),
            Op::create(task("t2"), body("t2", 0)),
            Op::create(task("t1"), body("t1", 1)),
        ])
        .await;
    assert!(matches!(refused, Err(StoreError::AlreadyExists { .. })), "{refused:?}");
    assert_eq!((store.revision(), store.get(&task("t1"))), (before, None));
    let done = store
        .apply(vec![
            Op::create(task("t1"), body("t1", 0)),
            Op::replace(task("t1"), body("t1", 1), before + 1),
            Op::remove(task("t1"), before + 2),
            Op::create(task("t1"), body("t1", 3)),
        ])
        .await
        .unwrap();
    let revisions: Vec<u64> = done.iter().map(|stored| stored.revision).collect();
    assert_eq!(
        revisions,
        (before + 1..=before + 4).collect::<Vec<_>>(),
        "one revision an operation"
    );
    assert_eq!(store.get(&task("t1")).unwrap().value()["spec"]["n"], 3);
    let check = |precondition| Op::Check { key: task("t1"), precondition };
    let relied = vec![check(Precondition::Absent), Op::create(task("t2"), body("t2", 0))];
    let relied = store.apply(relied).await;
    assert!(matches!(relied, Err(StoreError::AlreadyExists { .. })), "{relied:?}");
    let checked = store.apply(vec![check(Precondition::revision(before + 4))]).await.unwrap();
    assert_eq!((checked, store.revision()), (vec![], before + 4), "a check leaves no trace");
    store.delete(task("t1"), Precondition::Any).await.unwrap();
}

async fn a_look_holds_until_something_of_it_is_written(store: &Store) {
    let still = |revision| Op::Still { revision, of: &[TASKS] };
    let looked = store.revision();
    store.create(Key::cluster(NODES, "beside"), json!({"metadata": {}})).await.unwrap();
    let mine = |name: &str| Op::create(task(name), body(name, 0));
    let done = store.apply(vec![still(looked), mine("still-1"), mine("still-2")]).await.unwrap();
    assert_eq!(done.len(), 2, "what it writes itself is nothing against it");
    let moved = store.apply(vec![still(looked), mine("still-3")]).await.unwrap_err();
    let is_it = |key: &Option<Key>| *key == Some(task("still-1"));
    assert!(matches!(&moved, StoreError::Moved { key, .. } if is_it(key)), "{moved:?}");
    assert!(store.get(&task("still-3")).is_none());
    let ahead = store.apply(vec![still(store.revision() + 1), mine("still-3")]).await;
    assert!(matches!(ahead, Err(StoreError::Moved { key: None, .. })), "{ahead:?}");
    // Of all that look at the same time one writes, whether they are in one batch or not.
    let looked = store.revision();
    let mut all = JoinSet::new();
    for n in 0..32 {
        let (store, key) = (store.clone(), task(&format!("race-{n}")));
        all.spawn(async move {
            let ops =
                vec![Op::Still { revision: looked, of: &[TASKS] }, Op::create(key, body("x", n))];
            store.apply(ops).await.is_ok()
        });
    }
    assert_eq!(all.join_all().await.into_iter().filter(|won| *won).count(), 1);
}

async fn lists_are_ordered_and_exact(store: &Store) {
    for name in ["l3", "l1", "l2"] {
        create(store, name).await;
    }
    let other = Key::namespaced(TASKS, "other", "l0");
    store.create(other.clone(), body("l0", 0)).await.unwrap();
    store.create(Key::cluster(NODES, "n"), body("n", 0)).await.unwrap();
    let page = store.list(TASKS, Some("default"));
    assert_eq!(names(&page), ["l1", "l2", "l3"]);
    assert_eq!(names(&store.list(TASKS, None)), ["l1", "l2", "l3", "l0"]);
    assert_eq!(names(&store.list(NODES, None)), ["n"]);
    assert_eq!(page.revision, store.revision());

    // A page that is continued sees none of what happened since.
    store.delete(task("l2"), Precondition::Any).await.unwrap();
    create(store, "l4").await;
    store.put(task("l3"), body("l3", 9), Precondition::Any).await.unwrap();
    let rest = store.list_at(TASKS, Some("default"), Some(&task("l1")), page.revision).unwrap();
    assert_eq!(rest.items, page.items[1..]);
    for name in ["l1", "l3", "l4"] {
        store.delete(task(name), Precondition::Any).await.unwrap();
    }
    store.delete(other, Precondition::Any).await.unwrap();
}

async fn watches_resume_and_carry_what_was(store: &Store) {
    let start = store.revision();
    let mut early = store.watch(TASKS, start).unwrap();
    create(store, "w").await;
    store.create(Key::cluster(NODES, "w"), body("w", 0)).await.unwrap();
    store.put(task("w"), body("w", 1), Precondition::Any).await.unwrap();
    store.delete(task("w"), Precondition::Any).await.unwrap();
    let mut seen = Vec::new();
    while seen.len() < 3 {
        seen.extend(early.next().await.unwrap());
    }
    assert_eq!(store.watch(TASKS, start).unwrap().take().unwrap(), seen, "resumed = lived through");
    let kinds: Vec<_> = seen.iter().map(|event| (event.change, event.revision() - start)).collect();
    assert_eq!(kinds, [(Change::Put, 1), (Change::Put, 3), (Change::Delete, 4)]);
    assert_eq!(seen[0].previous, None);
    assert_eq!(seen[1].previous.as_ref(), Some(&seen[0].object));
    assert_eq!(seen[2].previous.as_ref(), Some(&seen[1].object));
    assert_eq!(seen[2].object.value()["metadata"]["resourceVersion"], (start + 4).to_string());
    let ahead = store.watch(TASKS, start + 1000).unwrap_err();
    assert_eq!(ahead, WatchError::Ahead { asked: start + 1000, current: start + 4 });
}

async fn a_namesake_follows_in_one_transaction(store: &Store) {
    let named = |uid: &str| {
        let mut value = body("same", 1);
        value["metadata"]["uid"] = uid.into();
        value
    };
    let key = task("same");
    let old = store.create(key.clone(), named("one")).await.unwrap();
    let start = store.revision();
    let mut changes = store.watch(TASKS, start).unwrap();
    let put = |uid| Op::create(key.clone(), named(uid));
    let late = store.apply(vec![Op::remove(key.clone(), old.revision + 7), put("two")]).await;
    assert!(matches!(late, Err(StoreError::Conflict { .. })), "{late:?}");
    let first = store.apply(vec![put("two"), Op::remove(key.clone(), old.revision)]).await;
    assert!(matches!(first, Err(StoreError::AlreadyExists { .. })), "{first:?}");
    store.apply(vec![Op::remove(key.clone(), old.revision), put("two")]).await.unwrap();
    let seen: Vec<(Change, u64, String)> = changes
        .next()
        .await
        .unwrap()
        .iter()
        .map(|event| (event.change, event.revision() - start, event.object.uid.to_string()))
        .collect();
    let (one, two) = ("one".to_owned(), "two".to_owned());
    assert_eq!(seen, [(Change::Delete, 1, one), (Change::Put, 2, two)]);
    assert_eq!(&*store.get(&key).unwrap().uid, "two");
    store.delete(key, Precondition::Any).await.unwrap();
}

async fn updates_do_not_lose_each_other(store: &Store) {
    create(store, "counter").await;
    let mut clients = JoinSet::new();
    for _ in 0..8 {
        let store = store.clone();
        clients.spawn(async move {
            for _ in 0..10 {
                let bump = |_: &Stored, mut value: Value| -> Result<_, ()> {
                    value["spec"]["n"] = (value["spec"]["n"].as_u64().unwrap() + 1).into();
                    Ok(Some(value))
                };
                store.update(&task("counter"), bump).await.unwrap();
            }
        });
    }
    clients.join_all().await;
    assert_eq!(store.get(&task("counter")).unwrap().value()["spec"]["n"], 80);
    let refused = store.update(&task("counter"), |_, _| Err::<Option<Value>, _>("no")).await;
    assert!(matches!(refused, Err(UpdateError::Refused("no"))), "{refused:?}");
    store.delete(task("counter"), Precondition::Any).await.unwrap();
}

async fn compaction_expires_watches(store: &Store) {
    let start = store.revision();
    let mut behind = store.watch(TASKS, start).unwrap();
    create(store, "c").await;
    create(store, "d").await;
    store.compact(start + 1).await.unwrap();
    let expired = Expired { asked: start, compacted: start + 1 };
    assert_eq!(behind.next().await, Err(WatchEnd::Expired(expired)));
    assert_eq!(store.watch(TASKS, start).unwrap_err(), WatchError::Expired(expired));
    assert_eq!(store.watch(TASKS, start + 1).unwrap().take().unwrap().len(), 1);
    assert_eq!(names(&store.list(TASKS, None)), ["c", "d"], "what is live stays");
    store.delete(task("c"), Precondition::Any).await.unwrap();
    store.delete(task("d"), Precondition::Any).await.unwrap();
}

async fn malformed_values_are_refused(store: &Store) {
    let refused = store.create(task("m"), json!({"metadata": 1})).await;
    assert!(matches!(refused, Err(StoreError::Malformed { .. })), "{refused:?}");
}

async fn suite(running: Running) {
    let store = &running.store;
    preconditions(store).await;
    transactions_are_whole(store).await;
    lists_are_ordered_and_exact(store).await;
    watches_resume_and_carry_what_was(store).await;
    a_namesake_follows_in_one_transaction(store).await;
    updates_do_not_lose_each_other(store).await;
    compaction_expires_watches(store).await;
    malformed_values_are_refused(store).await;
    a_look_holds_until_something_of_it_is_written(store).await;
    let mut last = store.watch(TASKS, store.revision()).unwrap();
    let store = store.clone();
    running.shut_down().await;
    assert_eq!(last.next().await, Err(WatchEnd::Closed), "watches end with the writer");
    let late = store.create(task("late"), body("late", 0)).await;
    assert!(matches!(late, Err(StoreError::Closed)), "{late:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn memory_keeps_the_contract() {
    suite(Running::memory().await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sqlite_keeps_the_contract() {
    let dir = tempfile::tempdir().unwrap();
    suite(Running::sqlite(&dir.path().join("db")).await).await;
}

#[tokio::test]
async fn a_failed_commit_leaves_no_trace() {
    let (store, writer, failures) = memory::open().await;
    let running = Running::new((store.clone(), writer));
    let before = create(&store, "kept").await;
    let mut watcher = store.watch(TASKS, before.revision).unwrap();
    failures.fail_next(1);
    let (a, b) = tokio::join!(
        store.create(task("a"), body("a", 0)),
        store.put(task("kept"), body("kept", 1), Precondition::Any),
    );
    assert!(matches!(a, Err(StoreError::Storage { .. })), "{a:?}");
    assert!(matches!(b, Err(StoreError::Storage { .. })), "{b:?}");
    assert_eq!(store.get(&before.key).unwrap(), before);
    assert_eq!(store.revision(), before.revision);
    assert!(watcher.take().unwrap().is_empty());
    let next = create(&store, "a").await;
    assert_eq!(next.revision, before.revision + 1, "revisions stay consecutive");
    running.shut_down().await;
}

#[tokio::test]
async fn a_commit_that_only_seemed_to_fail_is_published_late() {
    let (store, writer, failures) = memory::open().await;
    let running = Running::new((store.clone(), writer));
    failures.mislead_next(1);
    let unsure = store.create(task("a"), body("a", 0)).await;
    assert!(matches!(unsure, Err(StoreError::Storage { .. })), "{unsure:?}");
    assert_eq!(store.get(&task("a")), None, "not before the disk was asked");
    store.settled().await.unwrap();
    assert!(store.get(&task("a")).is_some(), "the disk was asked");
    let again = store.create(task("a"), body("a", 0)).await;
    assert!(matches!(again, Err(StoreError::AlreadyExists { .. })), "{again:?}");
    assert_eq!(create(&store, "b").await.revision, 2);
    assert_eq!(store.watch(TASKS, 0).unwrap().take().unwrap().len(), 2);
    running.shut_down().await;
}

#[tokio::test]
async fn a_row_that_sqlite_refuses_fails_its_whole_batch() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("db");
    let running = Running::sqlite(&path).await;
    let store = running.store.clone();
    create(&store, "kept").await;
    let mut other = connect(&path).await;
    let poison = "CREATE TRIGGER poison BEFORE INSERT ON kv WHEN new.name = 'poison'
        BEGIN SELECT RAISE(ABORT, 'no room'); END";
    sqlx::query(poison).execute(&mut other).await.unwrap();
    let refused = store
        .apply(vec![
            Op::create(task("x"), body("x", 0)),
            Op::create(task("poison"), body("poison", 0)),
        ])
        .await;
    assert!(matches!(refused, Err(StoreError::Storage { .. })), "{refused:?}");
    assert_eq!(names(&store.list(TASKS, None)), ["kept"]);
    store.settled().await.unwrap();
    let log = path.with_file_name("db-wal").metadata().unwrap();
    assert_eq!(log.len(), 0, "nothing relies on what a failed sync may have left there");
    create(&store, "after").await;
    running.shut_down().await;
    let again = Running::sqlite(&path).await;
    assert_eq!(names(&again.store.list(TASKS, None)), ["after", "kept"]);
    again.shut_down().await;
}

#[tokio::test]
async fn reopening_finds_objects_history_and_the_revision() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("db");
    let running = Running::sqlite(&path).await;
    let store = running.store.clone();
    create(&store, "a").await;
    store.put(task("a"), body("a", 1), Precondition::Any).await.unwrap();
    create(&store, "b").await;
    store.create(Key::cluster(NODES, "ünïcode\"'"), body("n", 0)).await.unwrap();
    store.delete(task("b"), Precondition::Any).await.unwrap();
    let (live, nodes) = (store.list(TASKS, None).items, store.list(NODES, None).items);
    let history = store.watch_all(0).unwrap().take().unwrap();
    running.shut_down().await;

    let again = Running::sqlite(&path).await;
    assert_eq!(again.store.revision(), 5);
    assert_eq!(again.store.list(TASKS, None).items, live);
    assert_eq!(again.store.list(NODES, None).items, nodes);
    assert_eq!(again.store.watch_all(0).unwrap().take().unwrap(), history);
    again.shut_down().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_acknowledged_survives_a_kill() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("db");
    let running = Running::sqlite(&path).await;
    let mut clients = JoinSet::new();
    for client in 0..16 {
        let store = running.store.clone();
        clients.spawn(async move {
            let mut acknowledged = Vec::new();
            for n in 0.. {
                let name = format!("c{client}-{n}");
                match store.create(task(&name), body(&name, n)).await {
                    Ok(stored) => acknowledged.push(stored),
                    Err(_) => break,
                }
            }
            acknowledged
        });
    }
    let mut watcher = running.store.watch(TASKS, 0).unwrap();
    while watcher.revision() < 200 {
        watcher.next().await.unwrap();
    }
    running.kill().await;
    let acknowledged: Vec<_> = clients.join_all().await.into_iter().flatten().collect();
    assert!(acknowledged.len() >= 100);
    let again = Running::sqlite(&path).await;
    for stored in acknowledged {
        assert_eq!(again.store.get(&stored.key), Some(stored));
    }
    again.shut_down().await;
}

#[tokio::test]
async fn a_torn_log_loses_only_its_last_commit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("db");
    let running = Running::sqlite(&path).await;
    create(&running.store, "first").await;
    let wal = dir.path().join("db-wal");
    let whole = std::fs::metadata(&wal).unwrap().len();
    create(&running.store, "second").await;
    let torn = (whole + std::fs::metadata(&wal).unwrap().len()) / 2;
    // Power loss in the middle of the second commit, before it was answered.
    for file in ["db", "db-wal"] {
        std::fs::copy(dir.path().join(file), dir.path().join(format!("copy{}", &file[2..])))
            .unwrap();
    }
    let copy = dir.path().join("copy");
    std::fs::File::options()
        .write(true)
        .open(dir.path().join("copy-wal"))
        .unwrap()
        .set_len(torn)
        .unwrap();
    running.kill().await;
    let again = Running::sqlite(&copy).await;
    assert_eq!(names(&again.store.list(TASKS, None)), ["first"]);
    assert_eq!(again.store.revision(), 1);
    create(&again.store, "second").await;
    again.shut_down().await;
}

#[tokio::test]
async fn old_history_leaves_the_disk_and_the_counter_stays() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("db");
    let running = Running::small(&path, 8).await;
    let store = running.store.clone();
    for n in 0..40 {
        store.put(task("hot"), body("hot", n), Precondition::Any).await.unwrap();
    }
    create(&store, "cold").await;
    let gone = store.delete(task("hot"), Precondition::Any).await.unwrap();
    store.compact(gone.revision).await.unwrap();
    running.shut_down().await;
    let mut other = connect(&path).await;
    let left: i64 =
        sqlx::query_scalar("SELECT count(*) FROM kv").fetch_one(&mut other).await.unwrap();
    assert_eq!(left, 1, "only the live object has a row");
    let again = Running::small(&path, 8).await;
    assert_eq!(again.store.revision(), gone.revision);
    assert_eq!(names(&again.store.list(TASKS, None)), ["cold"]);
    assert!(again.store.watch(TASKS, gone.revision - 1).is_err());
    assert_eq!(create(&again.store, "new").await.revision, gone.revision + 1);
    again.shut_down().await;
}

#[tokio::test]
async fn a_newer_schema_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("db");
    Running::sqlite(&path).await.shut_down().await;
    let mut other = connect(&path).await;
    sqlx::query(
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
         VALUES (99, 'from the future', 1, x'00', 0)",
    )
    .execute(&mut other)
    .await
    .unwrap();
    let refused = sqlite::open(&path).await.unwrap_err();
    assert!(matches!(refused, OpenError::Newer { found: 99, supported: 1, .. }), "{refused:?}");
}

const SECRETS: Resource = Resource::new("secrets");

fn secret(password: &str) -> Value {
    json!({"metadata": {"name": "s", "uid": "u"}, "data": {"password": password}})
}

/// Where a text stands in the files of a directory.
fn files_with(dir: &Path, text: &str) -> Vec<std::path::PathBuf> {
    let all = std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path());
    let has = |path: &std::path::PathBuf| {
        let bytes = std::fs::read(path).unwrap();
        bytes.windows(text.len()).any(|window| window == text.as_bytes())
    };
    all.filter(has).collect()
}

#[tokio::test]
async fn secrets_are_sealed_on_disk_and_their_keys_can_be_rotated() {
    let dir = tempfile::tempdir().unwrap();
    let (path, keys) = (dir.path().join("db"), dir.path().join(sqlite::KEY_FILE));
    let key = Key::namespaced(SECRETS, "default", "s");
    let running = Running::sqlite(&path).await;
    for password in ["hunter-one", "hunter-two"] {
        let put =
            Op::Put { key: key.clone(), value: secret(password), precondition: Precondition::Any };
        running.store.apply_one(put).await.unwrap();
    }
    assert_eq!(files_with(dir.path(), "hunter"), Vec::<std::path::PathBuf>::new());
    running.shut_down().await;

    let old = std::fs::read_to_string(&keys).unwrap();
    // A key that is gone, and a wrong one: nothing is lost, and both are said.
    std::fs::remove_file(&keys).unwrap();
    let missing = sqlite::open(&path).await.unwrap_err();
    assert!(matches!(missing, OpenError::Keys(seal::SealError::Missing { .. })), "{missing}");
    let line = old.lines().last().unwrap();
    let new =
        if line.starts_with('A') { line.replacen('A', "B", 1) } else { format!("A{}", &line[1..]) };
    let write = |text: &str| {
        std::fs::write(&keys, text).unwrap();
        use std::os::unix::fs::PermissionsExt as _;
        std::fs::set_permissions(&keys, std::fs::Permissions::from_mode(0o600)).unwrap();
    };
    write(&new);
    let wrong = sqlite::open(&path).await.unwrap_err();
    let OpenError::Backend { source: BackendError::Sealed(source), .. } = &wrong else {
        panic!("{wrong:?}")
    };
    assert!(matches!(source, seal::SealError::WrongKey { .. }), "{source}");

    // Both: old rows are written anew, and then the old key is not needed.
    let id = |at: &Path| {
        let bytes = std::fs::read(at).unwrap();
        let text = String::from_utf8_lossy(&bytes).into_owned();
        text.match_indices("sealed:v1:")
            .map(|(i, m)| text[i + m.len()..][..16].to_owned())
            .collect::<std::collections::BTreeSet<_>>()
    };
    let before = id(&path);
    write(&format!("{new}\n{old}"));
    Running::sqlite(&path).await.shut_down().await;
    write(&new);
    let running = Running::sqlite(&path).await;
    let stored = running.store.get(&key).unwrap();
    assert_eq!(stored.value()["data"]["password"], "hunter-two");
    running.shut_down().await;
    let after = id(&path);
    assert_eq!(after.len(), 1, "{after:?}");
    assert!(before.is_disjoint(&after), "{before:?} {after:?}");
}

async fn connect(path: &Path) -> sqlx::SqliteConnection {
    use sqlx::Connection as _;
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(path);
    sqlx::SqliteConnection::connect_with(&options).await.unwrap()
}
