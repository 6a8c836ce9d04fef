//! Secrets are encrypted before they reach a disk, and so is everything of them: whole rows, with AES-256-GCM.
//!
//! A row's value becomes `sealed:v1:<key id>:<base64 of nonce and ciphertext>`. What the row is (resource, namespace,
//! name, uid) is bound to it as associated data: a row that was moved under another name does not open.
//!
//! The keys are in a file that only its owner may read: one key a line, 32 bytes as base64; empty lines and lines that
//! begin with `#` are passed over. The first key writes, all of them read. To rotate, put a new key in front and start
//! the controller: it writes older rows anew, and the old key can go. A key's id is made of the key, so a wrong key is
//! known as such before anything is opened.

use std::fmt;
use std::fs::{self, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use muster_failpoint::{Failpoint, Step, reach};
use ring::aead::{AES_256_GCM, Aad, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};
use ring::digest;
use ring::rand::{SecureRandom as _, SystemRandom};

use super::{Key, Resource};

/// What is sealed.
const SEALED: Resource = Resource::new("secrets");
const PREFIX: &str = "sealed:v1:";
const KEY_BYTES: usize = 32;

/// Why keys or sealed rows cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SealError {
    /// The file of the keys cannot be read or made.
    #[error("cannot use the encryption key file {}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// Others than its owner may read it.
    #[error("the encryption key file {} may be read by others; `chmod 600` it", path.display())]
    Open {
        /// Which.
        path: PathBuf,
    },
    /// There is no file, and there are Secrets that it would have to open.
    #[error(
        "the encryption key file {} is missing, and the store has Secrets that were sealed with it; bring it back, \
         or name it with --encryption-key",
        path.display()
    )]
    Missing {
        /// Where it should be.
        path: PathBuf,
    },
    /// A line is no key.
    #[error("line {line} of {} is no key: 32 bytes as base64 (`openssl rand -base64 32`)", path.display())]
    Malformed {
        /// Which file.
        path: PathBuf,
        /// From 1.
        line: usize,
    },
    /// There is no key in it.
    #[error("there is no key in {}", path.display())]
    Empty {
        /// Which file.
        path: PathBuf,
    },
    /// A row was sealed with a key that is not in the file.
    #[error("{row} was sealed with the key {id}, which is not in {}", path.display())]
    WrongKey {
        /// Which row.
        row: String,
        /// The id of its key.
        id: String,
        /// Which file was looked in.
        path: PathBuf,
    },
    /// A row is not what was sealed.
    #[error("{row} is damaged: it does not open with the key that sealed it")]
    Damaged {
        /// Which row.
        row: String,
    },
    /// The system gives no randomness.
    #[error("the system gives no random numbers")]
    Random,
}

struct Named {
    id: String,
    key: LessSafeKey,
}

/// The keys, the one that writes first.
pub struct Keyring {
    path: PathBuf,
    keys: Vec<Named>,
}

impl fmt::Debug for Keyring {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ids: Vec<&str> = self.keys.iter().map(|key| &*key.id).collect();
        f.debug_struct("Keyring").field("path", &self.path).field("ids", &ids).finish()
    }
}

/// A row that was opened.
#[derive(Debug)]
pub(super) struct Opened {
    pub(super) value: String,
    /// Not with the key that writes.
    pub(super) old: bool,
}

/// Whether rows of this resource are sealed.
pub(super) fn is_sealed(resource: &str) -> bool {
    resource == SEALED.as_str()
}

