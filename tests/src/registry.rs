//! A registry of images on loopback, where the Docker Engine needs no TLS: as much of its API as a pull asks for.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;

use crate::docker;

const MANIFEST: &str = "application/vnd.docker.distribution.manifest.v2+json";
const CONFIG: &str = "application/vnd.docker.container.image.v1+json";
const LAYER: &str = "application/vnd.docker.image.rootfs.diff.tar.gzip";

/// What is at a path below `/v2/`.
#[derive(Debug, Clone)]
struct Content {
    kind: &'static str,
    digest: String,
    bytes: Arc<[u8]>,
}

type Contents = Arc<Mutex<BTreeMap<String, Content>>>;

/// The registry. Its images are removed from the engine when it is dropped.
#[derive(Debug)]
pub struct Registry {
    address: SocketAddr,
    contents: Contents,
    images: Mutex<Vec<String>>,
    serving: JoinHandle<()>,
}

fn digest(bytes: &[u8]) -> String {
    let sum = ring::digest::digest(&ring::digest::SHA256, bytes);
    let letters: String = sum.as_ref().iter().map(|byte| format!("{byte:02x}")).collect();
    format!("sha256:{letters}")
}

impl Registry {
    /// An empty registry.
    ///
    /// # Panics
    ///
    /// When no port can be had.
    pub async fn start() -> Registry {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port of the kernel's");
        let address = listener.local_addr().expect("it listens");
        let contents = Contents::default();
        let shown = Arc::clone(&contents);
        let serving = tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                tokio::spawn(serve(stream, Arc::clone(&shown)));
            }
        });
        Registry { address, contents, images: Mutex::default(), serving }
    }

    /// The name that a container uses for an image of this registry, whether it is there or not.
    #[must_use]
    pub fn name(&self, image: &str) -> String {
        format!("{}/{image}:1", self.address)
    }

    /// Puts an image of busybox there, with a label that makes it another one than all others.
    #[must_use]
    pub fn put(&self, image: &str) -> String {
        let layer = docker::root();
        let config = json!({
            "architecture": "amd64", "os": "linux", "config": {"Cmd": ["/bin/sh"], "Labels": {"name": image}},
            "rootfs": {"type": "layers", "diff_ids": [digest(&layer)]},
        });
        let config = config.to_string().into_bytes();
        let part = |kind: &str, bytes: &[u8]| json!({"mediaType": kind, "size": bytes.len(), "digest": digest(bytes)});
        let manifest: Value = json!({
            "schemaVersion": 2, "mediaType": MANIFEST,
            "config": part(CONFIG, &config), "layers": [part(LAYER, &layer)],
        });
        let manifest = manifest.to_string().into_bytes();
        let mut contents = self.contents.lock().unwrap_or_else(PoisonError::into_inner);
        let mut put = |path: String, kind, bytes: &[u8]| {
            contents.insert(path, Content { kind, digest: digest(bytes), bytes: bytes.into() });
        };
        for reference in ["1".to_owned(), digest(&manifest)] {
            put(format!("{image}/manifests/{reference}"), MANIFEST, &manifest);
        }
        put(format!("{image}/blobs/{}", digest(&config)), "application/octet-stream", &config);
        put(format!("{image}/blobs/{}", digest(&layer)), "application/octet-stream", &layer);
        drop(contents);
        let name = self.name(image);
        self.images.lock().unwrap_or_else(PoisonError::into_inner).push(name.clone());
        name
    }
}

impl Drop for Registry {
    fn drop(&mut self) {
        self.serving.abort();
        for image in self.images.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            docker::remove_image(image);
        }
    }
}

/// One request a connection. One that speaks TLS is told so by an answer that is none.
async fn serve(stream: TcpStream, contents: Contents) {
    let mut stream = BufReader::new(stream);
    let mut head = Vec::new();
    loop {
        let before = head.len();
        let read = stream.read_until(b'\n', &mut head).await;
        // The end of the head, of the stream, or nothing that is HTTP.
        if read.is_err() || head.len() - before <= 2 || !head[0].is_ascii_uppercase() {
            break;
        }
    }
    let answer = answer(&String::from_utf8_lossy(&head), &contents);
    // Who does not wait for the answer is not told.
    drop(stream.write_all(&answer).await);
    drop(stream.shutdown().await);
}

fn answer(head: &str, contents: &Contents) -> Vec<u8> {
    let mut words = head.split_whitespace();
    let (method, path) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
    let respond = |status: &str, headers: &str, length: usize, body: &[u8]| {
        let head = format!(
            "HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n"
        );
        [head.as_bytes(), body].concat()
    };
    let Some(path) = path.strip_prefix("/v2/") else { return respond("404 Not Found", "", 0, b"") };
    if path.is_empty() {
        return respond("200 OK", "Docker-Distribution-Api-Version: registry/2.0\r\n", 2, b"{}");
    }
    let found = contents.lock().unwrap_or_else(PoisonError::into_inner).get(path).cloned();
    let Some(content) = found else {
        let error =
            json!({"errors": [{"code": "MANIFEST_UNKNOWN", "message": "manifest unknown"}]});
        let error = error.to_string();
        let kind = "Content-Type: application/json\r\n";
        return respond("404 Not Found", kind, error.len(), error.as_bytes());
    };
    let headers =
        format!("Content-Type: {}\r\nDocker-Content-Digest: {}\r\n", content.kind, content.digest);
    let body: &[u8] = if method == "HEAD" { b"" } else { &content.bytes };
    respond("200 OK", &headers, content.bytes.len(), body)
}
