"""The files with which mosquitto serves only known vehicles and operators."""

from __future__ import annotations

from collections.abc import Iterable

from runner.core.roles import VIEWERS, Role
from runner.settings import PREFIX

PASSWORDS, ACCESS = "passwords", "access"  # files
PORT = 8883  # IANA: secure-mqtt

# Below PREFIX/VEHICLE/; + stands for any name.
VEHICLE_WRITES = ("state", "telemetry", "configuration", "advice", "steering", "reply/+", "clock/+")
VEHICLE_READS = ("request/+", "reception/+", "state", "telemetry", "configuration")  # the last three: its own name
SENDER_READS = ("state", "telemetry")  # of any vehicle: a request must state the vehicle's time
VIEWER_READS = (*SENDER_READS, "configuration", "advice", "steering")


def access_list(holders: Iterable[tuple[str, Role]]) -> str:
    """Who may use which topic, for mosquitto: everyone only under the own name, and vehicles only their own topics.

    The vehicle checks what the role of a sender allows it to request.

    holders  name and role of each
    """
    return "".join(f"user {name}\n{_topics(PREFIX, name, role)}\n" for name, role in holders if role is not Role.BROKER)


def foreign_rules(prefix: str, holders: Iterable[tuple[str, Role]]) -> str:
    """The same for a broker that is not set up by the broker's files: in words, and in mosquitto's form (`acl_file`).

    prefix  what topics begin with there
    """
    listed = (
        f"# {name}, a {role}, {_in_words(prefix, name, role)}\nuser {name}\n{_topics(prefix, name, role)}"
        for name, role in holders
        if role is not Role.BROKER
    )
    return "\n".join((RULES.format(prefix=prefix), *listed))


RULES = """\
# Rules for a broker that `tod-runner keys` does not set up: in words, and as a file for mosquitto's acl_file.
#
# Everybody has a user name, which the broker proves by a password or a certificate. Below {prefix}/, all that is not
# allowed here is refused, to everybody. In topics, + is any name. If the broker knows somebody by another user name,
# change it after `user`, and in no topic. The vehicle takes the sender of a request from the end of its topic: nobody
# else may write there. The broker also keeps retained messages, sends last wills, and takes messages of 1.1 MB.
"""


def _in_words(prefix: str, name: str, role: Role) -> str:
    if role is Role.VEHICLE:
        return f"alone writes what it publishes, and reads what is sent to it, all below {prefix}/{name}/:"
    if role in VIEWERS:
        return (
            f"writes requests and reports that end in its name, and reads what vehicles publish and answer to {name}:"
        )
    return f"writes requests that end in its name, and reads the state of vehicles and answers to {name}:"


def _topics(prefix: str, name: str, role: Role) -> str:
    writes, reads = permitted(prefix, name if role is Role.VEHICLE else "+", name, role)
    lines = [*(f"topic write {topic}" for topic in writes), *(f"topic read {topic}" for topic in reads)]
    return "".join(f"{line}\n" for line in lines)


def permitted(prefix: str, vehicle: str, name: str, role: Role) -> tuple[list[str], list[str]]:
    """The topics of a vehicle that a holder may write and read; + is any vehicle."""
    writes: tuple[str, ...] = (f"request/{name}",)
    reads: tuple[str, ...] = (*SENDER_READS, f"reply/{name}")
    if role is Role.VEHICLE:
        writes, reads = VEHICLE_WRITES, VEHICLE_READS
    elif role in VIEWERS:
        writes, reads = (*writes, f"reception/{name}"), (*VIEWER_READS, f"reply/{name}", f"clock/{name}")
    return [f"{prefix}/{vehicle}/{topic}" for topic in writes], [f"{prefix}/{vehicle}/{topic}" for topic in reads]


def broker_settings(directory: str, host: str = "", port: int = PORT, *, listed: bool = True) -> str:
    """mosquitto.conf: TLS 1.3 with certificates on both sides, and passwords; all other clients are refused.

    directory  of the broker's files
    host       address to listen on; "": all
    listed     whether there is a revocation list
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
            *([f"crlfile {directory}/crl.pem"] if listed else []),
            "require_certificate true",
            "tls_version tlsv1.3",
            "",
        )
    )
