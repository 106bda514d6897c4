"""The log of a side, and reading it back: complete lines whatever happens, clear messages about errors."""

from __future__ import annotations

import errno
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from drives import write_drive
from helpers import Command

from runner.core.events import CameraSwitched
from runner.drive.log import Log, new_drive
from runner.drive.read import read_drive
from runner.errors import RunError, UserError
from runner.records.lines import LinesDropped, Note

CHECKOUT = Path(__file__).resolve().parents[1]
NOTES = """
import sys
from pathlib import Path
from runner.drive.log import Log

messages = []
log = Log(Path(sys.argv[1]), "vehicle", dict(), dict(), messages.append)
log.begin()
{limit}
for number in range({count}):
    log.note(f"{{number}} " + "x" * 5000)
log.close()
print(len(messages), *messages)
"""


def written(directory: Path, side: str = "drive.jsonl") -> list[str]:
    return (directory / side).read_text().splitlines(keepends=True)


def child(directory: Path, count: str, limit: str = "") -> subprocess.Popen[str]:
    code = NOTES.format(count=count, limit=limit)
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    return subprocess.Popen(
        [sys.executable, "-c", code, str(directory)], stdout=subprocess.PIPE, text=True, env=environment
    )


def run(code: str, directory: Path) -> subprocess.CompletedProcess[str]:
    """Python code in its own process, with a directory as argument."""
    command = [sys.executable, "-c", code, str(directory)]
    return subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=60, check=False)


def begun(directory: Path, config: dict[str, Any] | None = None) -> Log:
    log = Log(directory, "vehicle", config or {}, {"GStreamer": "1.22"}, lambda what: None)
    log.begin()
    return log


def test_a_drive_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    log = Log(tmp_path / "a" / "drive", "operator", {"name": "tum_q7"}, {"GStreamer": "1.22"}, lambda what: None)
    log.note("before the beginning")
    log.begin()
    log.note("grün")
    log.close()
    log.note("after the end")
    drive = read_drive(tmp_path / "a" / "drive")
    assert (drive.name, drive.warnings, list(drive.sides)) == ("drive", [], ["operator"])
    side = drive.sides["operator"]
    assert (side.began.config, side.began.versions["GStreamer"]) == ({"name": "tum_q7"}, "1.22")
    assert abs(side.began.time - time.time()) < 60
    assert [note.text for note in side.of(Note)] == ["before the beginning", "grün"]
    assert side.ended


def test_each_start_below_a_directory_of_drives_has_a_new_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also when the clock stands, and after a start that failed, which leaves nothing."""
    monkeypatch.setattr(time, "gmtime", lambda: time.struct_time((2026, 11, 25, 23, 5, 9, 2, 329, 0)))
    parent = tmp_path / "drives"
    for _ in range(2):
        begun(new_drive(parent)).close()
        Log(new_drive(parent), "vehicle", {}, {}, lambda what: None).close()
    (parent / "2026-11-25T23-05-09Z-3").mkdir()  # made by a user
    begun(new_drive(parent)).close()
    names = [f"2026-11-25T23-05-09Z{number}" for number in ("", "-2", "-3", "-4")]
    assert sorted(path.name for path in parent.iterdir()) == names
    assert [len(written(parent / name)) for name in names if name[-2:] != "-3"] == [2, 2, 2]


def test_a_start_that_failed_leaves_a_directory_that_existed(tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    for name in ("own", "made"):
        Log(tmp_path / name, "vehicle", {}, {}, lambda what: None).close()
    assert [path.name for path in tmp_path.iterdir()] == ["own"]


def test_a_killed_process_loses_at_most_its_last_line(tmp_path: Path) -> None:
    with child(tmp_path, "10**9") as process:
        while not (tmp_path / "drive.jsonl").exists() or len(written(tmp_path)) < 50:
            assert process.poll() is None
        process.send_signal(signal.SIGKILL)
    lines = written(tmp_path)
    whole = lines if lines[-1].endswith("\n") else lines[:-1]
    assert [json.loads(line)["text"].split()[0] for line in whole[1:]] == [str(n) for n in range(len(whole) - 1)]
    drive = read_drive(tmp_path)
    assert len(drive.sides["vehicle"].lines) == len(whole) - 1
    assert (
        drive.warnings[-1] == f"{tmp_path / 'drive.jsonl'}: was not closed; the process was killed or is still running"
    )


def test_a_full_disk_ends_the_log_and_not_the_drive(tmp_path: Path) -> None:
    """A limit on the size of files acts like a full disk: part of a line is written, then nothing."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (70_000, 70_000))"
    with child(tmp_path, "100", limit) as process:
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    first = f"the drive continues without its log: {tmp_path}/drive.jsonl: file too large; retrying"
    assert re.fullmatch(rf"2 {first} drive.jsonl: \d+ lines were not written\n", output)
    drive = read_drive(tmp_path)
    assert 10 <= len(drive.sides["vehicle"].lines) <= 14
    assert drive.warnings == [f"{tmp_path / 'drive.jsonl'}: was not closed; the process was killed or is still running"]


