"""Runs `ip` of iproute2."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from runner.errors import RunError

COMMAND_S = 10.0  # how long a command may take
ALTERNATIVE = "or choose link=relay"


def find(program: str) -> str:
    """Path of a program of iproute2, which Debian installs in a directory that is only in root's PATH."""
    path = shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if path is None:
        raise RunError(f"link=netns needs {program}; on Debian: apt-get install iproute2, {ALTERNATIVE}")
    return path


def run(*command: str, given: str | None = None) -> str:
    """Standard output of a command. raises RunError with its error output if it fails

    given  its standard input
    """
    done = _done(command, given)
    if done.returncode:
        message = " ".join(done.stderr.split()) or f"status {done.returncode}"
        raise RunError(f"link=netns: {Path(command[0]).name} {' '.join(command[1:])}: {message}; {ALTERNATIVE[3:]}")
    return done.stdout


def batch(ip: Sequence[str], *lines: str) -> None:
    """Run several commands of ip, without the word `ip`, in one process, up to the first that fails. raises RunError"""
    run(*ip, "-batch", "-", given="\n".join(lines))


def succeeds(*command: str) -> bool:
    return _done(command).returncode == 0


def _done(command: Sequence[str], given: str | None = None) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=COMMAND_S, input=given or ""
        )
    except subprocess.TimeoutExpired:
        raise RunError(f"link=netns: {' '.join(command)}: has not ended within {COMMAND_S:g} s") from None