impl Keyring {
    /// Reads the keys; makes the file with one key when there is none and nothing needs it yet.
    ///
    /// # Errors
    /// When there are none that can be used.
    pub fn open(path: &Path, needed: bool) -> Result<Self, SealError> {
        let failed = |source| SealError::File { path: path.to_owned(), source };
        match fs::metadata(path) {
            Ok(metadata) if metadata.permissions().mode() & 0o077 != 0 => {
                return Err(SealError::Open { path: path.to_owned() });
            }
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                if needed {
                    return Err(SealError::Missing { path: path.to_owned() });
                }
                make(path)?;
            }
            Err(error) => return Err(failed(error)),
        }
        let text = fs::read_to_string(path).map_err(failed)?;
        let mut keys = Vec::new();
        for (i, line) in text.lines().map(str::trim).enumerate() {
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let bad = || SealError::Malformed { path: path.to_owned(), line: i + 1 };
            let bytes = STANDARD.decode(line).map_err(|_| bad())?;
            let key = UnboundKey::new(&AES_256_GCM, &bytes).map_err(|_| bad())?;
            keys.push(Named { id: id_of(&bytes), key: LessSafeKey::new(key) });
        }
        if keys.is_empty() {
            return Err(SealError::Empty { path: path.to_owned() });
        }
        Ok(Keyring { path: path.to_owned(), keys })
    }

    /// A value as it is written.
    pub(super) fn seal(&self, key: &Key, uid: &str, value: &[u8]) -> Result<String, SealError> {
        let first = &self.keys[0];
        let mut nonce = [0; NONCE_LEN];
        SystemRandom::new().fill(&mut nonce).map_err(|_| SealError::Random)?;
        let mut sealed = value.to_vec();
        let aad = identity(key.namespace().unwrap_or_default(), &key.name, uid);
        first
            .key
            .seal_in_place_append_tag(
                Nonce::assume_unique_for_key(nonce),
                Aad::from(aad),
                &mut sealed,
            )
            .map_err(|_| SealError::Random)?;
        let mut bytes = nonce.to_vec();
        bytes.append(&mut sealed);
        Ok(format!("{PREFIX}{}:{}", first.id, STANDARD.encode(bytes)))
    }

    /// A value as it was before.
    pub(super) fn unseal(
        &self,
        (namespace, name, uid): (&str, &str, &str),
        sealed: &str,
    ) -> Result<Opened, SealError> {
        let row = || format!("{SEALED}/{namespace}/{name}");
        let damaged = || SealError::Damaged { row: row() };
        let (id, text) =
            sealed.strip_prefix(PREFIX).and_then(|s| s.split_once(':')).ok_or_else(damaged)?;
        let place = self.keys.iter().position(|key| key.id == id);
        let place = place.ok_or_else(|| SealError::WrongKey {
            row: row(),
            id: id.to_owned(),
            path: self.path.clone(),
        })?;
        let mut bytes = STANDARD.decode(text).map_err(|_| damaged())?;
        let (nonce, sealed) = bytes.split_first_chunk_mut::<NONCE_LEN>().ok_or_else(damaged)?;
        let aad = Aad::from(identity(namespace, name, uid));
        let nonce = Nonce::assume_unique_for_key(*nonce);
        let plain =
            self.keys[place].key.open_in_place(nonce, aad, sealed).map_err(|_| damaged())?;
        let value = String::from_utf8(plain.to_vec()).map_err(|_| damaged())?;
        Ok(Opened { value, old: place > 0 })
    }
}

/// Lengths in front, so that no two objects have the same.
fn identity(namespace: &str, name: &str, uid: &str) -> Vec<u8> {
    let mut all = Vec::new();
    for part in [SEALED.as_str(), namespace, name, uid] {
        all.extend_from_slice(&(part.len() as u64).to_be_bytes());
        all.extend_from_slice(part.as_bytes());
    }
    all
}

