"""Refuses to serve or connect beyond this machine without keys."""

from __future__ import annotations

from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

from runner.core.roles import VIEWERS, Role
from runner.errors import ArgumentError, UserError
from runner.security.keyring import HOLDER, MEDIA_SECRET, PASSPHRASE, PEOPLE, TOKEN, Keyring
from runner.settings import Control, Setup


def keyring_of(setup: Setup, *needed: str) -> Keyring | None:
    """The keys that a side's configuration names; None: it names none and needs none.

    needed  files that this side needs in addition to those that every holder has
    raises  UserError if keys are incomplete, or missing although video or control leave this machine; for an address of
            media.host that they do not work with; for a foreign broker that does not guard its topics
    """
    check_guarded(setup.control)
    if setup.keys is not None:
        _check_server_name(setup)
        return _with_broker(setup, Keyring.of(Path(setup.keys), *needed))
    reached = {"media.host": setup.media.host, "control.host": setup.control.host}
    exposed = [
        f"{key} {host}" for key, host in reached.items() if not is_loopback(host) and not _is_private(host, setup)
    ]
    if exposed and not setup.insecure:
        found = "is not a loopback address" if len(exposed) == 1 else "are not loopback addresses"
        rule = f"{found}: give keys=DIR, created by `tod-runner keys`, or insecure=true"
        raise ArgumentError("keys", None, f"{' and '.join(exposed)} {rule}")
    return _with_broker(setup, None)


def check_guarded(control: Control) -> None:
    """Which operator a message is from is known by its topic alone.

    raises  UserError for a foreign broker beyond this machine that is not said to guard its topics
    """
    if control.foreign and not control.foreign.topics_guarded and not is_loopback(control.host):
        rule = (
            f"the broker at {control.host} must let nobody write to the topics of another: give it the rules that "
            "`tod-runner keys output=DIR rules=true` prints, and then control.topics_guarded=true"
        )
        raise ArgumentError("control.topics_guarded", "false", rule)


def _with_broker(setup: Setup, keyring: Keyring | None) -> Keyring | None:
    """The keys; raises ConfigError for files that do not work for a foreign broker."""
    if setup.control.foreign:
        from runner.security.foreign import ForeignFiles

        ForeignFiles.of(setup.control.foreign, keyring).check()
    return keyring


def may_listen(setup: Setup, address: str) -> bool:
    """Whether the RTSP server may listen at an address of an uplink, too: under the conditions of `keyring_of`.

    Where media.host is a loopback address, nothing is to reach it from elsewhere.
    """
    is_safe = setup.keys is not None or setup.insecure or is_loopback(address) or _is_private(address, setup)
    return is_safe and not is_loopback(setup.media.host)


def _check_server_name(setup: Setup) -> None:
    """GLib's TLS client states the host as server name (RFC 6066, section 3), and GnuTLS refuses an IPv6 address there.

    raises  UserError
    """
    if ":" in setup.media.host and any(camera.graph.transport == "rtsp" for camera in setup.vehicle.cameras.values()):
        rule = "an IPv6 address does not work for RTSP with keys: give a name that stands for it, as in /etc/hosts"
        raise ArgumentError("media.host", setup.media.host, rule)


class KeysOfAll(NamedTuple):
    """Key directories of the broker and of both sides."""

    broker: Path
    vehicle: Path
    controller: Path

    @staticmethod
    def of(setup: Setup) -> KeysOfAll | None:
        """For a process that runs both sides: `keys` names the directory with everyone's keys; None: it is not set.

        raises  UserError, also if keys are missing although video or control leave this machine
        """
        if setup.control.foreign or setup.control.embedded:
            word = ("control.foreign", "true") if setup.control.foreign else ("control.broker", "embedded")
            raise ArgumentError(*word, "this verb starts a broker of its own")
        if setup.keys is None:
            keyring_of(setup)
            return None
        directory = Path(setup.keys)
        holders = {path.parent: Keyring(path.parent).holder for path in sorted(directory.glob(f"*/{HOLDER}"))}
        found = {
            role: next((path for path, holder in holders.items() if holder.role is role), None)
            for role in (Role.BROKER, Role.CONTROLLER)
        }
        named = (setup.vehicle.name, Role.VEHICLE)
        own = next((path for path, holder in holders.items() if (holder.name, holder.role) == named), None)
        broker, controller = found.values()
        if not (broker and controller and own):
            required = {"broker=localhost": broker, f"vehicle={setup.vehicle.name}": own, "controller=NAME": controller}
            words = " ".join(word for word, path in required.items() if path is None)
            raise UserError("keys", "", setup.keys, f"lacks keys: tod-runner keys output={setup.keys} {words}")
        return KeysOfAll(broker, own, controller)


def vehicle_keyring(setup: Setup) -> Keyring | None:
    """The vehicle's keys; raises UserError as `keyring_of`, and for those of another holder."""
    keyring = keyring_of(setup, PEOPLE, PASSPHRASE)
    if keyring and (keyring.holder.name, keyring.holder.role) != (setup.vehicle.name, Role.VEHICLE):
        raise _wrong_holder(keyring, f"vehicle {setup.vehicle.name}")
    return keyring


def viewer_keyring(setup: Setup) -> Keyring | None:
    """The keys of a role that may see a vehicle's pictures; raises UserError as `keyring_of`, and for other roles."""
    keyring = keyring_of(setup, MEDIA_SECRET)
    if keyring and keyring.holder.role not in VIEWERS:
        raise _wrong_holder(keyring, "a controller, a supervisor or a watcher")
    return keyring


def page_keyring(setup: Setup) -> Keyring | None:
    """The keys with which the page is served to other machines; None: it is served on loopback.

    raises  UserError if it would be served elsewhere without keys, or others may log in where nobody does
    """
    if is_loopback(setup.page.host):
        if setup.page.people is not None:
            rule = f"must be null while page.host is {setup.page.host}: there nobody logs in"
            raise ArgumentError("page.people", setup.page.people, rule)
        return None
    if setup.keys is None:
        rule = (
            "is not a loopback address: give keys=DIR, created by `tod-runner keys`; browsers play video by HTTPS only"
        )
        raise ArgumentError("page.host", setup.page.host, rule)
    keyring = Keyring.of(Path(setup.keys), TOKEN)
    if not keyring.holder.hosts:
        rule = "does not name the addresses of the page: tod-runner keys output=DIR"
        who = f"{keyring.holder.role}={keyring.holder.name}"
        raise UserError("keys", "", setup.keys, f"{rule} {who} host={setup.page.host}")
    return keyring


def _wrong_holder(keyring: Keyring, expected: str) -> UserError:
    found = f"{keyring.holder.role} {keyring.holder.name}"
    return UserError("keys", "", str(keyring.directory), f"must be those of {expected}, not of {found}")


def _is_private(host: str, setup: Setup) -> bool:
    """Whether an address is on the network that needs no keys by the configuration; a name never is."""
    try:
        return setup.private is not None and ip_address(host) in setup.private
    except ValueError:
        return False


def is_loopback(host: str) -> bool:
    """Whether an address or name is a loopback address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
