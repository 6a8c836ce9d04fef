//! A store of the controller's in a process of its own, for tests that let it die: it goes on where it was left, and says
//! on its standard output what it was told to be durable.
//!
//! ```text
//! has NAME REVISION       what there is at its start
//! put NAME REVISION
//! compacted REVISION
//! ```

use std::path::PathBuf;

use muster_controller::store::{self, Key, Precondition, Resource};
use serde_json::json;
use tokio_util::sync::CancellationToken;

const MAPS: Resource = Resource::new("configmaps");
/// So many objects are written, each so often.
const OBJECTS: u32 = 20;
const TIMES: u32 = 5;

#[tokio::main(flavor = "current_thread")]
async fn main() {
    let file = PathBuf::from(std::env::args_os().nth(1).expect("store-writer FILE"));
    let (store, writer) = store::sqlite::open(&file).await.expect("it opens");
    let writes = tokio::spawn(writer.run(CancellationToken::new()));
    for there in store.list(MAPS, None).items {
        println!("has {} {}", there.key.name, there.revision);
    }
    for time in 0..TIMES {
        for name in (0..OBJECTS).map(|n| format!("c{n}")) {
            let key = Key::namespaced(MAPS, "default", name.clone());
            let value = json!({"metadata": {"name": name}, "data": {"time": time.to_string()}});
            let put = store.put(key, value, Precondition::Any).await.expect("it is written");
            println!("put {name} {}", put.revision);
        }
    }
    let through = store.revision();
    store.compact(through).await.expect("it is compacted");
    println!("compacted {through}");
    drop(store);
    writes.await.expect("it ends with the last handle");
}
