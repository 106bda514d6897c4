"""What each verb loads: how many modules of the project, and which heavy third-party packages."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from runner.verbs import VERBS

pytestmark = pytest.mark.slow  # starts a process for each verb

HEAVY = ("aiohttp", "antlr4", "asyncio", "cv2", "gi", "hydra", "jsonschema", "matplotlib", "multiprocessing", "numba",
         "numpy", "omegaconf", "paho", "plotly", "rich", "scipy")  # fmt: skip
COMPOSING = {"antlr4", "hydra", "omegaconf", "jsonschema"}
CODE = """
import json, sys
from runner.__main__ import main
status = main(sys.argv[1:])
loaded = {name.partition(".")[0] for name in sys.modules}
print(json.dumps([status, sum(name.startswith("runner") for name in sys.modules), sorted(loaded)]), file=sys.stderr)
"""


def loaded(*words: str) -> tuple[int, set[str]]:
    """How many modules of the project a command loads, and which heavy packages."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, *words],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    status, own, every = json.loads(done.stderr.splitlines()[-1])
    assert status == 0, done.stderr
    return own, set(every).intersection(HEAVY)


RUNNING = {  # modules of the project and heavy packages; `validate` reads maps and queries GStreamer's registry
    "print": (68, COMPOSING),
    "replay": (75, COMPOSING),
    "validate": (152, COMPOSING | {"numpy", "gi", "asyncio"}),  # asyncio: by PyGObject from 3.50 on
}
HELP = {
    "vehicle": {"paho"},
    "operator": {"rich", "paho"},
    "latency": {"paho"},
    "map": {"numpy"},
}


@pytest.mark.parametrize("verb", RUNNING)
def test_what_a_verb_loads_when_it_runs(verb: str) -> None:
    most, heavy = RUNNING[verb]
    own, found = loaded(verb, "source=test")
    assert own <= most
    assert found <= heavy


@pytest.mark.parametrize("verb", ["", *VERBS])
def test_what_a_verb_loads_before_it_runs(verb: str) -> None:
    own, found = loaded(*filter(None, (verb, "--help")))
    assert own <= (113 if verb else 15)
    assert found <= HELP.get(verb, set())
