"""Encryption and authentication of the streams: RTSP over TLS with SRTP, SRT with a passphrase.

Peers are checked here and not by GLib, which does not support revocation lists. A vehicle is identified by its name,
not by the address at which it is reached.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from secrets import token_urlsafe

from gi.repository import Gio, GLib, Gst, GstRtsp, GstRtspServer

from runner.core.roles import Role
from runner.errors import RunError, UserError
from runner.gst.pipeline import encrypt
from runner.gst.rtspsrc import is_rtsp_client
from runner.gst.srtp import provide_rtcp_key
from runner.security.identities import Identities, Presented
from runner.security.keyring import MEDIA_SECRET, Holder, Keyring, Watched, rtsp_password, srt_passphrase

USER = "user"  # field of a token of the server library: whose password it stands for
VIEWER = "viewer"  # role in the server library that may open and watch a camera


class PeerCheck:
    """Decides which certificates are accepted: issued by the authority, within their validity, and not revoked.

    on_report  called with the problem of a new revocation list
    """

    def __init__(self, keyring: Keyring, on_report: Callable[[str], None]) -> None:
        self._authority = Gio.TlsCertificate.new_from_file(str(keyring.authority))
        self._identities = Identities(keyring, on_report)

    def verify(self, certificate: Gio.TlsCertificate | None) -> Holder | str:
        """The holder of the certificate that a new connection presents, or why it is not accepted."""
        if certificate is None:
            return "it has no certificate"
        if errors := certificate.verify(None, self._authority):
            reasons = [nick for nick in errors.value_nicks if nick != "no-flags"]
            return f"its certificate is not accepted: {', '.join(reasons)}"
        return self.holder(certificate)

    def holder(self, certificate: Gio.TlsCertificate) -> Holder | str:
        """The holder of an open connection's certificate, or why it must end; expiry is not checked again."""
        return self._identities.holder(Presented.of(bytes(certificate.props.certificate)))


class _Certificate(Gio.TlsInteraction):  # type: ignore[misc]
    """Presents a client's certificate when the server asks for it."""

    def __init__(self, certificate: Gio.TlsCertificate) -> None:
        super().__init__()
        self._certificate = certificate

    def do_request_certificate(
        self, connection: Gio.TlsConnection, _flags: object, _cancellable: object
    ) -> Gio.TlsInteractionResult:
        connection.set_certificate(self._certificate)
        return Gio.TlsInteractionResult.HANDLED


def own_certificate(keyring: Keyring) -> Gio.TlsCertificate:
    """raises RunError if certificate and key do not match, or others may read the key"""
    try:
        return Gio.TlsCertificate.new_from_files(str(keyring.certificate), str(keyring.key))
    except UserError as error:
        raise RunError(str(error)) from None
    except GLib.Error as error:
        raise RunError(f"{keyring.directory}: {error.message}") from None


