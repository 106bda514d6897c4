"""The synthetic drive: its cache, and what the cameras see."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from functools import cache as cache_results
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from runner import clips, synthetic
from runner.clips import View, clip_path, is_whole, seal
from runner.core.mounting import Pose
from runner.synthetic import render

pytestmark = pytest.mark.slow  # renders pictures

np = pytest.importorskip("numpy")

SECONDS = 4.0
FORWARD = View(320, 180, Fraction(10), Pose(2.0, 0.0, 1.5, 0.0, 5.0, 0.0), 90.0, "pinhole")
LEFT = replace(FORWARD, pose=replace(FORWARD.pose, yaw_deg=90.0))
RIGHT = replace(FORWARD, pose=replace(FORWARD.pose, yaw_deg=-90.0))
TOP = View(160, 100, Fraction(15, 2), Pose(2.0, 1.0, 1.1, 90.0, 40.0, 0.0), 180.0, "fisheye")

Usage = namedtuple("Usage", "total used free")


def nothing(what: str, share: float) -> None:
    pass


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything is compiled here: each of several workers that start together would do it again."""
    from runner.synthetic.picture import pictures
    from runner.synthetic.world import build_world

    file = tmp_path_factory.mktemp("world") / "world"
    build_world(SECONDS, file)
    for view in (replace(FORWARD, fps=Fraction(1)), replace(TOP, fps=Fraction(1))):
        next(iter(pictures(view, SECONDS, file)))
    return file


@pytest.fixture(scope="module")
def render_luma(world: Path) -> Callable[[View], Any]:
    """All pictures of a view as luma, [frame, row, column], without any file."""
    from runner.synthetic.picture import pictures

    def luma(view: View) -> Any:
        frames = [np.frombuffer(picture, np.uint8) for picture in pictures(view, SECONDS, world)]
        return np.stack(frames)[:, : view.width * view.height].reshape(-1, view.height, view.width).astype(float)

    return luma


@pytest.fixture(scope="module")
def see(render_luma: Callable[[View], Any]) -> Callable[[View], Any]:
    """The same, each view rendered once for all tests, which only read it."""
    return cache_results(render_luma)


