"""The files with which mosquitto serves only known vehicles and operators."""

from __future__ import annotations

PORT = 8883  # IANA: secure-mqtt

# %u is the user name: operators cannot use another id in a topic, and vehicles publish only for themselves. The vehicle
# checks what an operator's role allows.
ACL = """\
pattern write tod/+/request/%u
pattern write tod/+/reception/%u
pattern read tod/+/reply/%u
pattern read tod/+/clock/%u
pattern read tod/+/state
pattern read tod/+/telemetry
pattern read tod/+/configuration
pattern read tod/+/advice
pattern read tod/+/steering
pattern write tod/%u/state
pattern write tod/%u/telemetry
pattern write tod/%u/configuration
pattern write tod/%u/advice
pattern write tod/%u/steering
pattern write tod/%u/reply/+
pattern write tod/%u/clock/+
pattern read tod/%u/request/+
pattern read tod/%u/reception/+
"""


def broker_settings(directory: str, host: str = "", port: int = PORT) -> str:
    """mosquitto.conf: TLS 1.3 with certificates on both sides, and passwords; all other clients are refused.

    directory  of the broker's files
    host       address to listen on; "": all
    """
    return "\n".join(
        (
            "per_listener_settings false",
            "allow_anonymous false",
            f"password_file {directory}/passwords",
            f"acl_file {directory}/access",
            "persistence false",
            "set_tcp_nodelay true",
            "max_packet_size 1100000",
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