def test_an_interrupted_write_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    monkeypatch.setattr("runner.drive.log.os.write", lambda fd, data: write(fd, data[:100]))
    log = begun(tmp_path)
    for number in range(10):
        log.note(f"{number} " + "x" * 1000)
    log.close()
    drive = read_drive(tmp_path)
    assert drive.warnings == []
    assert [note.text.split()[0] for note in drive.sides["vehicle"].of(Note)] == [str(n) for n in range(10)]


def test_a_log_continues_when_the_disk_has_room_again(tmp_path: Path) -> None:
    """Nothing is lost while the disk is full: the lines are queued."""
    code = (
        "import resource, sys, time; from pathlib import Path; from runner.drive.log import Log\n"
        "messages = []; log = Log(Path(sys.argv[1]), 'vehicle', {}, {}, messages.append); log.begin()\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, -1))\n"
        "for n in range(99): log.note(f'{n} ' + 'x' * 1000)\n"
        "while not messages: time.sleep(0.01)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))\n"
        "while len(messages) < 2: time.sleep(0.01)\n"
        "log.note('99'); log.close(); print(*messages, sep='\\n')\n"
    )
    done = run(code, tmp_path)
    assert done.stdout.splitlines() == [
        f"the drive continues without its log: {tmp_path}/drive.jsonl: file too large; retrying",
        f"the log continues: {tmp_path}/drive.jsonl",
    ], done.stderr
    drive = read_drive(tmp_path)
    assert drive.warnings == []
    assert [note.text.split()[0] for note in drive.sides["vehicle"].of(Note)] == [str(n) for n in range(100)]


@pytest.mark.parametrize("call", ["fdatasync", "close"])
def test_lines_that_may_not_reach_the_disk_are_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    log_file: list[int] = []

    def fail(descriptor: int) -> None:
        if descriptor in log_file:
            raise OSError(errno.EIO, "Input/output error")
        original(descriptor)

    original = getattr(os, call)
    monkeypatch.setattr(os, call, fail)
    monkeypatch.setattr("runner.drive.log.SYNC_S", 0.0)
    messages: list[str] = []
    log = Log(tmp_path, "vehicle", {}, {}, messages.append)
    log_file += [
        int(each.name) for each in Path("/proc/self/fd").iterdir() if each.resolve() == tmp_path / "drive.jsonl"
    ]
    log.begin()
    for number in range(5):
        log.note(str(number))
    log.close()
    assert messages == ["lines may be missing: drive.jsonl: input/output error"]


def test_a_past_drive_that_may_not_reach_the_disk_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_descriptor: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    log = Log(tmp_path, "vehicle", {}, {}, lambda what: None)
    log.begin(at=0.0)
    monkeypatch.setattr(os, "fdatasync", fail)
    with pytest.raises(RunError, match=r"drive\.jsonl: lines may be missing: input/output error"):
        log.close()