@contextmanager
def built(world: Path) -> Iterator[None]:
    """Building the street takes seconds: rendering reuses the one that is already built."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("runner.synthetic.world.build_world", lambda seconds, file: shutil.copy(world, file))
        yield


@pytest.fixture(scope="module")
def cache(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[tuple[str, float]]]]:
    """A cache with two clips, and the progress reported while they were rendered; FORWARD is requested twice."""
    folder, reports = tmp_path_factory.mktemp("cache"), []
    (folder / "drive-0.mp4.part").write_bytes(b"half a clip")
    with built(world):
        render([FORWARD, TOP, FORWARD], SECONDS, folder, lambda what, share: reports.append((what, share)))
    yield folder, reports


# --- the cache ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"width": 322},
        {"height": 182},
        {"fps": Fraction(11)},
        {"fov_deg": 91.0},
        {"lens": "fisheye"},
        *({"pose": replace(FORWARD.pose, **{key: 0.25})} for key in Pose.__dataclass_fields__),
    ],
)
def test_each_field_changes_the_path(change: dict[str, Any], tmp_path: Path) -> None:
    assert clip_path(replace(FORWARD, **change), 4, tmp_path) != clip_path(FORWARD, 4, tmp_path)


def test_path_is_content_addressed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = clip_path(FORWARD, 4, tmp_path)
    assert path == clip_path(replace(FORWARD), 4.0, tmp_path)
    assert path.parent == tmp_path
    assert path != clip_path(FORWARD, 5, tmp_path)
    monkeypatch.setattr(clips, "RENDERER_VERSION", clips.RENDERER_VERSION + 1)
    assert path != clip_path(FORWARD, 4, tmp_path)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"lens": "mirror"}, "lens: 'mirror': must be"),
        ({"width": 321}, "size: 321x180: both sides"),
        ({"fov_deg": 180.0}, "fov_deg: 180: must lie"),
        ({"pose": replace(FORWARD.pose, z_m=0.0)}, "z_m 0"),
    ],
)
def test_impossible_view(change: dict[str, Any], found: str) -> None:
    with pytest.raises(ValueError, match=found.replace("]", r"\]")):
        replace(FORWARD, **change)


def test_too_short(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="seconds: 3: must be at least 4"):
        render([FORWARD], 3, tmp_path, nothing)


def test_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9, 10**6))
    with pytest.raises(OSError, match=r"rendering the drive needs about \d+ MB, 1 MB are free") as caught:
        render([FORWARD], SECONDS, tmp_path, nothing)
    assert str(tmp_path) in str(caught.value)
    assert not list(tmp_path.glob("drive*"))


def test_numba_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthetic, "find_spec", lambda name: None)
    with pytest.raises(RuntimeError, match=r"needs numba: install the extra synthetic, see docs/install\.md"):
        render([FORWARD], SECONDS, tmp_path, nothing)


@pytest.mark.gst
def test_an_interrupt_ends_the_workers_and_leaves_no_partial_clip(world: Path, tmp_path: Path) -> None:
    import multiprocessing

    def interrupt(what: str, share: float) -> None:
        if share > 0:
            raise KeyboardInterrupt

    with built(world), pytest.raises(KeyboardInterrupt):
        render([FORWARD, LEFT], SECONDS, tmp_path, interrupt)
    assert not multiprocessing.active_children()
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]


def test_a_signal_is_noticed_while_workers_compile(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(synthetic.signals, "check", check)
    with built(world), pytest.raises(KeyboardInterrupt):
        render([FORWARD], SECONDS, tmp_path, lambda _, share: share and pytest.fail("a worker has reported"))


@pytest.mark.gst
def test_failing_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runner.synthetic.world.build_world", lambda seconds, file: None)
    with pytest.raises(RuntimeError, match="rendering the drive: FileNotFoundError"):
        render([FORWARD], SECONDS, tmp_path, nothing)


UNGUARDED = """
from fractions import Fraction
from pathlib import Path
import sys
from runner.clips import View
from runner.core.mounting import Pose
from runner.synthetic import render
view = View(160, 96, Fraction(5), Pose(2, 0, 1.5, 0), 90, "pinhole")
render([view], 4, Path(sys.argv[1]), lambda *_: None)
"""


@pytest.mark.soak  # starts Python and its renderer twice
def test_a_script_without_a_guard_ends_with_the_reason(tmp_path: Path) -> None:
    """Each worker runs it again; there the call must not wait for the one that started the worker."""
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    words = [sys.executable, str(script), str(tmp_path / "cache")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert 'a script that renders the synthetic drive needs `if __name__ == "__main__":`' in done.stderr
    assert "RuntimeError: rendering the drive: a worker died with exit code 1" in done.stderr


# --- the files ------------------------------------------------------------------------------------------------------


@pytest.mark.gst
def test_only_clips_remain(cache: tuple[Path, list[tuple[str, float]]]) -> None:
    folder, _ = cache
    clips = {clip_path(view, SECONDS, folder).name for view in (FORWARD, TOP)}
    assert {path.name for path in folder.iterdir()} == {*clips, "lock"}


@pytest.mark.gst
def test_progress_rises_to_one(cache: tuple[Path, list[tuple[str, float]]]) -> None:
    shares = [share for _, share in cache[1]]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len({share for share in shares if 0 < share < 1}) > 10


@pytest.mark.gst
def test_second_call_does_nothing(cache: tuple[Path, list[tuple[str, float]]]) -> None:
    folder, _ = cache
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.mp4")}
    reports: list[tuple[str, float]] = []
    render([TOP, FORWARD], SECONDS, folder, lambda what, share: reports.append((what, share)))
    assert reports == [("drive rendered", 1.0)]
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*.mp4")} == before


@pytest.mark.gst
def test_a_damaged_clip_is_rendered_again_once(
    world: Path, tmp_path: Path, cache: tuple[Path, list[tuple[str, float]]]
) -> None:
    path = clip_path(TOP, SECONDS, tmp_path)
    whole = (cache[0] / path.name).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    reports: list[str] = []
    with built(world):
        for _ in range(2):
            render([TOP], SECONDS, tmp_path, lambda what, _: reports.append(what))
    assert reports.count(f"{path} is damaged, rendered again") == 1
    assert path.stat().st_size == len(whole)
    assert decode(path)[1] == decode(cache[0] / path.name)[1]


@pytest.mark.parametrize("size", [1, 39, 40, 1000, 3_000_000])
def test_whatever_changes_in_a_sealed_file_is_noticed(size: int, tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    assert not is_whole(path)
    path.write_bytes(bytes(size))
    assert not is_whole(path)
    seal(path)
    assert is_whole(path)
    whole = path.read_bytes()
    for changed in (whole[:-1], whole[1:], whole + b"\0", b"\1" + whole[1:], whole[: size // 2], b""):
        path.write_bytes(changed)
        assert not is_whole(path)


@pytest.mark.gst
@pytest.mark.parametrize("view", [FORWARD, TOP])
def test_decoded_clip(view: View, cache: tuple[Path, list[tuple[str, float]]]) -> None:
    caps, times = decode(clip_path(view, SECONDS, cache[0]))
    assert (caps.get_int("width"), caps.get_int("height")) == ((True, view.width), (True, view.height))
    assert caps.get_fraction("framerate") == (True, view.fps.numerator, view.fps.denominator)
    assert caps.get_string("colorimetry") == "bt709"
    assert len(times) == view.frames(SECONDS)
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert max(abs(gap - 1e9 / view.fps) for gap in gaps) < 1e6 / 10


def decode(clip: Path) -> tuple[Any, list[int]]:
    """Caps structure and time in ns of each frame of a clip."""
    import gi

    gi.require_version("Gst", "1.0")
    from gi.repository import Gst

    from runner.gst.caps import structure

    Gst.init(None)
    line = f"filesrc location={clip} ! qtdemux ! h264parse ! avdec_h264 ! appsink name=sink sync=false"
    pipeline, times, caps = Gst.parse_launch(line), [], None
    pipeline.set_state(Gst.State.PLAYING)
    while sample := pipeline.get_by_name("sink").emit("try-pull-sample", 10 * Gst.SECOND):
        times.append(sample.get_buffer().pts)
        caps = structure(sample.get_caps())
    pipeline.set_state(Gst.State.NULL)
    return caps, times


@pytest.mark.gst
def test_writer_reports_the_error_of_gstreamer(tmp_path: Path) -> None:
    from runner.gst.clip_writer import write_clip

    with pytest.raises(RuntimeError, match="writing the clip: Could not open file"):
        write_clip(tmp_path / "no" / "such.mp4", iter([bytes(32 * 32 * 3 // 2)] * 9), 32, 32, Fraction(10))


@pytest.mark.soak  # 4 s of encoding, and the world rarely changes
@pytest.mark.gst
def test_side_view_needs_more_bits(tmp_path: Path) -> None:
    """The same encoder at the same quantizer; half left and half right against ahead, a whole default drive."""
    from runner.gst.clip_writer import write_clip
    from runner.synthetic.picture import pictures
    from runner.synthetic.world import build_world

    build_world(12, tmp_path / "world")
    ahead = replace(FORWARD, width=320, height=174, fps=Fraction(10))
    sizes = []
    for yaw in (0.0, 55.0, -55.0):
        view = replace(ahead, pose=replace(ahead.pose, yaw_deg=yaw))
        frames = pictures(view, 12, tmp_path / "world")
        write_clip(tmp_path / "clip.mp4", frames, view.width, view.height, view.fps, quantizer=32)
        sizes.append((tmp_path / "clip.mp4").stat().st_size)
    assert min(sizes[1:]) > 1.03 * sizes[0]


# --- the pictures ---------------------------------------------------------------------------------------------------


def difference(a: Any, b: Any) -> float:
    return float(np.abs(a - b).mean())


@pytest.mark.parametrize("view", [FORWARD, LEFT, TOP])
def test_loop_is_seamless(view: View, see: Callable[[View], Any]) -> None:
    pictures = see(view)
    steps = [difference(a, b) for a, b in pairwise(pictures)]
    assert difference(pictures[-1], pictures[0]) < 1.15 * max(steps[0], steps[-1])


def test_side_view_moves_more_than_forward_view(see: Callable[[View], Any]) -> None:
    forward, left, right = (
        np.mean([difference(a, b) for a, b in pairwise(see(view))]) for view in (FORWARD, LEFT, RIGHT)
    )
    assert min(left, right) > 1.15 * forward


def test_rendering_is_deterministic(render_luma: Callable[[View], Any]) -> None:
    assert (render_luma(TOP) == render_luma(TOP)).all()


def test_turned_camera_sees_the_same_world(see: Callable[[View], Any]) -> None:
    """A fisheye turned left by 45 degrees shows the same picture an eighth of its 360 degrees further to the right.

    This holds only near the horizon, where equal angles are equal distances; a mirrored picture would move left.
    """
    ahead = View(720, 64, Fraction(2), Pose(2.0, 0.0, 1.5, 0.0, 0.0, 0.0), 180.0, "fisheye")
    turned = replace(ahead, pose=replace(ahead.pose, yaw_deg=45.0))
    a, b = see(ahead)[:, 31:33], see(turned)[:, 31:33]
    moved_right, moved_left = difference(a[..., :540], b[..., 180:]), difference(a[..., 180:], b[..., :540])
    assert moved_right < 4
    assert moved_left > 3 * moved_right


def test_driving_forward_moves_pictures_of_side_cameras_backward(see: Callable[[View], Any]) -> None:
    """Pictures of the left camera move to the left, those of the right one to the right: nothing is mirrored."""
    fast = {"fps": Fraction(40), "height": 60}
    for view, sign in ((replace(LEFT, **fast), -1), (replace(RIGHT, **fast), 1)):
        pictures = see(view)[::16, 30:45]
        later = see(view)[1::16, 30:45]
        shifts = [4 * n for n in range(-5, 6)]
        errors = [difference(pictures[..., 40:-40], np.roll(later, -s, -1)[..., 40:-40]) for s in shifts]
        assert shifts[int(np.argmin(errors))] * sign > 0


def test_sky_is_up_and_roll_is_clockwise(see: Callable[[View], Any]) -> None:
    upright = replace(FORWARD, pose=replace(FORWARD.pose, pitch_deg=0.0))
    level = see(upright).mean(0)
    assert level[:20].mean() > level[-20:].mean() + 20
    upside_down = see(replace(upright, pose=replace(upright.pose, roll_deg=180.0)))
    assert difference(upside_down[:, ::-1, ::-1], see(upright)) < 3
    # The camera's left edge goes up, so it sees the bright sky.
    tipped = see(replace(upright, pose=replace(upright.pose, roll_deg=90.0))).mean(0)
    assert tipped[:, :20].mean() > tipped[:, -20:].mean() + 20


def test_pitch_tips_the_view_down(see: Callable[[View], Any]) -> None:
    up, down = (see(replace(FORWARD, pose=replace(FORWARD.pose, pitch_deg=pitch))).mean() for pitch in (-40.0, 40.0))
    assert up > down + 20


def test_cameras_at_the_same_place_agree_at_the_same_time(see: Callable[[View], Any]) -> None:
    """Twice the frame rate shows the same world twice as often."""
    assert (see(replace(FORWARD, fps=Fraction(20)))[::2] == see(FORWARD)).all()