fn id_of(key: &[u8]) -> String {
    let mut context = digest::Context::new(&digest::SHA256);
    context.update(b"muster key id");
    context.update(key);
    context.finish().as_ref()[..8].iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Whole and synced before anything is sealed with it.
fn make(path: &Path) -> Result<(), SealError> {
    let failed = |source| SealError::File { path: path.to_owned(), source };
    let mut key = [0; KEY_BYTES];
    SystemRandom::new().fill(&mut key).map_err(|_| SealError::Random)?;
    let text = format!(
        "# Keys of the Secrets in the store: the first one writes, all of them read. Without them the Secrets are lost.\n{}\n",
        STANDARD.encode(key)
    );
    let tmp = path.with_extension("new");
    let mut options = OpenOptions::new();
    reach(Failpoint::EncryptionKey, Step::Before);
    let file = options.write(true).create(true).truncate(true).mode(0o600).open(&tmp);
    let mut file = file.map_err(failed)?;
    reach(Failpoint::EncryptionKey, Step::Created);
    file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).map_err(failed)?;
    reach(Failpoint::EncryptionKey, Step::Written);
    fs::rename(&tmp, path).map_err(failed)?;
    let dir = path.parent().filter(|dir| !dir.as_os_str().is_empty());
    let dir = dir.unwrap_or_else(|| Path::new("."));
    fs::File::open(dir).and_then(|dir| dir.sync_all()).map_err(failed)?;
    reach(Failpoint::EncryptionKey, Step::After);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key() -> Key {
        Key::namespaced(SEALED, "default", "n")
    }

    #[test]
    fn what_was_sealed_opens_under_its_own_name_only() {
        let dir = tempfile::tempdir().unwrap();
        let ring = Keyring::open(&dir.path().join("keys"), false).unwrap();
        let sealed = ring.seal(&key(), "u", b"hunter2").unwrap();
        assert!(!sealed.contains("hunter2"), "{sealed}");
        assert_ne!(sealed, ring.seal(&key(), "u", b"hunter2").unwrap(), "nonces differ");
        let opened = ring.unseal(("default", "n", "u"), &sealed).unwrap();
        assert_eq!((opened.value.as_str(), opened.old), ("hunter2", false));
        for other in [("other", "n", "u"), ("default", "m", "u"), ("default", "n", "v")] {
            let error = ring.unseal(other, &sealed).unwrap_err();
            assert!(matches!(error, SealError::Damaged { .. }), "{error}");
        }
        let mut cut = sealed;
        cut.truncate(cut.len() - 4);
        assert!(ring.unseal(("default", "n", "u"), &cut).is_err());
    }

    #[test]
    fn the_first_key_writes_and_all_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("keys");
        let old = Keyring::open(&path, false).unwrap();
        let sealed = old.seal(&key(), "u", b"x").unwrap();
        let text = fs::read_to_string(&path).unwrap();
        let new = STANDARD.encode([7; KEY_BYTES]);
        fs::write(&path, format!("{new}\n{text}")).unwrap();
        let both = Keyring::open(&path, true).unwrap();
        assert!(both.unseal(("default", "n", "u"), &sealed).unwrap().old);
        let anew = both.seal(&key(), "u", b"x").unwrap();
        fs::write(&path, new).unwrap();
        let only = Keyring::open(&path, true).unwrap();
        assert!(!only.unseal(("default", "n", "u"), &anew).unwrap().old);
        let error = only.unseal(("default", "n", "u"), &sealed).unwrap_err();
        assert!(matches!(error, SealError::WrongKey { .. }), "{error}");
    }

    #[test]
    fn a_file_that_cannot_be_used_says_why() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("keys");
        let missing = Keyring::open(&path, true).unwrap_err();
        assert!(matches!(missing, SealError::Missing { .. }), "{missing}");
        assert!(!path.exists(), "nothing is made in its place");
        drop(Keyring::open(&path, false).unwrap());
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        fs::write(&path, "# nothing\n\nshort\n").unwrap();
        assert!(matches!(Keyring::open(&path, true), Err(SealError::Malformed { line: 3, .. })));
        fs::write(&path, "# nothing\n").unwrap();
        assert!(matches!(Keyring::open(&path, true), Err(SealError::Empty { .. })));
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(Keyring::open(&path, true), Err(SealError::Open { .. })));
    }
}