def test_a_drive_is_flushed_to_the_disk_while_it_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[str] = []
    monkeypatch.setattr(os, "fdatasync", lambda _: threads.append(threading.current_thread().name))
    monkeypatch.setattr("runner.drive.log.SYNC_S", 0.0)
    log = begun(tmp_path)
    log.note("first")
    log.close()
    assert len(threads) > 3  # after each line, and at the end
    assert set(threads) == {"log"}


def opened(monkeypatch: pytest.MonkeyPatch, descriptor: int) -> None:
    """Make the file of the next log this one."""
    real = os.open

    def opens(path: Any, flags: int, *words: Any, **options: Any) -> int:
        is_new = str(path).endswith(".jsonl") and flags & os.O_CREAT
        return descriptor if is_new else real(path, flags, *words, **options)

    monkeypatch.setattr("runner.drive.log.os.open", opens)


@pytest.mark.parametrize(("limit", "most"), [("QUEUED_LINES", 100), ("QUEUED_BYTES", 500_000)])
def test_a_hanging_disk_does_not_block_and_dropped_lines_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int
) -> None:
    """The file is a pipe that is not read until all notes are queued."""
    monkeypatch.setattr(f"runner.drive.log.{limit}", most)
    read_end, write_end = os.pipe()
    opened(monkeypatch, write_end)
    log = begun(tmp_path)
    for number in range(1000):  # would never end if any of them waited for the disk
        log.note(f"{number} " + "x" * 5000)
    with open(read_end, "rb") as pipe:
        closing = threading.Thread(target=log.close)
        closing.start()
        (tmp_path / "drive.jsonl").write_bytes(pipe.read())
    closing.join(60)
    drive = read_drive(tmp_path)
    dropped = sum(line.lines for line in drive.sides["vehicle"].of(LinesDropped))
    kept = [int(note.text.split()[0]) for note in drive.sides["vehicle"].of(Note)]
    assert (len(kept) + dropped, kept) == (1000, sorted(kept))
    assert 90 < len(kept) < 120  # some are in the pipe
    assert drive.warnings == [f"{tmp_path / 'drive.jsonl'}: {dropped} lines were dropped, since the disk was too slow"]


def test_a_disk_that_hangs_forever_does_not_keep_the_process_alive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runner.drive.log.CLOSE_S", 0.1)
    read_end, write_end = os.pipe()
    opened(monkeypatch, write_end)
    messages: list[str] = []
    log = Log(tmp_path, "vehicle", {}, {}, messages.append)
    log.begin()
    for _ in range(20):
        log.note("x" * 5000)
    log.close()
    assert re.fullmatch(r"drive.jsonl: \d+ lines were not written", messages[0])
    os.close(read_end)  # the thread of the log ends