def _signing_nothing(own: Gio.TlsCertificate) -> Gio.TlsDatabase:
    """A database of this certificate alone, without those that it was issued by.

    It has signed no other, so that GLib accepts none by itself, and the signal decides about all of them.
    """
    file = os.memfd_create("own.crt")
    try:
        os.write(file, own.props.certificate_pem.encode())
        return Gio.TlsFileDatabase.new(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


class StreamLogin:
    """Mutual authentication of an operator's receiver and the vehicle.

    vehicle  its name
    """

    def __init__(self, keyring: Keyring, vehicle: str, on_report: Callable[[str], None]) -> None:
        self._keyring, self._vehicle, self._expected = keyring, vehicle, Holder(vehicle, Role.VEHICLE)
        self._check = PeerCheck(keyring, on_report)
        self._accepted: Gio.TlsCertificate | None = None  # the last one
        self._on_report = on_report
        self._media_secret: Watched[bytes] | None = None  # of SRT
        self._used = b""  # the secret of the last pipeline

    def prepare(self, pipeline: Gst.Bin, client: Gst.Element) -> str | None:
        """Set up a new pipeline and its client with the current keys.

        returns  why it cannot connect, for example while new files are being copied; None if it can
        raises   RunError for a graph whose client cannot be encrypted
        """
        self._accepted = None  # until the next handshake
        is_rtsp = client.find_property("tls-interaction")
        try:
            if is_rtsp:
                self._prepare_rtsp(client)
            else:
                self._media_secret = self._media_secret or self._keyring.watched(MEDIA_SECRET, self._on_report)
                self._used = self._media_secret.get()
                encrypt(pipeline, srt_passphrase(self._used, self._vehicle))
        except (RunError, UserError, GLib.Error) as error:
            if not is_rtsp:
                encrypt(pipeline, token_urlsafe())  # that nobody knows: without one, anybody could connect
            return str(error)
        return None

    def _prepare_rtsp(self, client: Gst.Element) -> None:
        keyring = self._keyring
        own = own_certificate(keyring)
        client.set_property("tls-interaction", _Certificate(own))
        client.set_property("tls-database", _signing_nothing(own))
        client.set_property("user-id", keyring.holder.name)
        client.set_property("user-pw", rtsp_password(keyring.secret, self._vehicle))
        client.connect("accept-certificate", self._accept)
        if is_rtsp_client(client):  # not the sender of voice: it sends RTCP with the key of its stream
            provide_rtcp_key(client)

    def _accept(self, _client: Gst.Element, _connection: object, certificate: Gio.TlsCertificate, _: object) -> bool:
        self._accepted = certificate if self._check.verify(certificate) == self._expected else None
        return self._accepted is not None

    def withdrawn(self) -> str | None:
        """Why the stream must end: a revoked certificate of the vehicle, or a new secret of SRT; None: it need not."""
        if self._accepted is not None and isinstance(self._check.holder(self._accepted), str):
            return "the vehicle's keys are no longer accepted"
        return "there are new keys" if self._media_secret and self._media_secret.get() != self._used else None


class ViewerCheck:
    """Decides who may watch: holders of an accepted certificate, with the password of the user that it names.

    on_report   called with the problem of new files
    on_refused  called with IP address and port of a client whose certificate is not accepted, and why; from any thread
    """

    def __init__(
        self, keyring: Keyring, on_report: Callable[[str], None], on_refused: Callable[[tuple[str, int], str], None]
    ) -> None:
        self._check = PeerCheck(keyring, on_report)
        self._people = keyring.watched_people(on_report)
        self._on_refused = on_refused
        self._known: Mapping[str, str] = {}  # by user, the password given to the library
        self._own, self._used = keyring.watched_certificate(on_report), b""
        self._keyring = keyring
        self.auth = GstRtspServer.RTSPAuth()
        self.auth.set_tls_authentication_mode(Gio.TlsAuthenticationMode.REQUIRED)
        self.auth.set_supported_methods(GstRtsp.RTSPAuthMethod.DIGEST)
        self.auth.connect("accept-certificate", self._accept)
        self.permissions = GstRtspServer.RTSPPermissions()
        for name in (GstRtspServer.RTSP_PERM_MEDIA_FACTORY_ACCESS, GstRtspServer.RTSP_PERM_MEDIA_FACTORY_CONSTRUCT):
            self.permissions.add_permission_for_role(VIEWER, name, True)
        self.refresh()

    def refresh(self) -> None:
        """Give the library the current certificate and users.

        raises  RunError if certificate and key do not match
        """
        people = {name: person.rtsp for name, person in self._people.get().items() if person.rtsp}
        for name in self._known.keys() - people.keys():
            self.auth.remove_digest(name)
        for name, password in people.items():
            if self._known.get(name) != password:
                token = GstRtspServer.RTSPToken()
                token.set_string(GstRtspServer.RTSP_TOKEN_MEDIA_FACTORY_ROLE, VIEWER)
                token.set_string(USER, name)
                self.auth.add_digest(name, password, token)
        self._known = people
        if self._used != (own := self._own.get()):  # last: while it is being copied, the others are up to date
            self.auth.set_tls_certificate(own_certificate(self._keyring))
            self._used = own

    def viewer(self, certificate: Gio.TlsCertificate | None) -> str | None:
        """The holder of a client's certificate; None if it may no longer watch."""
        holder = self._check.holder(certificate) if certificate else None
        return holder.name if isinstance(holder, Holder) and holder.name in self._known else None

    def role(self, name: str) -> Role | None:
        """The role of a viewer; None: it may no longer watch."""
        person = self._people.get().get(name)
        return person.role if person else None

    def withdrawn(self, certificate: Gio.TlsCertificate | None) -> str | None:
        """Why a client's connection must end, to be asked once its handshake is over; None: it need not."""
        return None if self.viewer(certificate) else "its keys are no longer accepted"

    def refusal(self, certificate: Gio.TlsCertificate | None, token: GstRtspServer.RTSPToken) -> str | None:
        """Why a request is refused, by the client's certificate and the password that the token stands for.

        The library accepts the password of any user with any certificate.
        """
        if why := self.withdrawn(certificate):
            return why
        name, user = self.viewer(certificate), token.get_string(USER) if token else None
        return None if name == user else f"certificate belongs to {name}, password to {user}"

    def _accept(self, _auth: object, connection: Gio.TlsConnection, certificate: Gio.TlsCertificate, _: object) -> bool:
        holder = self._check.verify(certificate)
        if isinstance(holder, Holder):
            if holder.name in self._known:
                return True
            holder = f"{holder.name} may not watch"
        address = connection.props.base_io_stream.get_remote_address()
        self._on_refused((address.get_address().to_string(), address.get_port()), holder)
        return False
