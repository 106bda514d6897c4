"""Containerfiles without a container engine: their instructions are executed in directories made by debootstrap.

Only the instructions and forms that `deploy/containers` uses are known; anything else is refused, since skipping it
would try another image than the one that an engine builds.

Each command runs in its own mount and PID namespace, so that nothing stays mounted or running on this machine.

What the network of this machine requires is not part of the files, and is passed in from outside:

    PIP_..., ..._proxy, SSL_CERT_FILE   passed on to RUN, which sees the files that they name read-only
    TOD_IMAGE_BINDS   further paths, separated by colons, that it sees: pip's configuration
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

BASES = {"docker.io/library/debian:12-slim": "bookworm"}  # suite of Debian by image
PASSED = re.compile(r"PIP_.*|SSL_CERT_FILE|(http|https|no)_proxy", re.IGNORECASE)
OUTSIDE = "/mnt"
DEVICES = ("full", "null", "random", "urandom", "zero")
COMMAND_S = 900.0  # installing takes a minute or two

# A root directory, what it sees, and a command that becomes PID 1 there.
ENTER = r"""
set -eu
root=$1 options=$2 binds=$3 devices=$4
shift 4
mount --bind "$root" "$root"
mount -t proc proc "$root/proc"
mount -t tmpfs -o mode=755 dev "$root/dev"
for name in $devices; do touch "$root/dev/$name"; mount --bind "/dev/$name" "$root/dev/$name"; done
ln -s /proc/self/fd "$root/dev/fd"
printf '%s\n' "$binds" | while IFS='|' read -r source target mode; do
  [ -n "$source" ] || continue
  mount --bind "$source" "$root$target"
  mount -o "remount,bind,$mode" "$root$target"