def test_lines_of_many_threads_are_not_mixed(tmp_path: Path) -> None:
    log = begun(tmp_path)

    def write(name: str) -> None:
        for number in range(200):
            log.note(f"{name} {number} " + name * 3000)

    threads = [threading.Thread(target=write, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    texts = [note.text for note in read_drive(tmp_path).sides["vehicle"].of(Note)]
    assert len(texts) == 4 * 200
    for name in "abcd":
        assert [text.split()[1] for text in texts if text[0] == name] == [str(n) for n in range(200)]


def test_a_misnamed_directory_is_reported_before_the_drive(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"command line: log: '.*/file': not a directory"):
        begun(tmp_path / "file")
    begun(tmp_path / "drive").close()
    with pytest.raises(UserError, match=r"already contains a drive \(drive.jsonl\), choose another directory"):
        Log(tmp_path / "drive", "vehicle", {}, {}, print)


def test_a_drive_begins_without_a_disk_and_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runner.drive.log.RETRY_S", 0.01)
    (tmp_path / "disk").symlink_to("/proc/self/task")  # there nothing can be made, also not by root
    messages: queue.Queue[str] = queue.Queue()
    log = Log(tmp_path / "disk" / "drive", "vehicle", {}, {}, messages.put)
    log.begin()
    log.note("first")
    path = tmp_path / "disk" / "drive" / "drive.jsonl"
    said = messages.get(timeout=5)
    assert said == f"the drive continues without its log: {path}: no such file or directory; retrying"
    (tmp_path / "disk").unlink()
    (tmp_path / "disk").mkdir(exist_ok=True)  # a retry may come first
    assert messages.get(timeout=5) == f"the log continues: {path}"
    log.close()
    drive = read_drive(path.parent)
    assert ([note.text for note in drive.sides["vehicle"].of(Note)], drive.warnings) == (["first"], [])


def test_a_service_drives_although_its_directory_holds_a_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its manager would start it again for ever."""
    begun(tmp_path).close()
    before = written(tmp_path)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "manager"))
    messages: queue.Queue[str] = queue.Queue()
    log = Log(tmp_path, "vehicle", {}, {}, messages.put)
    log.begin()
    rule = "already contains a drive (drive.jsonl), choose another directory"
    said = messages.get(timeout=5)
    log.close()
    assert said == f"the drive continues without its log: {tmp_path / 'drive.jsonl'}: {rule}; retrying"
    assert written(tmp_path) == before


def test_a_log_that_never_begins_leaves_no_file(tmp_path: Path) -> None:
    log = Log(tmp_path, "vehicle", {}, {}, print)
    with pytest.raises(UserError, match="is empty: nothing was logged"):
        read_drive(tmp_path)
    log.close()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "drive.jsonl").touch()  # left by a process that was killed before it began
    begun(tmp_path).close()
    assert len(written(tmp_path)) == 2


def test_a_side_that_never_began_does_not_hide_the_other(tmp_path: Path) -> None:
    begun(tmp_path).close()
    (tmp_path / "operator.jsonl").touch()
    drive = read_drive(tmp_path)
    assert [*drive.sides] == ["vehicle"]
    assert drive.warnings == [f"{tmp_path / 'operator.jsonl'}: is empty: nothing was logged"]


def test_the_callback_for_a_full_disk_may_write_to_the_log(tmp_path: Path) -> None:
    """As the operator's station does: it writes the message to the log that reported it."""
    code = (
        "import resource, sys; from pathlib import Path; from runner.drive.log import Log\n"
        "log = Log(Path(sys.argv[1]), 'operator', {}, {}, lambda what: log.note(what))\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000)); log.begin()\n"
        "for n in range(9): log.note('x' * 1000)\n"
        "log.close(); print('done')\n"
    )
    done = run(code, tmp_path)
    assert done.stdout == "done\n", done.stderr


def test_a_lone_surrogate_is_written(tmp_path: Path) -> None:
    """A request may name any camera, and its refusal is logged."""
    log = begun(tmp_path)
    event = CameraSwitched(t=0.1, camera="\ud800", on=False)
    log.event(event)
    log.close()
    assert read_drive(tmp_path).sides["vehicle"].lines == [event]


@pytest.mark.parametrize(
    "change, expected",
    [
        (lambda lines: [], "{file}: is empty: nothing was logged"),
        (lambda lines: lines[1:], "{file}: line 1: not the first line of a drive log: must be a file that log= wrote"),
        (lambda lines: ['{"a": 1}\n'], "{file}: line 1: event: missing: must be given"),
        (lambda lines: ["PK\x03\x04 no text\n"], "{file}: line 1: not JSON: Expecting value (column 1)"),
        (lambda lines: [*lines[:2], "{\n", *lines[2:]], "{file}: line 3: not JSON: "),
        (
            lambda lines: [lines[0], lines[1].replace('"text"', '"txt"')],
            "{file}: line 2: txt: unknown key, did you mean text?",
        ),
        (
            lambda lines: [lines[0].replace('"vehicle"', '"operator"')],
            "{file}: line 1: side: 'operator': must be vehicle",
        ),
        (
            lambda lines: [lines[0].replace('"format": 2', '"format": 9')],
            "{file}: line 1: format: 9: this version reads format 2",
        ),
        (
            lambda lines: [re.sub('"time": [0-9.]+', '"time": 1e18', lines[0])],
            "{file}: line 1: time: 1e+18: must be at most 4294967295",
        ),
        (lambda lines: lines * 2, "{file}: line 4: a second drive begins here; each needs a directory of its own"),
        (
            lambda lines: [*lines, lines[1]],
            "{file}: line 4: the drive ended with the line before; each drive needs a directory of its own",
        ),
        (
            lambda lines: [lines[0], *(f'{{"t": {t}, "event": "clock_advanced"}}\n' for t in (1, 3, 2.9))],
            "{file}: line 4: t: 2.9: must not decrease; the event before was at 3",
        ),
        (
            lambda lines: [lines[0], '{"t": 1e9, "event": "clock_advanced"}\n'],
            "{file}: line 2: t: 1000000000.0: must be at most a day after the line before, at 0.0",
        ),
    ],
)
def test_an_invalid_drive_is_reported_with_its_line(tmp_path: Path, change: Any, expected: str) -> None:
    log = begun(tmp_path)
    log.note("a")
    log.close()
    file = tmp_path / "drive.jsonl"
    file.write_text("".join(change(written(tmp_path))))
    with pytest.raises(UserError) as error:
        read_drive(tmp_path)
    assert str(error.value).startswith(expected.format(file=file))


def test_lines_of_several_threads_are_put_into_order(tmp_path: Path) -> None:
    """Also those of a process that was stopped between reading the time and writing the line."""
    log = begun(tmp_path)
    for t in (0.5, 0.2, 60.9, 1.1):
        log.record(Note(t, str(t)))
    log.close()
    assert [note.text for note in read_drive(tmp_path).sides["vehicle"].of(Note)] == ["0.2", "0.5", "1.1", "60.9"]


def test_every_verb_refuses_two_drives_in_one_file(tod: Command, tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive", seconds=5)
    file = drive / "drive.jsonl"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines + lines))
    for verb, word in ("report", f"{drive}"), ("map", f"{drive}"), ("export", f"{drive}"), ("replay", f"input={drive}"):
        done = tod(verb, word, f"output={tmp_path / 'out'}")
        assert (done.status, done.err.splitlines()[-1]) == (
            2,
            f"{file}: line {len(lines) + 1}: a second drive begins here; each needs a directory of its own",
        )


def test_logs_of_two_vehicles_are_named(tmp_path: Path) -> None:
    write_drive(tmp_path, ["vehicle"], seconds=3)
    write_drive(tmp_path, ["operator"], seconds=3, overrides=["vehicle=delivery_robot"])
    rule = "drive.jsonl of tum_q7 and operator.jsonl of delivery_robot; each needs a directory of its own"
    with pytest.raises(UserError) as error:
        read_drive(tmp_path)
    assert str(error.value) == f"{tmp_path}: holds the logs of two vehicles, {rule}"


def test_a_directory_without_a_drive_is_reported(tmp_path: Path) -> None:
    for path, rule in (
        (tmp_path, "contains no drive log: neither drive.jsonl nor operator.jsonl"),
        (tmp_path / "nowhere", "no such directory"),
        (Path(__file__), "must be a directory that log= wrote"),
    ):
        with pytest.raises(UserError) as error:
            read_drive(path)
        assert str(error.value) == f"{path}: {rule}"


def test_two_processes_do_not_take_one_drive(tmp_path: Path) -> None:
    """The second used to remove the file of the first, which then logged into nothing."""
    first = Log(tmp_path, "vehicle", {}, {}, print)
    with pytest.raises(UserError, match=r"another process is about to write drive\.jsonl"):
        Log(tmp_path, "vehicle", {}, {}, print)
    first.begin()
    first.note("still here")
    first.close()
    assert "still here" in (tmp_path / "drive.jsonl").read_text()
