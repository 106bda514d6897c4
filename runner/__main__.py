"""Command line: `tod-runner VERB [NAME=VALUE ...]`, a verb, then Hydra overrides and verb arguments."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib import import_module

from runner.errors import ArgumentError, RunError, UserError, reason
from runner.system import signals

NEW_OBJECTS = 20_000  # until they are searched for garbage: those of a start stay, and the search takes a tenth of it

# All other modules are imported once signals are handled: an interrupted import would print a traceback.

USAGE = """usage: tod-runner VERB [OVERRIDE ...] [ARGUMENT=VALUE ...]

{first}

further verbs:
{further}

An OVERRIDE is Hydra's: vehicle=delivery_robot, modes=paper, cameras.front_left.weight=2.
conf=DIR (or the environment variable TOD_CONF) names a directory of your own; its files shadow the packaged ones.
~/.config/tod-runner/site.yaml (or TOD_SITE) states what belongs to this machine, below overrides.

  tod-runner demo                                    drive the paper's vehicle on this machine
  tod-runner demo camera=/dev/video0                 drive with your webcam; doctor cameras lists yours
  tod-runner print total_kbps=3000                   what would run, and why
  tod-runner validate conf=my_vehicles               check your YAML, for example in CI
  tod-runner VERB --help                             one verb, with examples"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.

    argv     None: the process's own; a process ended by a signal then does not return from here
    returns  exit status: 0 fine, 1 a run failed, 2 the user's input is wrong, 129 SIGHUP, 130 Ctrl-C,
             143 SIGTERM
    """
    _open_standard_streams()
    if argv is None:
        gc.set_threshold(NEW_OBJECTS)
    with signals.handled():
        status = _status(list(sys.argv[1:] if argv is None else argv))
        _flush_or_drop()
        if argv is None and signals.received():
            os._exit(status)  # a normal exit would wait for library threads that may still run Python code
    return status


def _open_standard_streams() -> None:
    """Open /dev/null in place of closed standard streams (`>&-`), whose numbers the next files would get."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def _flush_or_drop() -> None:
    """Drop output that cannot be written: the interpreter would fail again on its final flush, with status 120."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _complain(what: object) -> None:
    with suppress(OSError):  # the status says it, too
        print(what, file=sys.stderr)


def _status(words: list[str]) -> int:  # noqa: PLR0911
    try:
        with signals.interruptible():
            return _run(words)
    except UserError as error:
        _complain(error)
        return 2
    except RunError as error:
        _complain(error)
        return 1
    except ImportError as error:
        from runner.verbs import import_problem

        if (problem := import_problem(error)) is None:
            raise
        _complain(problem)
        return 1
    except KeyboardInterrupt:
        return 128 + (signals.received() or signal.SIGINT)
    except BrokenPipeError:  # the reader of our output has closed it
        return 0
    except OSError as error:  # a full disk, a file without read permission
        where = f"{error.filename}: " if error.filename else ""
        _complain(f"{where}{reason(error)}")
        return 1


def _usage() -> str:
    from runner.verbs import FIRST_DAY, VERBS

    def table(verbs: Iterable[str]) -> str:
        return "\n".join(f"  {verb:11}{VERBS[verb].summary}" for verb in verbs)

    return USAGE.format(first=table(FIRST_DAY), further=table(verb for verb in VERBS if verb not in FIRST_DAY))


def _run(words: list[str]) -> int:
    from runner.system.files import directory_problem
    from runner.verbs import VERBS, Arguments, unknown_flag

    if not words or words[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0 if words else 2
    if words[0] == "--version":
        from importlib.metadata import version

        print(f"tod-runner {version('tod-runner')}")
        return 0
    name, *rest = words
    if name.startswith("-"):
        raise unknown_flag(name)
    if name not in VERBS:
        from runner.errors import suggest

        raise ArgumentError("", name, f"unknown verb{suggest(name, VERBS, len(VERBS))}")
    verb = VERBS[name]
    module = import_module(verb.module)
    if any(word in ("-h", "--help") for word in rest):
        print((module.__doc__ or "").strip())
        return 0
    if name == "model" and rest[:1] == ["compare"]:
        return int(module.compare(rest[1:]))
    if name == "completion" and rest[:1] == ["words"] and len(rest) == 3:
        return int(module.words(*rest[1:]))
    arguments = Arguments.parse(name, rest)
    if arguments.conf is not None and (why := directory_problem(arguments.conf)):
        raise ArgumentError("conf", str(arguments.conf), why)
    status: int = module.run(arguments)
    with suppress(BrokenPipeError):
        sys.stdout.flush()
    return status


if __name__ == "__main__":
    sys.exit(main())
