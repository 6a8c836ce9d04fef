//! Values at rest: AES-256-GCM with a key of this agent, in a file that only it may read.
//!
//! The key is beside what it seals, so it protects copies of single files and a disk's remains, and not against who
//! can read the whole data directory. With the key gone the values are gone as well, and no more than that: the
//! controller sends them again.

use std::fmt;
use std::fs;
use std::io;
use std::path::Path;

use muster_api::id::TaskUid;
use muster_api::wire::agent::v1 as proto;
use muster_failpoint::Failpoint;
use prost::Message as _;
use ring::aead::{AES_256_GCM, Aad, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};
use ring::rand::{SecureRandom as _, SystemRandom};

use crate::durable::{self, FileError, Keep};

const KEY_FILE: &str = "config.key";
const KEY_BYTES: usize = 32;

/// The agent's key.
pub(crate) struct Vault(LessSafeKey);

impl fmt::Debug for Vault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Vault").finish_non_exhaustive()
    }
}

impl Vault {
    /// Reads the key, or makes one.
    pub(crate) fn open(data_dir: &Path) -> Result<Vault, FileError> {
        let path = data_dir.join(KEY_FILE);
        let broken = |what: &'static str| {
            let path = path.clone();
            move |_| FileError { action: what, path, source: io::Error::other("no key") }
        };
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let mut key = vec![0; KEY_BYTES];
                SystemRandom::new().fill(&mut key).map_err(broken("make"))?;
                durable::write(Failpoint::VaultKey, &path, &key, 0o600, Keep::PowerCut)?;
                key
            }
            Err(error) => return Err(FileError::at("read", &path)(error)),
        };
        let key = UnboundKey::new(&AES_256_GCM, &bytes).map_err(broken("use"))?;
        Ok(Vault(LessSafeKey::new(key)))
    }

    /// Values as they are written: nonce, then ciphertext, bound to the task.
    pub(crate) fn seal(&self, uid: &TaskUid, config: &proto::Config) -> io::Result<Vec<u8>> {
        let mut nonce = [0; NONCE_LEN];
        let failed = |_| io::Error::other("no random numbers");
        SystemRandom::new().fill(&mut nonce).map_err(failed)?;
        let mut sealed = config.encode_to_vec();
        let aad = Aad::from(uid.as_str());
        self.0
            .seal_in_place_append_tag(Nonce::assume_unique_for_key(nonce), aad, &mut sealed)
            .map_err(failed)?;
        let mut bytes = nonce.to_vec();
        bytes.append(&mut sealed);
        Ok(bytes)
    }

    /// None: it is not what this agent sealed for this task.
    pub(crate) fn unseal(&self, uid: &TaskUid, mut bytes: Vec<u8>) -> Option<proto::Config> {
        let (nonce, sealed) = bytes.split_first_chunk_mut::<NONCE_LEN>()?;
        let nonce = Nonce::assume_unique_for_key(*nonce);
        let plain = self.0.open_in_place(nonce, Aad::from(uid.as_str()), sealed).ok()?;
        proto::Config::decode(&*plain).ok()
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn another_life_of_the_agent_opens_what_this_one_sealed() {
        let dir = tempfile::tempdir().unwrap();
        let variable = proto::Variable { name: "A".to_owned(), value: "hunter2".to_owned() };
        let config = proto::Config { variables: vec![variable], ..Default::default() };
        let (uid, other) = (TaskUid::new("t"), TaskUid::new("u"));
        let sealed = Vault::open(dir.path()).unwrap().seal(&uid, &config).unwrap();
        assert!(!sealed.windows(7).any(|w| w == b"hunter2"));
        let mode = fs::metadata(dir.path().join(KEY_FILE)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        let again = Vault::open(dir.path()).unwrap();
        assert_eq!(again.unseal(&uid, sealed.clone()), Some(config));
        assert_eq!(again.unseal(&other, sealed), None);
        assert_eq!(again.unseal(&uid, vec![0; 3]), None);
    }
}
