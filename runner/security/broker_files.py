"""The files with which mosquitto serves only known vehicles and operators."""

from __future__ import annotations

from collections.abc import Iterable

from runner.core.roles import VIEWERS, Role

PASSWORDS, ACCESS = "passwords", "access"  # files
PORT = 8883  # IANA: secure-mqtt

# Below tod/VEHICLE/; + stands for any name.
VEHICLE_WRITES = ("state", "telemetry", "configuration", "advice", "steering", "reply/+", "clock/+")
VEHICLE_READS = ("request/+", "reception/+", "state", "telemetry", "configuration")  # the last three: its own name
SENDER_READS = ("state", "telemetry")  # of any vehicle: a request must state the vehicle's time
VIEWER_READS = (*SENDER_READS, "configuration", "advice", "steering")


def access_list(holders: Iterable[tuple[str, Role]]) -> str:
    """Who may use which topic, for mosquitto: everyone only under the own name, and vehicles only their own topics.

    The vehicle checks what the role of a sender allows it to request.

    holders  name and role of each
    """
    return "".join(f"user {name}\n{_topics(name, role)}\n" for name, role in holders if role is not Role.BROKER)


def _topics(name: str, role: Role) -> str:
    if role is Role.VEHICLE:
        return _lines("write", name, *VEHICLE_WRITES) + _lines("read", name, *VEHICLE_READS)
    if role in VIEWERS:
        writes = _lines("write", "+", f"request/{name}", f"reception/{name}")
        return writes + _lines("read", "+", *VIEWER_READS, f"reply/{name}", f"clock/{name}")
    return _lines("write", "+", f"request/{name}") + _lines("read", "+", *SENDER_READS, f"reply/{name}")


def _lines(may: str, vehicle: str, *topics: str) -> str:
    return "".join(f"topic {may} tod/{vehicle}/{topic}\n" for topic in topics)


def broker_settings(directory: str, host: str = "", port: int = PORT) -> str:
    """mosquitto.conf: TLS 1.3 with certificates on both sides, and passwords; all other clients are refused.

    directory  of the broker's files
    host       address to listen on; "": all
    """
    return "\n".join(
        (
            "per_listener_settings false",
            "allow_anonymous false",
            f"password_file {directory}/{PASSWORDS}",
            f"acl_file {directory}/{ACCESS}",
            "persistence false",
            "persistent_client_expiration 1d",  # of a session that a client leaves behind; neither side leaves one
            "set_tcp_nodelay true",
            "max_packet_size 1100000",  # the longest message that both sides accept (mqtt/messages.py), and its header
            f"listener {port} {host}".rstrip(),
            f"cafile {directory}/ca.crt",
            f"certfile {directory}/own.crt",
            f"keyfile {directory}/own.key",
            f"crlfile {directory}/crl.pem",
            "require_certificate true",
            "tls_version tlsv1.3",
            "",
        )
    )
