"""The command line: verbs, help, exit statuses, no GStreamer unless needed, silence on a closed pipe."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers import Command, process

from runner.__main__ import main
from runner.verbs import VERBS
from runner.verbs.doctor import gstreamer_fits

PAPER = ("modes=paper", "source=test")
EVENT = '{"t": 0, "event": "bitrate_predicted", "kbps": 3000}\n'


def test_the_version(tod: Command) -> None:
    assert tod("--version") == (0, f"tod-runner {version('tod-runner')}\n", "")


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["help"], []])
def test_the_usage_names_every_verb(tod: Command, words: list[str]) -> None:
    status, out, err = tod(*words)
    assert (status, err) == (0 if words else 2, "")
    for name, verb in VERBS.items():
        assert f"  {name:11}{verb.summary}" in out.splitlines()


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_shows_examples(tod: Command, verb: str) -> None:
    status, out, err = tod(verb, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: tod-runner {verb}")
    assert f"  tod-runner {verb}" in out


@pytest.mark.parametrize(
    "words, expected",
    [
        (["prnt"], "command line: prnt: unknown verb, did you mean print?"),
        (["fly"], f"command line: fly: unknown verb; expected one of {', '.join(VERBS)}"),
        (["print", "--total", "3"], "command line: --total: flags are not supported; write NAME=VALUE, or --help"),
        (["print", "total_kbps"], "command line: total_kbps: must be NAME=VALUE"),
        (["replay", "conf=/nowhere"], "command line: conf: /nowhere: no such directory"),
        (["replay", "input="], "command line: input: '': must not be empty"),  # from an unset variable of the shell
        (["vehicle", "log="], "command line: log: '': must not be empty"),
        (
            ["vehicle", "log=a", "drives=b"],
            "command line: drives: 'b': names a directory for each drive, so log= must not be given",
        ),
        (["report", "drive", "output="], "command line: output: '': must not be empty"),
        (["validate", "conf="], "command line: conf: '': must not be empty"),
        (["model", "camera=", "output=models"], "command line: camera: '': must not be empty"),
        (["keys", "output=keys", "revoke="], "command line: revoke: '': must not be empty"),
    ],
)
def test_invalid_commands(tod: Command, words: list[str], expected: str) -> None:
    assert tod(*words) == (2, "", f"{expected}\n")


@pytest.mark.parametrize(
    "words, expected",
    [
        (
            ["print", "duration_s=3"],
            "duration_s: is an argument of simulate, tune, vehicle, operator, latency, ros, demo, record; print has ",
        ),
        (["print", "input=a.jsonl"], "input: is an argument of replay; print has total_kbps, format, conf"),
        (["print", "vehcle=mine"], "vehcle: unknown name, did you mean vehicle?"),
        (["print", "totl_kbps=3"], "totl_kbps: unknown name, did you mean total_kbps?"),
        (["print", "~experment"], "experment: unknown name, did you mean experiment?"),
        (["model", "metrc=psnr"], "metrc: unknown name, did you mean metric?"),
        (
            ["print", "vehicle=mine"],
            "vehicle: mine: no such file in conf/vehicle/; expected one of delivery_robot, one_camera, tum_q7; ",
        ),
    ],
)
def test_unknown_names_and_choices_get_a_suggestion(tod: Command, words: list[str], expected: str) -> None:
    status, out, err = tod(*words)
    assert (status, out) == (2, "")
    assert err.startswith(f"command line: {expected}")


def test_the_conf_of_the_environment_must_exist_too(tod: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOD_CONF", "/nowhere")
    assert tod("print") == (2, "", "command line: conf: /nowhere: no such directory\n")


@pytest.mark.parametrize("word", ["vehicle=caf\udce9", "conf=/caf\udce9"])
def test_a_word_that_is_not_utf_8_is_refused(tod: Command, word: str) -> None:
    shown = word.replace("\udce9", "\\udce9")
    assert tod("print", word) == (2, "", f"command line: {shown}: must be UTF-8\n")


def test_a_conf_of_the_environment_that_is_not_utf_8_is_refused(tod: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOD_CONF", "/caf\udce9")
    assert tod("print") == (2, "", "environment: TOD_CONF: /caf\\udce9: must be UTF-8\n")


# --- no GStreamer -----------------------------------------------------------------------------------------------------


@pytest.fixture
def without_gstreamer(tmp_path: Path) -> dict[str, str]:
    """An environment in which PyGObject cannot be imported."""
    (tmp_path / "gi").mkdir()
    (tmp_path / "gi" / "__init__.py").write_text("raise ImportError('there is no gi here')\n")
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


@pytest.mark.slow
def test_print_replay_and_validate_need_no_gstreamer(without_gstreamer: dict[str, str]) -> None:
    result = process("print", "source=test", "format=json", env=without_gstreamer)
    assert (result.status, result.err) == (0, "")
    assert len(json.loads(result.out)["cameras"]) == 8
    result = process("replay", *PAPER, stdin=EVENT, env=without_gstreamer)
    assert (result.status, result.err) == (0, "")
    one = ("vehicle=delivery_robot", "modes=paper", "graph=h264_rtsp", "source=test")
    result = process("validate", *one, env=without_gstreamer)
    assert (result.status, result.err) == (0, "")
    (note,) = result.out.splitlines()[1:]
    assert note.startswith("nothing was checked against the GStreamer registry: Python module gi: there is no gi here")


@pytest.mark.parametrize("verb", ["print", "replay"])
def test_print_and_replay_never_import_gstreamer(verb: str) -> None:
    program = (
        "import sys; from runner.__main__ import main; "
        f"main([{verb!r}, 'modes=paper', 'source=test']); sys.exit('gi' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", program], input=b"", capture_output=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "gi, expected",
    [
        (
            "raise ImportError('there is no gi here')",
            "Python module gi: there is no gi here; apt-get install python3-gi",
        ),
        pytest.param(
            "raise AttributeError('half a gi')",
            "Python module gi: half a gi; apt-get install python3-gi",
            marks=pytest.mark.soak,
        ),
        (
            "def require_version(name, version): raise ValueError(f'Namespace {name} not available')",
            "typelib GstRtspServer: Namespace GstRtspServer not available; apt-get install gir1.2-gst-rtsp-server-1.0",
        ),
    ],
)
def test_doctor_and_validate_report_which_part_of_gstreamer_does_not_load(
    without_gstreamer: dict[str, str], tmp_path: Path, gi: str, expected: str
) -> None:
    (tmp_path / "gi" / "__init__.py").write_text(f"{gi}\n")
    result = process("doctor", "vehicle", "source=test", "page.serve=false", env=without_gstreamer)
    assert (result.status, result.err) == (1, "")
    assert any(line.startswith(f"MISSING {expected}") for line in result.out.splitlines()), result.out
    result = process("validate", env=without_gstreamer)
    assert (result.status, result.err) == (0, "")
    assert "nothing was checked against the GStreamer registry: " in result.out


@pytest.mark.parametrize(
    "words, modules",
    [
        (["vehicle", "source=test"], ["paho", "rich"]),
        (["vehicle"], ["paho", "rich", "numba"]),
        (["operator", "page.serve=false"], ["paho", "rich"]),
        (
            ["model", "metric=vmaf", "workers=dask"],
            ["numba", "cv2", "matplotlib", "rich", "imageio_ffmpeg", "distributed"],
        ),
        (["ros", "keys=/none"], ["paho", "rich", "cryptography"]),
        (["print"], []),
        (["export"], ["foxglove"]),
        ([], ["paho", "rich", "aiohttp", "plotly", "numba"]),
    ],
)
def test_doctor_checks_what_a_verb_needs(tod: Command, words: list[str], modules: list[str]) -> None:
    result = tod("doctor", *words)
    assert result.err == ""
    named = [line.split("Python module ")[1].partition(":")[0] for line in result.out.splitlines() if "module" in line]
    assert named == modules


@pytest.mark.parametrize(
    "words, expected", [(["vehcle"], "unknown verb, did you mean vehicle?"), (["a", "b"], "one verb")]
)
def test_doctor_accepts_a_verb(tod: Command, words: list[str], expected: str) -> None:
    result = tod("doctor", *words)
    assert (result.status, result.out) == (2, "") and expected in result.err


def test_doctor_names_a_gstreamer_without_times_of_capture() -> None:
    assert gstreamer_fits("1.22.0") == (True, "GStreamer 1.22.0")
    assert gstreamer_fits("1.18.4") == (
        False,
        "GStreamer 1.18.4: too old; times of capture, and so latencies, need 1.22 or later, see docs/install.md",
    )


@pytest.mark.parametrize(
    "error, expected",
    [
        (
            ImportError("libfreetype.so.6: cannot open", name="matplotlib.ft2font"),
            "the Python module matplotlib does not load: libfreetype.so.6: cannot open; "
            "reinstall the extra model, see docs/install.md",
        ),
        (ImportError("needs NumPy 2"), "a Python module does not load: needs NumPy 2"),
        (
            ModuleNotFoundError("No module", name="paho.mqtt"),
            "the Python module paho.mqtt is not installed: install the extra live, see docs/install.md",
        ),
    ],
)
def test_a_library_that_does_not_load_is_named(
    tod: Command, monkeypatch: pytest.MonkeyPatch, error: ImportError, expected: str
) -> None:
    def run(_arguments: object) -> int:
        raise error

    monkeypatch.setattr("runner.verbs.print.run", run)
    assert tod("print") == (1, "", f"{expected}\n")


# --- closed pipes -----------------------------------------------------------------------------------------------------


def test_a_closed_standard_output_ends_silently() -> None:
    replay = subprocess.Popen(
        [sys.executable, "-m", "runner", "replay", *PAPER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert replay.stdout and replay.stdin
    replay.stdin.write(EVENT.encode())
    replay.stdin.flush()
    replay.stdout.readline()
    replay.stdout.close()
    replay.stdout = None
    _, err = replay.communicate(EVENT.encode() * 3, timeout=20)
    assert (replay.returncode, err) == (0, b"")


def test_a_reader_that_takes_one_line_of_a_file_of_events_ends_it_silently(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(EVENT * 3000)
    command = [sys.executable, "-m", "runner", "replay", *PAPER, f"input={path}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as replay:
        assert replay.stdout and replay.stderr
        replay.stdout.readline()
        replay.stdout.close()
        err = replay.stderr.read()
        assert (replay.wait(timeout=20), err) == (0, b"")


@pytest.mark.parametrize("words", [["print", "source=test"], ["--help"], ["print", "--help"], ["--version"]])
def test_a_standard_output_closed_from_the_start(words: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", "runner", *words], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("closed", "words", "status"),
    [
        (">&-", "print source=test", 0),
        ("2>&-", "print fps_max=0", 2),
        ("<&-", "replay source=test", 0),
        pytest.param("<&- >&- 2>&-", "print source=test", 0, marks=pytest.mark.soak),
        pytest.param("<&- >&- 2>&-", "print fps_max=0", 2, marks=pytest.mark.soak),
        ("<&- >&- 2>&-", "replay source=test", 0),
    ],
)
def test_standard_streams_that_are_not_open(closed: str, words: str, status: int) -> None:
    command = f"'{sys.executable}' -m runner {words} {closed}"
    done = subprocess.run(["sh", "-c", command], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == status, done
    assert "Traceback" not in done.stderr


def test_a_closed_standard_error_does_not_change_the_status() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, "-m", "runner", "print", "fps_max=0"]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=writer, check=False)
    os.close(writer)
    assert (done.returncode, done.stdout) == (2, b"")


def test_ctrl_c_ends_with_130() -> None:
    replay = subprocess.Popen(
        [sys.executable, "-m", "runner", "replay", *PAPER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert replay.stdout and replay.stdin
    replay.stdin.write(EVENT.encode())
    replay.stdin.flush()
    replay.stdout.readline()
    replay.send_signal(signal.SIGINT)
    _, err = replay.communicate(timeout=20)
    assert (replay.returncode, err) == (130, b"")


# --- exit statuses ----------------------------------------------------------------------------------------------------


def test_the_table_of_exit_statuses_has_every_verb(tod: Command) -> None:
    """The table also has every status of `main`; invalid words end every verb with 2."""
    page = (Path(__file__).parents[1] / "docs" / "commands.md").read_text()
    section = page.partition("## Exit statuses")[2].partition("\n## ")[0]
    first = [row.split(" | ")[0].removeprefix("| ") for row in section.splitlines() if row.startswith("| ")]
    statuses, verbs = [cell for cell in first if cell.isdigit()], [cell for cell in first if "`" in cell]
    assert verbs == [f"`{verb}`" for verb in VERBS]
    assert main.__doc__
    returned = main.__doc__.partition("exit status: ")[2]
    assert statuses == re.findall(r"\d+", returned) == ["0", "1", "2", "129", "130", "143"]
    for verb in VERBS:
        assert tod(verb, "--nonsense").status == 2


@pytest.mark.parametrize(
    "words, status",
    [
        (["init", "/proc/nowhere"], 1),
        (["replay", "source=test", "input=/dev/null", "output=/proc/nowhere"], 2),
        (["map", "/nowhere", "output=x.csv"], 2),
        (["report", "/nowhere"], 2),
        (["quality", "/nowhere"], 2),
        (["export", "/nowhere"], 2),
        (["keys"], 2),
        (["completion", "fish"], 2),
        (["doctor", "fps_max=0"], 2),
        (["record", "fps_max=0", "output=x"], 2),
        (["model", "fps_max=0"], 2),
        (["vehicle", "fps_max=0"], 2),
        (["operator", "fps_max=0"], 2),
        (["demo", "fps_max=0"], 2),
        (["print", "fps_max=0"], 2),
        (["validate", "fps_max=0"], 2),
    ],
)
def test_exit_statuses(tod: Command, words: list[str], status: int) -> None:
    result = tod(*words)
    assert result.status == status, result
    assert "Traceback" not in result.err and (status == 0) == (result.err == "")
