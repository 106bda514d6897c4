"""usage: tod-runner keys output=DIR [vehicle=NAME] [controller=NAME] [watcher=NAME] [predictor=NAME] [positioner=NAME]
                              [broker=HOST] [host=HOST[,HOST...]] [rotate=NAME] [revoke=NAME]

Creates the keys that vehicles, operators and the broker need to communicate over a network: a certificate authority in
DIR/authority, the broker's files in DIR/broker, and DIR/NAME for everyone else. Copy each directory unchanged to its
machine; DIR/authority stays where it is. Existing keys are kept, so names can be added at any time.

  vehicle     its `name` in the configuration     host  addresses or DNS names of that vehicle, or of an operator whose
  controller  an operator who may drive                 page is served to other machines
  watcher     an operator who may only watch      broker  address or DNS name of the machine with the MQTT broker
  predictor   sends predicted bitrates
  positioner  sends positions and steering angles

rotate=NAME replaces keys and passwords, revoke=NAME withdraws them. Both take effect on a machine once its changed
directory has been copied there; the last line of the output lists these directories. A certificate is valid for a year.

  tod-runner keys output=keys vehicle=tum_q7 host=10.0.0.2 controller=alice broker=10.0.0.1
  tod-runner keys output=keys watcher=bob
  tod-runner keys output=keys revoke=bob
  tod-runner keys output=keys                      list what was issued
"""

from __future__ import annotations

from datetime import datetime

from runner.core.roles import PEOPLE, Role
from runner.errors import ArgumentError
from runner.security.authority import Authority, Issued, Wanted
from runner.verbs import Arguments

ROLES = (Role.VEHICLE, *PEOPLE)


def run(arguments: Arguments) -> int:
    output = arguments.given_path("output", "the directory for all keys")
    values = arguments.values
    hosts = tuple(filter(None, values.get("host", "").split(",")))
    named = [role for role in ROLES if role in values]
    if hosts and not named:
        raise ArgumentError("host", values["host"], "must come with the name of a vehicle or operator")
    wanted = [Wanted(values[role], role, _hosts_of(role, named, hosts)) for role in named]
    if "broker" in values:
        wanted.append(Wanted("broker", Role.BROKER, (values["broker"],)))
    for each in wanted:  # everything is checked before the first file is written
        each.check()
    authority = Authority(output)
    with authority.opened():
        authority.check(wanted, *((action, values.get(action)) for action in ("rotate", "revoke")))
        changed = [each.name for each in wanted if authority.issue(*each)]
        for action in (authority.rotate, authority.revoke):
            if name := values.get(action.__name__):
                action(name)
                changed.append(name)
        for issued in authority.holders():
            print(_described(issued, authority.now()))
        to_copy = sorted(each.name for each in authority.holders() if not each.revoked)
    if changed:
        print(f"copy to their machines: {', '.join(f'{output}/{name}' for name in to_copy)}")
    return 0


def _hosts_of(role: Role, named: list[Role], hosts: tuple[str, ...]) -> tuple[str, ...]:
    """Hosts belong to the vehicle if one is named, otherwise to the operator."""
    return hosts if role is Role.VEHICLE or Role.VEHICLE not in named else ()


def _described(issued: Issued, now: datetime) -> str:
    if issued.revoked:
        state = f"revoked {issued.revoked:%Y-%m-%d}"
    elif issued.until <= now:
        state = f"expired {issued.until:%Y-%m-%d}, rotate={issued.name} renews it"
    else:
        state = f"valid until {issued.until:%Y-%m-%d}"
    return f"{issued.role:11}{issued.name:20}{state}{'  ' if issued.hosts else ''}{', '.join(issued.hosts)}"
