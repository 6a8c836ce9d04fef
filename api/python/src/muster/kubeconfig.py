"""Which controller is asked, and as whom: the kubeconfig that the controller writes, which kubectl reads as well."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional, Union
from urllib.parse import urlsplit

from muster._yaml import YamlError, parse
from muster.errors import ConfigError

AnyPath = Union[str, "os.PathLike[str]"]

_DEFAULT_HTTPS_PORT = 443
#: What somebody may have put there in place of a certificate or a token, and no framework may use.
_OTHER_CREDENTIALS = ("tokenFile", "username", "password", "exec", "auth-provider")


@dataclass(frozen=True)
class Target:
    """A controller, and who asks it."""

    #: ``host:port``, with brackets around an IPv6 address.
    address: str
    certificate_authority: bytes
    #: None: the token says who asks.
    client_certificate: Optional[bytes]
    client_key: Optional[bytes] = field(repr=False)
    namespace: str
    #: The name in the server's certificate, when it is not the host.
    server_name: Optional[str] = None
    #: Of a user (``muster token create --user``). It counts before a certificate.
    token: Optional[str] = field(default=None, repr=False)


def files(explicit: Optional[AnyPath], environ: Mapping[str, str]) -> list[Path]:
    """Where to look: the argument, ``MUSTER_CONFIG``, ``KUBECONFIG`` (a list), ``~/.muster/config``."""
    if explicit is not None:
        return [Path(explicit)]
    for variable in ("MUSTER_CONFIG", "KUBECONFIG"):
        named = [Path(part) for part in environ.get(variable, "").split(os.pathsep) if part]
        if named:
            return named
    return [Path.home() / ".muster" / "config"]


def load(explicit: Optional[AnyPath] = None, environ: Optional[Mapping[str, str]] = None) -> Target:
    """Reads the current context. ConfigError says which file, and what is wrong with it."""
    named = files(explicit, os.environ if environ is None else environ)
    # As kubectl: a list may name files that are not there, a single file must be.
    present = [path for path in named if path.exists()]
    if not present:
        raise ConfigError(
            f"there is no kubeconfig: {named[0]} does not exist; a controller writes it when it starts, "
            "or name a file with MUSTER_CONFIG"
        )
    merged: dict[str, Any] = {}
    for path in present:
        _merge(merged, _read(path), path.parent)
    try:
        return _target(merged)
    except _Wrong as wrong:
        where = os.pathsep.join(str(path) for path in present)
        raise ConfigError(f"{where}: {wrong}") from None


class _Wrong(Exception):
    """What is wrong with a kubeconfig, without its name."""


def _read(path: Path) -> dict[str, Any]:
    try:
        value = parse(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, YamlError) as error:
        raise ConfigError(f"{path}: {error}") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path}: is not a kubeconfig")
    return value


def _merge(into: dict[str, Any], config: dict[str, Any], directory: Path) -> None:
    """The first file wins where two differ. Paths in a file are relative to it."""
    if config.get("current-context"):
        into.setdefault("current-context", config["current-context"])
    for kind, singular in (("clusters", "cluster"), ("users", "user"), ("contexts", "context")):
        entries = config.get(kind) or []
        if not isinstance(entries, list):
            raise ConfigError(f"{directory}: {kind} is not a list")
        known = into.setdefault(kind, {})
        for entry in entries:
            if isinstance(entry, dict) and isinstance(entry.get("name"), str):
                known.setdefault(entry["name"], {**(entry.get(singular) or {}), "": directory})


def _target(config: dict[str, Any]) -> Target:
    context = _entry(config, "contexts", config.get("current-context"), "current-context")
    cluster = _entry(config, "clusters", context.get("cluster"), "the context's cluster")
    user = _entry(config, "users", context.get("user"), "the context's user")
    if cluster.get("insecure-skip-tls-verify") in ("true", True):
        raise _Wrong("insecure-skip-tls-verify: a framework does not talk to a controller that it cannot know")
    token = user.get("token") or None
    certified = bool(user.get("client-certificate-data") or user.get("client-certificate"))
    if not (certified or token):
        other = next((name for name in _OTHER_CREDENTIALS if name in user), None)
        hint = f", and {other} is not enough for a session" if other else ""
        raise _Wrong(f"the user has no client certificate and no token{hint}")
    return Target(
        address=_address(cluster.get("server")),
        certificate_authority=_pem(cluster, "certificate-authority"),
        client_certificate=_pem(user, "client-certificate") if certified else None,
        client_key=_pem(user, "client-key") if certified else None,
        namespace=context.get("namespace") or "default",
        server_name=cluster.get("tls-server-name"),
        token=token,
    )


def _entry(config: dict[str, Any], kind: str, name: Any, what: str) -> dict[str, Any]:
    if not name:
        raise _Wrong(f"{what} is not named")
    entry = config.get(kind, {}).get(name)
    if entry is None:
        raise _Wrong(f"{what} is {name!r}, which is not among the {kind}")
    found: dict[str, Any] = entry
    return found


def _address(server: Any) -> str:
    url = urlsplit(server if isinstance(server, str) else "")
    try:
        port = url.port or _DEFAULT_HTTPS_PORT
    except ValueError:
        port = 0
    if url.scheme != "https" or not url.hostname or not port or url.path not in ("", "/"):
        raise _Wrong(f"the server {server!r} is not https://host:port")
    host = f"[{url.hostname}]" if ":" in url.hostname else url.hostname
    return f"{host}:{port}"


def _pem(entry: dict[str, Any], name: str) -> bytes:
    """``<name>-data`` in base64, or the file that ``<name>`` names."""
    data = entry.get(f"{name}-data")
    if data:
        try:
            return base64.b64decode(data, validate=True)
        except (ValueError, TypeError):
            raise _Wrong(f"{name}-data is not base64") from None
    path = entry.get(name)
    if not path:
        raise _Wrong(f"there is no {name}-data")
    try:
        return Path(entry[""], path).read_bytes()
    except OSError as error:
        raise _Wrong(f"{name}: {error}") from error