done
mount -o "remount,bind,$options" "$root"
exec chroot "$root" "$@"
"""


class ContainerfileError(Exception):
    """An instruction that is not understood."""


@dataclass(frozen=True, slots=True)
class Instruction:
    """One instruction: keyword, flags such as --from=build, the rest as written."""

    where: str
    keyword: str
    flags: Mapping[str, str]
    rest: str

    def refused(self, why: str) -> ContainerfileError:
        return ContainerfileError(f"{self.where}: {self.keyword} {self.rest}: {why}")

    def words(self) -> list[str]:
        """The exec form, a list in JSON."""
        try:
            words = json.loads(self.rest)
        except ValueError:
            words = None
        if not isinstance(words, list) or not words or not all(isinstance(word, str) for word in words):
            raise self.refused("must be a JSON list of words")
        return words


@dataclass(slots=True)
class Image:
    """A stage that was built: its root directory and how it is to be started."""

    root: Path
    env: dict[str, str] = field(
        default_factory=lambda: {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}
    )
    user: str = "root"
    workdir: str = "/"
    volumes: list[str] = field(default_factory=list)
    health: list[str] = field(default_factory=list)
    entrypoint: list[str] = field(default_factory=list)

    def ids(self) -> tuple[int, int]:
        """Numbers of user and group."""
        for line in (self.root / "etc/passwd").read_text().splitlines():
            name, _, uid, gid, *_ = line.split(":")
            if name == self.user:
                return int(uid), int(gid)
        raise ContainerfileError(f"USER {self.user}: no such user in the image")


@dataclass(frozen=True, slots=True)
class Bind:
    """A path of this machine that a command sees in its root directory."""

    source: Path
    target: str
    writable: bool = False


def read(path: Path) -> list[Instruction]:
    """The instructions of a Containerfile.

    raises  ContainerfileError
    """
    found, pending, first = [], "", 0
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if line.lstrip().startswith("#") or not (line.strip() or pending):
            continue
        first = first if pending else number
        pending += line.strip()
        if pending.endswith("\\"):
            pending = pending[:-1].rstrip() + " "
            continue
        found.append(_instruction(f"{path.name}:{first}", pending))
        pending = ""
    if pending:
        raise ContainerfileError(f"{path.name}:{first}: {pending}: continues on a line that is missing")
    return found


def _instruction(where: str, text: str) -> Instruction:
    keyword, _, rest = text.partition(" ")
    flags = {}
    while match := re.match(r"\s*--([a-z-]+)=(\S+)\s*", rest):
        flags[match[1]] = match[2]
        rest = rest[match.end() :]
    instruction = Instruction(where, keyword, flags, rest.strip())
    known = FLAGS.get(keyword)
    if known is None:
        raise instruction.refused(f"unknown instruction; expected one of {', '.join(FLAGS)}")
    if unknown := flags.keys() - set(known):
        raise instruction.refused(f"unknown flag --{', --'.join(sorted(unknown))}")
    return instruction


FLAGS = {  # known flags by known instruction
    "FROM": (),
    "COPY": ("from",),
    "RUN": (),
    "ENV": (),
    "USER": (),
    "WORKDIR": (),
    "VOLUME": (),
    "HEALTHCHECK": ("interval", "timeout", "start-period", "retries"),
    "ENTRYPOINT": (),
}


def build(containerfile: Path, context: Path, bases: Mapping[str, Path], directory: Path) -> Image:
    """Execute a Containerfile; returns its last stage.

    context    directory that COPY takes files from
    bases      root directory by suite of Debian
    directory  of this build, for the roots of its stages
    raises     ContainerfileError; CalledProcessError if a command fails
    """
    stages: dict[str, Image] = {}
    image: Image | None = None
    for instruction in read(containerfile):
        if instruction.keyword == "FROM":
            base, *name = re.split(r"\s+AS\s+", instruction.rest)
            if base not in BASES:
                raise instruction.refused(f"unknown image; expected one of {', '.join(BASES)}")
            root = directory / f"stage{len(stages)}"
            subprocess.run(["cp", "-a", "--reflink=auto", bases[BASES[base]], root], check=True, timeout=COMMAND_S)
            image = stages[name[0] if name else str(len(stages))] = Image(root)
        elif image is None:
            raise instruction.refused("must come after FROM")
        else:
            _execute(instruction, image, context, stages)
    if image is None:
        raise ContainerfileError(f"{containerfile.name}: has no FROM")
    return image


def _execute(instruction: Instruction, image: Image, context: Path, stages: Mapping[str, Image]) -> None:
    match instruction.keyword:
        case "COPY":
            _copy(instruction, image, context, stages)
        case "RUN":
            _run(instruction, image)
        case "ENV":
            image.env |= dict(word.split("=", 1) for word in shlex.split(instruction.rest))
        case "USER":
            image.user = instruction.rest
            image.ids()
        case "WORKDIR":
            image.workdir = instruction.rest
            (image.root / instruction.rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
        case "VOLUME":
            image.volumes = instruction.words()
        case "HEALTHCHECK":
            form, _, rest = instruction.rest.partition(" ")
            if form != "CMD":
                raise instruction.refused("must be CMD and a JSON list of words")
            image.health = Instruction(instruction.where, form, {}, rest).words()
        case "ENTRYPOINT":
            image.entrypoint = instruction.words()
        case other:
            raise instruction.refused(f"{other} is not implemented")


def _copy(instruction: Instruction, image: Image, context: Path, stages: Mapping[str, Image]) -> None:
    """As an engine copies: the content of a directory, files into a target that ends in a slash."""
    *sources, target = instruction.rest.split()
    origin = stages[instruction.flags["from"]].root if "from" in instruction.flags else context
    end = image.root / target.lstrip("/")
    for name in sources:
        source = origin / name.lstrip("/")
        if source.is_dir():
            ignore = shutil.ignore_patterns("__pycache__") if origin is context else None
            shutil.copytree(source, end, symlinks=True, ignore=ignore, dirs_exist_ok=True)
        elif target.endswith("/"):
            end.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, end)
        else:
            raise instruction.refused("a file must be copied into a directory, whose name ends in /")


def _run(instruction: Instruction, image: Image) -> None:
    passed = {key: value for key, value in os.environ.items() if PASSED.fullmatch(key)}
    # Files that they name, at a place where no package has its own.
    named = {key: value for key, value in passed.items() if value.startswith("/") and Path(value).exists()}
    given = filter(None, os.environ.get("TOD_IMAGE_BINDS", "").split(":"))
    binds = [Bind(Path(path), path) for path in ("/etc/resolv.conf", *given)]
    binds += [Bind(Path(path), OUTSIDE + path) for path in dict.fromkeys(named.values())]
    moved = {key: OUTSIDE + path for key, path in named.items()}
    environment = {"DEBIAN_FRONTEND": "noninteractive", **passed, **moved, **image.env}
    words = ["env", "-i", *(f"{key}={value}" for key, value in environment.items()), "sh", "-c", instruction.rest]
    command = entering(image.root, words, binds, read_only=False)
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=COMMAND_S)
    if done.returncode:
        raise instruction.refused(f"status {done.returncode}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")


def entering(root: Path, words: Sequence[str], binds: Sequence[Bind] = (), *, read_only: bool = True) -> list[str]:
    """A command that becomes PID 1 of namespaces of its own, in a root directory."""
    for bind in binds:
        _mount_point(root, bind)
    lines = "\n".join(f"{b.source}|{b.target}|{'rw' if b.writable else 'ro'}" for b in binds)
    inside = [str(root), "ro" if read_only else "rw", lines, " ".join(DEVICES)]
    return ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", ENTER, "sh", *inside, *words]


def _mount_point(root: Path, bind: Bind) -> None:
    target = root / bind.target.lstrip("/")
    if bind.source.is_dir():
        target.mkdir(parents=True, exist_ok=True)
    elif not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)  # a dangling link
        target.touch()


def starting(image: Image, words: Sequence[str]) -> list[str]:
    """A command as the image's user, with its environment and without any capability."""
    uid, gid = image.ids()
    as_user = ["--reuid", str(uid), "--regid", str(gid), "--clear-groups", "--no-new-privs"]
    without = ["--bounding-set=-all", "--inh-caps=-all"]
    variables = [f"{key}={value}" for key, value in image.env.items()]
    return ["setpriv", *as_user, *without, "env", "-i", "-C", image.workdir, *variables, *words]


def bootstrap(suite: str, directory: Path) -> Path:
    """A minimal Debian in a directory."""
    root = directory / suite
    command = ["unshare", "--mount", "debootstrap", "--variant=minbase", suite, root]
    subprocess.run(command, check=True, timeout=COMMAND_S, stdout=subprocess.DEVNULL)
    return root


def processes_in(root: Path) -> Iterator[int]:
    """PIDs of processes whose root directory lies in a directory."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if (process / "root").resolve().is_relative_to(root):
                yield int(process.name)
        except OSError:  # it has ended
            continue
