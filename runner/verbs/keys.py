"""usage: tod-runner keys output=DIR [vehicle=NAME] [controller=NAME] [supervisor=NAME] [watcher=NAME]
                              [predictor=NAME] [positioner=NAME] [broker=HOST] [host=HOST[,HOST...]]
                              [rotate=NAME] [revoke=NAME]
                              [ca=FILE] [signed=FILE[,FILE...]] [crl=FILE] [rules=true] [prefix=TOPIC]
       tod-runner keys people=FILE [watcher=NAME] [controller=NAME] [rotate=NAME] [revoke=NAME]

Creates the keys that vehicles, operators and the broker need to communicate over a network: a certificate authority in
DIR/authority, the broker's files in DIR/broker, and DIR/NAME for everyone else. Copy each directory unchanged to its
machine; DIR/authority stays where it is. Existing keys are kept, so names can be added at any time.

  vehicle     its `name` in the configuration     host  addresses or DNS names of that vehicle, or of an operator whose
  controller  an operator who may drive                 page is served to other machines
  supervisor  one who may also take control       broker  address or DNS name of the machine with the MQTT broker
  watcher     an operator who may only watch
  predictor   sends predicted bitrates
  positioner  sends positions and steering angles

rotate=NAME replaces keys and passwords, revoke=NAME withdraws them. Both take effect on a machine once its changed
directory has been copied there; the last line of the output lists these directories. A certificate is valid for a year.

With another authority, such as a company's, ca=FILE names its certificates (PEM). DIR/requests then has a request for
each certificate, NAME.csr, for the authority to sign. signed=FILE[,FILE...] takes in what it has signed, crl=FILE its
revocation list, if it has one.

rules=true prints the rules that a broker needs which these keys do not set up, in words and in mosquitto's form;
prefix=acme/tod is what topics begin with there, as control.prefix of both sides.

people=FILE is for the page of one operator (page.people), and needs no keys: it draws a token for each person who may
log in there. A watcher only looks, a controller may take control of the page. Each line of FILE is NAME ROLE TOKEN.

  tod-runner keys output=keys vehicle=tum_q7 host=10.0.0.2 controller=alice broker=10.0.0.1
  tod-runner keys output=keys watcher=bob
  tod-runner keys output=keys revoke=bob
  tod-runner keys output=keys                      list what was issued
  tod-runner keys output=keys rules=true
  tod-runner keys people=page.people watcher=carol
"""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path

from runner.core.roles import PEOPLE, VIEWERS, Role
from runner.errors import ArgumentError
from runner.security.authority import Authority, Issued, Wanted
from runner.security.broker_files import foreign_rules
from runner.security.company import CompanyAuthority, is_of_company
from runner.settings import PREFIX
from runner.verbs import Arguments

ROLES = (Role.VEHICLE, *PEOPLE)
PREFIX_FORM = re.compile(r"[A-Za-z0-9._-]+(/[A-Za-z0-9._-]+)*")  # as in schemas/config.schema.json


def run(arguments: Arguments) -> int:
    if file := arguments.path("people"):
        return _change_people(file, arguments)
    output = arguments.given_path("output", "the directory for all keys")
    values = arguments.values
    wanted = _wanted(arguments)
    authority = _authority(output, arguments)
    with authority.opened():
        if arguments.choice("rules") == "true":
            print(foreign_rules(_prefix(arguments), _named(authority)), end="")
            return 0
        authority.check(wanted, *((action, values.get(action)) for action in ("rotate", "revoke")))
        changed = _change(authority, arguments, wanted)
        for issued in authority.holders():
            print(_described(issued, authority.now()))
        to_copy = sorted(each.name for each in authority.holders() if not each.revoked)
        asked = _asked(authority)
    if changed and to_copy:
        print(f"copy to their machines: {', '.join(f'{output}/{name}' for name in to_copy)}")
    if asked:
        print(f"to be signed: {', '.join(map(str, asked))}; then give signed=FILE[,FILE...]")
    return 0


def _change_people(file: Path, arguments: Arguments) -> int:
    """Those who may log in at a page."""
    from runner.security.page_people import change_people

    values = arguments.values
    actions = {action: values.get(action) for action in ("rotate", "revoke")}
    if others := values.keys() - {"people", *VIEWERS, *actions}:
        raise ArgumentError("people", str(file), f"must come without {', '.join(sorted(others))}: for output=DIR")
    people = change_people(file, {values[role]: role for role in VIEWERS if role in values}, **actions)
    for name, person in people.items():
        print(f"{person.role:11}{name}")
    print(f"tokens: in {file}; each is for one person")
    return 0


def _authority(output: Path, arguments: Arguments) -> Authority:
    bundle = arguments.path("ca")
    if bundle and (output / "authority" / "authority.key").exists():
        raise ArgumentError("ca", str(bundle), f"{output} has an authority of its own: choose another output")
    if bundle or is_of_company(output):
        return CompanyAuthority(output, bundle=bundle)
    for argument in ("signed", "crl"):
        if argument in arguments.values:
            rule = "is for keys of another authority: give ca=FILE first, its certificates"
            raise ArgumentError(argument, arguments.values[argument], rule)
    return Authority(output)


def _wanted(arguments: Arguments) -> list[Wanted]:
    """The keys that are asked for, checked before the first file is written."""
    values = arguments.values
    hosts = tuple(filter(None, values.get("host", "").split(",")))
    named = [role for role in ROLES if role in values]
    if hosts and not named:
        raise ArgumentError("host", values["host"], "must come with the name of a vehicle or operator")
    wanted = [Wanted(values[role], role, _hosts_of(role, named, hosts)) for role in named]
    if "broker" in values:
        wanted.append(Wanted("broker", Role.BROKER, (values["broker"],)))
    for each in wanted:
        each.check()
    return wanted


def _change(authority: Authority, arguments: Arguments, wanted: list[Wanted]) -> list[str]:
    """Whose keys have changed, or were asked for."""
    values, changed = arguments.values, list[str]()
    if isinstance(authority, CompanyAuthority):
        authority.prepare()
        if signed := values.get("signed"):
            changed += authority.take([Path(each) for each in signed.split(",")])
        if listed := arguments.path("crl"):
            authority.take_list(listed)
            changed.append(str(listed))
    changed += [each.name for each in wanted if authority.issue(*each)]
    for action in (authority.rotate, authority.revoke):
        if name := values.get(action.__name__):
            action(name)
            changed.append(name)
    return changed


def _named(authority: Authority) -> list[tuple[str, Role]]:
    """Everybody who has keys, or has asked for them."""
    names = {each.name: each.role for each in authority.holders() if not each.revoked}
    waiting = authority.waiting() if isinstance(authority, CompanyAuthority) else {}
    return list({**names, **{name: each.role for name, each in waiting.items()}}.items())


def _asked(authority: Authority) -> list[Path]:
    """Requests that wait for the other authority."""
    return [*map(authority.request, authority.waiting())] if isinstance(authority, CompanyAuthority) else []


def _prefix(arguments: Arguments) -> str:
    if others := arguments.values.keys() - {"output", "rules", "prefix"}:
        raise ArgumentError("rules", "true", f"must come without {', '.join(sorted(others))}: it changes nothing")
    prefix = arguments.values.get("prefix", PREFIX)
    if not PREFIX_FORM.fullmatch(prefix):
        raise ArgumentError("prefix", prefix, "must be letters, digits, ., _ and - between slashes")
    return prefix


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
