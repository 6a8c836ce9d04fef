"""A controller that does what a test says: one gRPC port with mutual TLS, and no mind of its own."""

from __future__ import annotations

import base64
import datetime
import ipaddress
import queue
from collections.abc import Iterator
from concurrent import futures
from pathlib import Path
from typing import Any, Optional

import grpc
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from muster._pb import framework as pb

#: A test that waits longer has failed.
PATIENCE = 30.0


class Pki:
    """A certificate authority, the server's pair and a client's, made as the controller makes them."""

    def __init__(self) -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "muster-ca")])
        self.ca = _pem(self._sign(self._name, self._key, ca=True))

    def pair(self, name: str, organisation: str) -> tuple[bytes, bytes]:
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name(
            [
                x509.NameAttribute(NameOID.ORGANIZATION_NAME, organisation),
                x509.NameAttribute(NameOID.COMMON_NAME, name),
            ]
        )
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        return _pem(self._sign(subject, key, ca=False)), private

    def _sign(self, subject: x509.Name, key: ec.EllipticCurvePrivateKey, ca: bool) -> x509.Certificate:
        now = datetime.datetime.now(datetime.timezone.utc)
        hosts = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(hours=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName(hosts), critical=False)
            .sign(self._key, hashes.SHA256())
        )


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def kubeconfig(server: str, pki: Pki, admin: tuple[bytes, bytes]) -> str:
    """Word for word what the controller writes."""

    def encoded(pem: bytes) -> str:
        return base64.b64encode(pem).decode()

    return f"""apiVersion: v1
kind: Config
clusters:
- name: muster
  cluster:
    server: {server}
    certificate-authority-data: {encoded(pki.ca)}
users:
- name: muster-admin
  user:
    client-certificate-data: {encoded(admin[0])}
    client-key-data: {encoded(admin[1])}
contexts:
- name: muster
  context:
    cluster: muster
    user: muster-admin
    namespace: default
current-context: muster
preferences: {{}}
"""


class FakeSession:
    """One session as the controller has it."""

    def __init__(self) -> None:
        self._calls: queue.Queue[Optional[pb.Call]] = queue.Queue()
        self._events: queue.Queue[Optional[pb.Event]] = queue.Queue()
        self._status: Optional[tuple[grpc.StatusCode, str]] = None

    def serve(self, calls: Iterator[pb.Call], context: grpc.ServicerContext) -> Iterator[pb.Event]:
        context.add_callback(lambda: self._events.put(None))
        reader = futures.ThreadPoolExecutor(1)
        reader.submit(self._read, calls)
        while True:
            event = self._events.get()
            if event is None:
                break
            yield event
        reader.shutdown(wait=False)
        if self._status is not None:
            context.abort(*self._status)

    def _read(self, calls: Iterator[pb.Call]) -> None:
        try:
            for call in calls:
                self._calls.put(call)
        except grpc.RpcError:
            pass
        finally:
            self._calls.put(None)

    def send(self, **event: Any) -> None:
        self._events.put(pb.Event(**event))

    def end(self, status: Optional[tuple[grpc.StatusCode, str]] = None) -> None:
        self._status = status
        self._events.put(None)

    def call(self) -> Optional[pb.Call]:
        """The next call; None: the framework has said its last."""
        return self._calls.get(timeout=PATIENCE)

    def expect(self, kind: str) -> Any:
        """The next call, which is of this kind."""
        call = self.call()
        assert call is not None, f"the session ended where {kind} was due"
        assert call.WhichOneof("call") == kind, call
        self.last_id = call.id
        return getattr(call, kind)

    def expect_end(self) -> None:
        call = self.call()
        assert call is None, call

    def subscribed(self, framework_id: str = "f-1", reregistered: bool = False, heartbeat_ms: int = 60_000) -> Any:
        """Waits for Subscribe and answers it."""
        subscribe = self.expect("subscribe")
        self.send(
            subscribed=pb.Subscribed(
                framework_id=framework_id,
                session_id="s",
                reregistered=reregistered,
                heartbeat_interval_ms=heartbeat_ms,
            )
        )
        return subscribe

    def answer(self, **answer: Any) -> None:
        """To the call that was expected last."""
        assert self.last_id
        self.send(answer=pb.Answer(id=self.last_id, **answer))


class FakeController:
    def __init__(self, pki: Pki, directory: Path) -> None:
        self.accepted: queue.Queue[FakeSession] = queue.Queue()
        self._open: list[FakeSession] = []
        self._server = grpc.server(
            futures.ThreadPoolExecutor(16),
            options=[("grpc.max_receive_message_length", 64 << 20), ("grpc.so_reuseport", 0)],
        )
        session = grpc.stream_stream_rpc_method_handler(
            self._session, request_deserializer=pb.Call.FromString, response_serializer=pb.Event.SerializeToString
        )
        service = grpc.method_handlers_generic_handler("muster.framework.v1.FrameworkService", {"Session": session})
        self._server.add_generic_rpc_handlers((service,))
        certificate, key = pki.pair("muster-controller", "muster")
        credentials = grpc.ssl_server_credentials(
            [(key, certificate)], root_certificates=pki.ca, require_client_auth=True
        )
        port = self._server.add_secure_port("127.0.0.1:0", credentials)
        self._server.start()
        self.kubeconfig = directory / "kubeconfig"
        self.kubeconfig.write_text(
            kubeconfig(f"https://127.0.0.1:{port}", pki, pki.pair("muster-admin", "muster:admins"))
        )

    def _session(self, calls: Iterator[pb.Call], context: grpc.ServicerContext) -> Iterator[pb.Event]:
        session = FakeSession()
        self._open.append(session)
        self.accepted.put(session)
        yield from session.serve(calls, context)

    def accept(self) -> FakeSession:
        return self.accepted.get(timeout=PATIENCE)

    def close(self) -> None:
        for session in self._open:
            session.end()
        self._server.stop(0).wait()
