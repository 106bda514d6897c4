"""Executes the recipes of docs/deployment.md on machines, to test the document itself."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from machines import Machine, Watch

from rig import CHECKOUT, WAIT_S, process, until

DOCUMENT = CHECKOUT / "docs" / "deployment.md"
VEHICLE = "10.0.0.2"  # its address there, also where a recipe gives it another one later
TWO_MACHINES, SERVICE = "From two bare machines to driving", "A broker as a service"
FIREWALLS, SRT, WIREGUARD = "Firewalls", "SRT", "WireGuard"
TWO_MODEMS, TWO_UPLINKS = "Two modems", "Two uplinks"
# There is no systemd here: replacements for its services.
BROKER = "sudo install -d -o mosquitto /run/mosquitto; sudo mosquitto -d -c /etc/mosquitto/mosquitto.conf"
SERVICES = {"sudo systemctl restart mosquitto": BROKER}
SIDES = ("tod-runner operator ", "tod-runner vehicle ")
INSTALLS = "sudo apt-get install "  # has been done on this machine, which both others share
# Two small cameras of the paper's eight, from a test picture.
OTHERS = ("front_left", "front_right", "top_front", "top_left", "top_right", "top_rear")
SIZES = [f"{name}.{size}" for name in ("front_center", "rear_center") for size in ("width_px=480", "height_px=260")]
SHORT = [
    *(f"~cameras.{name}" for name in OTHERS),
    *(f"cameras.{size}" for size in SIZES),
    *("source=test", "fps_max=15", "modes=open_loop", "pqos=constant", "pqos.kbps=1000", "page.serve=false"),
]


class Line(NamedTuple):
    """A command line, and the machines that it is for: vehicle, operator or both."""

    where: str
    text: str


class File(NamedTuple):
    where: str
    path: str
    text: str


def _blocks(heading: str) -> list[str]:
    """The fenced blocks of a section, each with its language as the first line."""
    text = DOCUMENT.read_text()
    section = re.split(rf"^#+ {re.escape(heading)}\n", text, flags=re.MULTILINE)[1]
    section = re.split(r"^#+ ", re.sub(r"^(```.*?^```)", _hidden, section, flags=re.M | re.S), flags=re.M)[0]
    return [block.replace("\0", "#") for block in re.findall(r"^```(.*?)^```", section, flags=re.M | re.S)]


def _hidden(block: re.Match[str]) -> str:
    """A block whose comments do not look like headings."""
    return block[0].replace("#", "\0")


def lines(heading: str) -> list[Line]:
    found, where = [], ""
    for block in _blocks(heading):
        language, _, text = block.partition("\n")
        for line in text.splitlines() if language == "sh" else ():
            if line.startswith("# "):
                where = re.split(r"\W", line[2:])[0]
            else:
                found.append(Line(where, line))
    return found


def files(heading: str) -> list[File]:
    found = []
    for block in _blocks(heading):
        if named := re.search(r"^# ([/~]\S+) of the (\w+)\b", block, flags=re.M):
            found.append(File(named[2], named[1], block.partition("\n")[2]))
    return found


class Site:
    """The operator's machine, where the broker runs, and the vehicle; each with a home directory of its user."""

    def __init__(self, vehicle: Machine, operator: Machine, directory: Path) -> None:
        self.machines = {"vehicle": vehicle, "operator": operator}
        self.homes = {name: directory / name for name in self.machines}
        for home in self.homes.values():
            home.mkdir()
        self.output = self.homes["vehicle"] / "output.txt"  # of the vehicle's side
        ssh = directory / "ssh"  # rsync's way to the vehicle, whose address it is given first
        inside = " ".join(vehicle.inside(self.homes["vehicle"]))
        ssh.write_text(f'#!/bin/sh\ntest "$1" = {VEHICLE} && shift && exec {inside} sh -c "$*"\n')
        ssh.chmod(0o700)
        self._environment = f"RSYNC_RSH={ssh}"
        self.other: dict[str, str] = {}  # in files, in place of the document's text

    def shell(self, where: str, text: str) -> str:
        """Output of a command line on one machine."""
        text = SERVICES.get(text, text)
        command = [*self.machines[where].inside(self.homes[where]), self._environment, "bash", "-ec", text]
        done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
        assert done.returncode == 0, f"{where}: {text}\n{done.stdout}{done.stderr}"
        return done.stdout

    def write(self, file: File) -> None:
        text = file.text
        for written, other in self.other.items():
            text = text.replace(written, other)
        self.machines[file.where].run(f"install -m 600 /dev/stdin {file.path}", text)

    def follow(self, line: Line) -> None:
        for where in self.machines if line.where == "both" else (line.where,):
            output = self.shell(where, line.text)
            if key := re.search(r"/\w+(-\w)?\.key \| wg pubkey$", line.text):
                self.other[f"{where}s_PUBLIC_KEY{(key[1] or '').replace('-', '_')}".upper()] = output.strip()

    def prepare(self, heading: str) -> dict[str, list[str]]:
        """Follow a recipe until both sides can be started; returns the words of each, shortened."""
        given, starts = files(heading), {}
        install = [line for line in lines(SERVICE) if not line.text.startswith("tod-runner ")]
        for line in lines(heading):
            if line.text.startswith("sudo wg-quick"):
                for file in given:
                    self.write(file)
            if line.text.startswith(SIDES):
                _, verb, *words = shlex.split(line.text)
                starts[verb] = [*(word for word in words if not word.startswith("source=")), *SHORT]
            elif not line.text.startswith(INSTALLS):
                self.follow(line)
            if line.text.startswith("tod-runner keys ") and heading not in (TWO_MACHINES, SERVICE):
                for step in install:
                    self.follow(step)
        return starts

    @contextmanager
    def driving(self, words: Sequence[str]) -> Iterator[None]:
        """The vehicle's side, in its home."""
        home = self.homes["vehicle"]
        before = self.machines["vehicle"].inside(home)
        with (
            self.output.open("w") as output,
            process("vehicle", *words, before=before, stdout=output.fileno()),
        ):
            yield


@contextmanager
def watched(site: Site, heading: str, *words: str) -> Iterator[Watch]:
    """A drive by a recipe, once pictures of both cameras and answers have come. words: further ones of both sides"""
    starts = site.prepare(heading)
    watch = Watch(site.machines["operator"], site.homes["operator"], [*starts["operator"], *words])
    try:
        with site.driving([*starts["vehicle"], *words]):
            until(lambda: len(watch.times) == 3 and min(map(len, watch.times.values())) > 20, every_s=0.1)
            yield watch
    finally:
        watch.end()
