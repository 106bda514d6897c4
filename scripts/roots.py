"""Root directories of other systems, and commands in copies of them; for scripts that try this checkout there.

debootstrap makes a root directory of each system once, which is then kept. Commands run in a copy of it, in namespaces
of their own, so that nothing stays mounted or running, however they end. Mirror, proxy, certificates and pip's settings
are those of this machine.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, NoReturn

CHECKOUT = Path(__file__).resolve().parents[1]
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "tod-runner"
DATA = Path(os.environ.get("TOD_SHARED_DATA") or CHECKOUT.parent / "shared" / "data")  # recordings, if there are any
INSIDE, RECORDINGS = "/root/tod-runner", "/root/shared/data"  # the clone; where its tests expect recordings
DEBOOTSTRAP_S = 1200.0
SHOWN_S = 30.0  # a long step shows its last line so often
TOOLS = ("debootstrap", "git", "ip", "pivot_root", "setpriv", "unshare")

# Of the settings of this machine, what a root needs to reach the same network.
PASSED = re.compile(
    r"(PIP|UV|npm_config)_\w+|SSL_CERT_(FILE|DIR)|NODE_EXTRA_CA_CERTS|\w+_CA_BUNDLE|\w+_proxy", re.IGNORECASE
)
FILES = ("/etc/resolv.conf", "/etc/pip.conf", "/usr/local/share/ca-certificates")
APT = re.compile(r"Acquire::(https?|Check-|Retries|ForceIPv)", re.IGNORECASE)

# A root directory, "net" for the network of this machine, recordings or nothing, and a command to run there. A mount of
# it becomes the root of the namespace, into which nsenter leads. The shell stays process 1, which waits for orphans.
ENTER = r"""
set -eu
root=$1 net=$2 data=$3
shift 3
mount --bind "$root" "$root/mnt"
root=$root/mnt
mount -t proc proc "$root/proc"
mount -t sysfs sysfs "$root/sys"
mount --rbind /dev "$root/dev"
mount -t tmpfs -o mode=1777 shm "$root/dev/shm"
if [ "$net" != net ]; then ip link set lo up; fi
if [ -n "$data" ]; then mount --bind -o ro "$data" "$root/root/shared/data"; fi
cd "$root"
pivot_root . .
umount --lazy .
chroot . "$@"
exit $?
"""


class Step(NamedTuple):
    """One thing to try.

    name     its column, and its log
    command  of the shell, in the clone
    limit_s  time limit, s
    net      whether it needs the network
    needs    steps without which it makes no sense
    """

    name: str
    command: str
    limit_s: float
    net: bool = False
    needs: tuple[str, ...] = ("setup",)


BARE = Step(
    "bare system",
    "apt-get update -q && apt-get install -y -q --no-install-recommends ca-certificates git make"
    " && update-ca-certificates",
    600,
    net=True,
    needs=(),
)


class Ended(NamedTuple):
    """A step that was tried; status None: it took longer than its limit."""

    status: int | None
    seconds: float
    log: Path

    @property
    def fine(self) -> bool:
        return self.status == 0

    def __str__(self) -> str:
        if self.status is None:
            return f"**failed**: ended after {self.seconds:.0f} s"
        return "ok" if self.fine else f"**failed**: status {self.status}"


class Root(NamedTuple):
    """A copy of a system's root directory, with a clone of the checkout.

    path  of the directory
    logs  directory of the logs of its steps
    """

    path: Path
    logs: Path

    def run(self, step: Step) -> Ended:
        """Run a step, and show that it goes on."""
        log, began = self.logs / f"{step.name.replace(' ', '_')}.log", time.monotonic()
        say(f"{self.logs.name}: {step.name}")
        with log.open("wb") as file:
            process = subprocess.Popen(
                self.entering(step.command, net=step.net),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C ends it below, and with it everything that it started
            )
            try:
                status = self._wait(process, began + step.limit_s, log)
            finally:
                process.kill()
                process.wait()
        ended = Ended(status, time.monotonic() - began, log)
        say(f"{self.logs.name}: {step.name}: {ended}, {ended.seconds:.0f} s{'' if ended.fine else f'; see {log}'}")
        return ended

    @staticmethod
    def _wait(process: subprocess.Popen[bytes], until: float, log: Path) -> int | None:
        while (left := until - time.monotonic()) > 0:
            try:
                return process.wait(min(SHOWN_S, left))
            except subprocess.TimeoutExpired:
                say(f"    {last_line(log)}")
        return None

    def entering(self, command: str, *, net: bool) -> list[str]:
        """The command that runs another one in the clone, in namespaces that end with it, and it with this process."""
        spaces = ["--mount", "--pid", "--fork", "--kill-child", *([] if net else ["--net"])]
        data = str(DATA) if DATA.is_dir() and Path(f"{self.path}{RECORDINGS}").is_dir() else ""
        given = {key: value for key, value in os.environ.items() if PASSED.fullmatch(key)}
        own = {
            "HOME": "/root",
            "LANG": "C.UTF-8",
            "DEBIAN_FRONTEND": "noninteractive",
            "PATH": os.defpath + ":/usr/sbin:/sbin",
        }
        variables = [f"{key}={value}" for key, value in (given | own).items()]
        words = ["env", "-i", *variables, "sh", "-c", f"[ ! -d {INSIDE} ] || cd {INSIDE}; {command}"]
        inside = [str(self.path), "net" if net else "", data, *words]
        return ["setpriv", "--pdeathsig", "KILL", "unshare", *spaces, "sh", "-c", ENTER, "sh", *inside]

    def output(self, command: str) -> str:
        done = subprocess.run(
            self.entering(command, net=False), capture_output=True, text=True, check=False, timeout=60
        )
        return done.stdout.strip()


def say(line: str) -> None:
    print(f"{datetime.now():%H:%M:%S} {line}", flush=True)


def last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").split("\n")
    return next((line.strip()[:150] for line in reversed(lines) if line.strip()), "...")


def fail(line: str) -> NoReturn:
    print(f"scripts/{Path(sys.argv[0]).name}: {line}", file=sys.stderr)
    sys.exit(2)


def made(suite: str, roots: Path) -> Path:
    """The root directory of a system as debootstrap makes it, made if there is none yet."""
    root, part = roots / suite, roots / f".{suite}.part"
    if root.is_dir():
        return root
    roots.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(part, ignore_errors=True)
    say(f"{suite}: debootstrap into {root}")
    # Every release of Debian is made as unstable (sid) is; debootstrap may be older than its name.
    words = ["debootstrap", "--variant=minbase", suite, str(part), mirror(), "sid"]
    command = ["setpriv", "--pdeathsig", "KILL", "unshare", "--mount", *words]
    try:
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=DEBOOTSTRAP_S, text=True, check=False
        )
        if done.returncode:
            fail(f"{suite}: debootstrap ended with {done.returncode}:\n{done.stdout[-2000:]}")
        part.rename(root)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return root


def mirror() -> str:
    """The mirror of Debian that this machine uses; "": none, and debootstrap takes its own."""
    if not shutil.which("apt-get"):
        return ""
    words = ["apt-get", "indextargets", "--format", "$(ORIGIN)|$(LABEL)|$(REPO_URI)"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return next((line.split("|")[2] for line in done.stdout.splitlines() if line.startswith("Debian|Debian|")), "")


@contextmanager
def prepared(suite: str, base: Path, logs: Path, *, keep: bool) -> Iterator[Root]:
    """A copy of a root directory with the settings of this machine and a clone of HEAD."""
    place = Path(tempfile.mkdtemp(prefix=f"tod-root-{suite}-", dir="/var/tmp"))
    root = Root(place / "root", logs)
    try:
        subprocess.run(["cp", "-a", "--reflink=auto", base, root.path], check=True)
        configure(root.path)
        Path(f"{root.path}{RECORDINGS}").mkdir(parents=True)
        subprocess.run(["git", "clone", "-q", CHECKOUT, f"{root.path}{INSIDE}"], check=True)
        yield root
    finally:
        if keep:
            say(f"{suite}: kept {root.path}")
        else:
            shutil.rmtree(place)


def configure(root: Path) -> None:
    """What the network of this machine requires."""
    named = [value for key, value in os.environ.items() if PASSED.fullmatch(key) and Path(value).is_file()]
    for name in (*FILES, *named):
        source, target = Path(name), Path(f"{root}{name}")
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, dirs_exist_ok=True)
        elif source.exists() and not target.is_file():
            shutil.copy(source, target)
    if shutil.which("apt-config"):
        dump = subprocess.run(["apt-config", "dump"], capture_output=True, text=True, check=True).stdout
        lines = [line for line in dump.splitlines() if APT.match(line)]
        (root / "etc/apt/apt.conf.d/00this-machine").write_text("\n".join([*lines, ""]))


def parser(description: str, systems: str) -> argparse.ArgumentParser:
    """The command line of a script that tries systems. systems: their names, for the help"""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("systems", nargs="*", metavar="SYSTEM", help=f"of {systems}; default: all")
    made.add_argument("--roots", type=Path, default=CACHE / "roots", help="directory of root directories by suite")
    made.add_argument("--keep", action="store_true", help="leave the copies in which the steps ran")
    return made


def begin(name: str) -> tuple[str, Path]:
    """The commit that a script tries, and a directory for its logs; ends the script where roots cannot be made.

    name  of the script
    """
    if os.geteuid():
        fail("must be started as root: it makes root directories and namespaces")
    if missing := [tool for tool in TOOLS if not shutil.which(tool)]:
        fail(f"{', '.join(missing)}: not installed")
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))  # so that copies are removed
    head = subprocess.run(
        ["git", "-C", CHECKOUT, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    )
    commit = head.stdout.strip()
    return commit, CACHE / name / f"{datetime.now():%Y-%m-%dT%H%M%S}-{commit}"


def row(*cells: str) -> str:
    """A row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"
