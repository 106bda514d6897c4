"""The verb `report`: its files, one drive or several, missing sides, and every error with its message."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from drives import Lines, write_drive, write_models
from helpers import CONF, Command, Result

from runner.configuration.compose import compose
from runner.core.events import CameraSwitched
from runner.drive import quality_file, seen_file
from runner.drive.charts import Figure
from runner.drive.checks import ClaimCheck
from runner.drive.colours import DAY, NIGHT
from runner.drive.figures import bitrates, figures
from runner.drive.quality_file import DeliveredQuality
from runner.drive.read import read_drive
from runner.drive.seen_file import Ages, Optimum, SeenCamera, SeenDrive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.schema import findings
from runner.system import extras

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")
image = pytest.importorskip("PIL.Image")

pytestmark = pytest.mark.slow  # draws figures

FIGURES = ["bitrate_on_track", "totals", "bitrates", "scaling", "latency"]
STATIC = Path(CONF).parent / "runner" / "page" / "static"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drives") / "test_drive"
    return write_drive(path, seconds=20, freezes={"top_rear": [(6.0, 1.5)]}, congested=0.5)


class Report(NamedTuple):
    """A report with all its figures, which takes seconds: tests that only read it share it."""

    result: Result
    output: Path


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_models(tmp_path_factory.mktemp("models"), compose(["source=test"]).document)


@pytest.fixture(scope="module")
def made(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Made without GStreamer, OpenCV and other libraries that a report does not need."""
    output = tmp_path_factory.mktemp("made") / "deep" / "report"
    program = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(('gi', 'cv2', 'numba', 'scipy', 'aiohttp', 'paho')))\n"
        "from runner.__main__ import main\n"
        f"sys.exit(main(['report', {str(drive)!r}, 'output={output}']))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    return Report(Result(done.returncode, done.stdout, done.stderr), output)


def defined(path: Path) -> dict[str, Figure]:
    """The figures of a drive, by name."""
    return {figure.name: figure for figure in figures([statistics(series(read_drive(path)))])[0]}


def drawn(figure: Figure) -> Any:
    """A figure as drawn for print."""
    from runner.drive.print import draw_sheet

    return draw_sheet(figure)


def document(output: Path) -> dict[str, Any]:
    content = json.loads((output / "report.json").read_text())
    assert findings(content, "report") == []
    return dict(content)


def check_figures(output: Path, names: list[str]) -> None:
    """Check that each exists as a non-blank PNG of column width and as a PDF, and that no partial file exists."""
    expected = {f"{name}.{form}" for name in names for form in ("png", "pdf")} | {"index.html", "report.json"}
    assert {path.name for path in output.iterdir()} == expected
    for name in names:
        data = (output / f"{name}.png").read_bytes()
        picture = image.open(BytesIO(data))
        assert picture.format == "PNG"
        assert picture.width == 3.5 * 300
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 20
        pdf = (output / f"{name}.pdf").read_bytes()
        assert pdf.startswith(b"%PDF-")
        assert pdf.rstrip().endswith(b"%%EOF")


def test_a_drive(made: Report) -> None:
    (status, out, err), output = made
    assert status == 0, err
    assert out.splitlines()[-1] == str(output / "index.html")
    check_figures(output, FIGURES)
    content = document(output)
    assert content["figures"] == FIGURES
    (one,) = content["drives"]
    assert (one["label"], one["vehicle"], one["began"]) == ("test_drive", "tum_q7", "2026-02-02T02:40:00Z")
    assert one["duration_s"] == 20
    assert one["ended"] == {"vehicle": True, "operator": True, "link": True}
    assert one["freezes"] == 1
    assert one["link"]["dropped"] == one["lost"]
    assert [camera["name"] for camera in one["cameras"]][:2] == ["front_left", "front_center"]
    for camera in one["cameras"]:
        assert re.search(rf"^ ?{camera['name']} +{camera['frames']} ", out, re.M), camera["name"]
    (note,) = one["notes"]
    assert note.startswith("estimated quality: no camera has a rate-quality model; create them with `tod-runner model ")
    assert note in out


@pytest.mark.usefixtures("unprinted")
def test_with_models_quality_is_estimated(tod: Command, drive: Path, tmp_path: Path, models: Path) -> None:
    assert tod("report", str(drive), f"output={tmp_path / 'all'}", f"models={models}").status == 0
    content = document(tmp_path / "all")
    assert content["figures"] == [*FIGURES, "quality"]
    (one,) = content["drives"]
    assert one["quality"]["metric"] == "mssim"
    assert 0.7 < one["quality"]["mean"] < 0.95
    fewer = shutil.copytree(models, tmp_path / "models")
    (fewer / "top_left.model.json").unlink()
    assert tod("report", str(drive), f"output={tmp_path / 'out'}", f"models={fewer}").status == 0
    (one,) = document(tmp_path / "out")["drives"]
    assert one["notes"][-1].startswith("estimated quality: all but top_left have one; ")
    assert [camera["name"] for camera in one["cameras"] if camera["quality"] is None] == ["top_left"]


@pytest.mark.usefixtures("unprinted")
def test_quality_that_was_measured_on_the_pictures_is_shown(tod: Command, drive: Path, tmp_path: Path) -> None:
    path = tmp_path / "measured"
    shutil.copytree(drive, path)
    moments = tuple(np.arange(0.5, 19, 0.5))
    found = {
        "front_left": DeliveredQuality(moments, tuple(0.9 + 0.0012 * t for t in moments), 0.0, clip=True),
        "top_rear": DeliveredQuality(moments, tuple(0.3 if 6 < t < 7.5 else 0.8 for t in moments), 0.1, clip=False),
        "top_left": DeliveredQuality((), (), 0.0, clip=True),
    }
    (path / "quality.json").write_text(json.dumps(quality_file.to_json(found)))
    status, out, _ = tod("report", str(path), f"output={tmp_path / 'out'}")
    assert status == 0
    content = document(tmp_path / "out")
    (described,) = content["drives"]
    cameras = {camera["name"]: camera["delivered"] for camera in described["cameras"]}
    means = [np.mean(found[name].mssim) for name in ("front_left", "top_rear")]
    assert described["delivered"] == {
        "metric": "mssim",
        "mean": pytest.approx(np.mean(means), abs=1e-5),
        "worst": pytest.approx(min(means), abs=1e-5),
    }
    assert cameras["top_rear"]["lowest"] == 0.3
    assert (cameras["top_rear"]["against"], cameras["front_left"]["against"]) == ("stream", "scene")
    assert (cameras["top_left"]["mean"], cameras["top_left"]["moments"]) == (None, 0)
    assert cameras["rear_center"] is None
    assert "delivered" in content["figures"]
    assert "delivered" in out
    assert f"{means[0]:.3f}" in out


@pytest.mark.usefixtures("unprinted")
def test_without_measured_quality_the_figure_is_left_out(tod: Command, drive: Path, tmp_path: Path) -> None:
    assert tod("report", str(drive), f"output={tmp_path}").status == 0
    content = document(tmp_path)
    assert content["drives"][0]["delivered"] is None
    assert any(each.startswith("delivered: left out, quality of delivered pictures") for each in content["left_out"])


@pytest.mark.usefixtures("unprinted")
def test_what_was_seen_on_the_screen_is_shown_beside_the_optimum(tod: Command, drive: Path, tmp_path: Path) -> None:
    path = shutil.copytree(drive, tmp_path / "measured")
    moments = tuple(float(t) for t in np.arange(0.5, 19, 0.5))
    falling = {"mssim": tuple(0.95 - 0.005 * t for t in moments), "vmaf": tuple(90 - t for t in moments)}
    lacking: dict[str, tuple[float | None, ...]] = {
        "mssim": (None, *[0.7] * (len(moments) - 1)),
        "vmaf": (None, *[50.0] * (len(moments) - 1)),
    }
    ages = Ages(45.0, 80.0, 0.01, 0.02)
    cameras = {
        "front_center": SeenCamera(moments, (300,) * len(moments), falling, ages, scene=True),
        "rear_center": SeenCamera(moments, (100,) * len(moments), lacking, None, scene=False),
    }
    metrics = {"mssim": "MSSIM of luma", "vmaf": "VMAF"}
    found = SeenDrive("view.jsonl", metrics, cameras, Optimum(2500.0, 0.931, {"front_center": 0.95}))
    (path / "seen.json").write_text(json.dumps(seen_file.to_json(found)))
    status, out, _ = tod("report", str(path), f"output={tmp_path / 'out'}")
    assert status == 0
    content = document(tmp_path / "out")
    described = content["drives"][0]["seen"]
    screen = [0.75 * (0.95 - 0.005 * t) + 0.25 * 0.7 for t in moments[1:]]
    assert described["screen"]["mssim"]["mean"] == pytest.approx(np.mean(screen), abs=1e-5)
    assert described["screen"]["mssim"]["worst"] == pytest.approx(min(screen), abs=1e-5)
    assert described["cameras"]["front_center"]["age"]["late_share"] == 0.02
    assert described["cameras"]["rear_center"]["scores"]["mssim"]["p5"] == pytest.approx(0.7)
    assert described["optimum"] == {"kbps": 2500, "mssim": 0.931}
    assert "seen" in content["figures"]
    assert "on the screen" in out
    assert "0.931" in out
    assert "0.931" in (tmp_path / "out" / "index.html").read_text()


@pytest.mark.parametrize("text", ["{", '{"cameras": {"front_left": {"t": 1}}}'])
def test_what_was_seen_that_cannot_be_read(tod: Command, drive: Path, tmp_path: Path, text: str) -> None:
    path = shutil.copytree(drive, tmp_path / "measured")
    (path / "seen.json").write_text(text)
    status, _, err = tod("report", str(path), f"output={tmp_path / 'out'}")
    assert status == 2
    rule = "must be as `tod-runner quality DRIVE view=LOG` writes it: run it again, or delete the file"
    assert err.splitlines()[-1] == f"{path / 'seen.json'}: {rule}"


@pytest.mark.parametrize("text", ["{", "[]", '{"cameras": {"front_left": {"t": 1}}}', '{"cameras": 1}'])
def test_measured_quality_that_cannot_be_read(tod: Command, drive: Path, tmp_path: Path, text: str) -> None:
    path = tmp_path / "measured"
    shutil.copytree(drive, path)
    (path / "quality.json").write_text(text)
    status, _, err = tod("report", str(path), f"output={tmp_path / 'out'}")
    assert status == 2
    rule = "must be as `tod-runner quality` writes it: run it again, or delete the file"
    assert err.splitlines()[-1] == f"{path / 'quality.json'}: {rule}"


@pytest.mark.usefixtures("unprinted")
def test_a_model_that_the_configuration_names(tod: Command, tmp_path: Path) -> None:
    def named(side: str, lines: Lines) -> Lines:
        return lines

    path = write_drive(tmp_path / "drive", ["vehicle"], seconds=5, change=named)
    log = path / "drive.jsonl"
    began, *rest = log.read_text().splitlines(keepends=True)
    first = json.loads(began)
    first["config"]["cameras"]["front_center"]["rate_quality"]["model"] = "center.model.json"
    log.write_text(json.dumps(first) + "\n" + "".join(rest))
    own = write_models(tmp_path / "conf" / "cameras", {"cameras": {"center": first["config"]["cameras"]["top_left"]}})
    assert own.is_dir()
    tod("report", str(path), f"output={tmp_path / 'out'}", f"conf={tmp_path / 'conf'}")
    (one,) = document(tmp_path / "out")["drives"]
    assert one["notes"][-1].startswith("estimated quality: all but front_left, front_right, ")


def test_several_drives(tod: Command, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(figures: Sequence[Figure], *_: Any) -> None:
        sheets.update({figure.name: drawn(figure) for figure in figures})

    sheets: dict[str, Any] = {}
    monkeypatch.setattr("runner.drive.print.write_figures", write)
    still = ("pqos=constant", "pqos.kbps=6000")
    other = write_drive(tmp_path / "other" / "test_drive", seconds=10, overrides=still)
    status, out, _ = tod("report", str(drive), str(other), f"output={tmp_path / 'out'}")
    assert status == 0
    assert [*sheets] == FIGURES
    content = document(tmp_path / "out")["drives"]
    assert [one["label"] for one in content] == [f"{drive.parent.name}/test_drive", "other/test_drive"]
    assert content[1]["notes"][0] == "no positions were logged: not drawn on the map"
    assert "all drives" in out
    assert sheets["totals"].get_figheight() > sheets["bitrate_on_track"].get_figheight()


@pytest.mark.usefixtures("unprinted")
def test_a_replay_is_compared_by_what_it_allocated(tod: Command, drive: Path, tmp_path: Path) -> None:
    """It used to leave an empty axis, and a row of dashes."""
    replayed = tmp_path / "steadier"
    assert tod("replay", f"input={drive}", "modes=steady", f"log={replayed}").status == 0
    config = json.loads((drive / "drive.jsonl").read_text().splitlines()[0])["config"]
    models = write_models(tmp_path / "models", config)
    status, out, _ = tod("report", str(drive), str(replayed), f"output={tmp_path / 'out'}", f"models={models}")
    assert status == 0
    driven, decided = document(tmp_path / "out")["drives"]
    assert (driven["label"], decided["label"]) == ("test_drive", "steadier (replay: modes=steady)")
    assert (driven["replayed"], decided["replayed"]) == (None, ["modes=steady"])
    mean = decided["allocated_kbps"]
    assert mean == pytest.approx(driven["allocated_kbps"], rel=0.05)
    assert decided["quality"]["mean"] == pytest.approx(driven["quality"]["mean"], abs=0.01)
    row = out.partition("all drives")[2].partition("steadier (replay: modes=steady) ")[2].partition("\n")[0]
    assert f" {mean:.0f} " in row
    assert f" {decided['quality']['mean']:.3f} MSSIM, as allocated" in row
    each = [statistics(series(read_drive(path))) for path in (drive, replayed)]
    rows = bitrates(each)
    assert {chart.y.title for row in rows for chart in row} == {"allocated bitrate in kbit/s"}
    assert all(np.isfinite(curve.y).all() and curve.y.max() > 100 for row in rows for ch in row for curve in ch.curves)


@pytest.mark.parametrize(
    "sides, figures",
    [
        (["vehicle"], ["bitrate_on_track", "bitrates", "scaling", "totals"]),
        (["operator"], FIGURES),
        (["vehicle", "operator"], FIGURES),
    ],
)
@pytest.mark.usefixtures("unprinted")
def test_sides_that_are_missing(tod: Command, tmp_path: Path, sides: list[str], figures: list[str]) -> None:
    path = write_drive(tmp_path / "drive", sides, seconds=5)
    status, out, _ = tod("report", str(path), f"output={tmp_path / 'out'}")
    assert status == 0
    content = document(tmp_path / "out")
    assert sorted(content["figures"]) == sorted(figures)
    assert content["drives"][0]["link"] is None
    if "operator" not in sides:
        left_out = "latency: left out, no latency was logged: an operator's log is needed"
        assert left_out in content["left_out"]
        assert left_out in out


@pytest.mark.usefixtures("unprinted")
def test_one_camera_and_no_positions(tod: Command, tmp_path: Path) -> None:
    others = ("front_center", "front_right", "rear_center", "top_front", "top_left", "top_right", "top_rear")
    overrides = ("pqos=constant", "pqos.kbps=2000", *(f"~cameras.{name}" for name in others))
    path = write_drive(tmp_path / "drive", seconds=5, overrides=overrides)
    assert tod("report", str(path), f"output={tmp_path / 'out'}").status == 0
    content = document(tmp_path / "out")
    assert content["figures"] == [name for name in FIGURES if name != "bitrate_on_track"]
    assert "bitrate_on_track: left out, no positions were logged" in content["left_out"]


@pytest.mark.usefixtures("unprinted")
def test_a_camera_that_is_off_all_the_time(tod: Command, tmp_path: Path) -> None:
    off = CameraSwitched(t=0.0, camera="rear_center", on=False)
    path = write_drive(tmp_path / "drive", seconds=5, events=(off,))
    assert tod("report", str(path), f"output={tmp_path / 'out'}").status == 0
    (one,) = document(tmp_path / "out")["drives"]
    rear = one["cameras"][3]
    assert (rear["frames"], rear["hz"], rear["share"], rear["sizes"]) == (0, None, None, [])
    assert rear["freezes"]["count"] == 0
    assert rear["factors"][0]["scaling"] == 0


@pytest.mark.usefixtures("unprinted")
def test_claims_are_checked_against_the_drive(
    drive: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from runner.drive import claims as module
    from runner.verbs.report import report

    claims = [
        ClaimCheck("the total varies", "3000 to 7310 kbit/s", True),
        ClaimCheck("<b>", "&", False),
        ClaimCheck("c", "d", None),
    ]
    monkeypatch.setattr(module, "claims", lambda series: claims)
    report([drive], tmp_path / "out")
    (one,) = document(tmp_path / "out")["drives"]
    assert one["checks"][0] == {"claim": "the total varies", "outcome": "3000 to 7310 kbit/s", "holds": True}
    page = (tmp_path / "out" / "index.html").read_text()
    assert '<th scope="row">&lt;b&gt;</th><td>&amp;</td><td>no</td>' in page
    assert "the total varies" in capfd.readouterr().out


@pytest.mark.usefixtures("unprinted")
def test_texts_of_the_drive_are_no_markup(tod: Command, tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>{{data}}"

    def change(side: str, lines: Lines) -> Lines:
        for entry in lines:
            for camera in entry["cameras"].values() if entry.get("log") in ("decision", "state") else ():
                camera["reason"] = evil
        return [*lines, {"t": lines[-1]["t"], "log": "note", "text": evil}]

    path = write_drive(tmp_path / f"<b>{'x' * 20}", seconds=3, change=change)
    assert tod("report", str(path), f"output={tmp_path / 'out'}").status == 0
    page = (tmp_path / "out" / "index.html").read_text()
    tags: list[str] = []

    class Tags(HTMLParser):
        def handle_starttag(self, tag: str, attrs: Any) -> None:
            tags.append(tag)

    Tags().feed(page)
    assert tags.count("script") == 3
    assert "img" not in tags
    assert "b" not in tags


@pytest.mark.parametrize("congested, scale", [(0.0, "linear"), (3.0, "log")])
def test_the_latency_axis_covers_all_values(tmp_path: Path, congested: float, scale: str) -> None:
    path = write_drive(tmp_path / "drive", seconds=20, congested=congested)
    axes = drawn(defined(path)["latency"]).axes[0]
    shown = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.lines])
    low, high = axes.get_ylim()
    assert axes.get_yscale() == scale
    assert low <= np.nanmin(shown)
    assert high >= np.nanmax(shown)


def test_print_and_page_draw_the_same_curves(drive: Path) -> None:
    for name, figure in defined(drive).items():
        charts = [chart for row in figure.rows for chart in row]
        axes = [each for each in drawn(figure).axes if each.get_title(loc="left")] or drawn(figure).axes[:1]
        assert len(axes) == len(charts), name
        for each, chart in zip(axes, charts, strict=True):
            expected = [curve for curve in chart.curves if not curve.filled]
            for line, curve in zip(each.lines[: len(expected)] if expected else (), expected, strict=True):
                assert np.array_equal(np.asarray(line.get_ydata()), curve.y, equal_nan=True), (name, curve.label)


def test_cameras_that_coincide_are_one_curve_with_their_range(drive: Path) -> None:
    (both, top) = defined(drive)["bitrates"].rows[0]
    assert [curve.label for curve in both.curves] == [
        "front_left, front_right: mean and range",
        "front_center",
        "rear_center",
    ]
    assert [curve.label for curve in top.curves] == ["all 4 cameras: mean and range"]
    (mean,) = top.curves
    assert mean.around is not None
    low, high = mean.around
    known = np.isfinite(mean.y)
    assert (low <= mean.y)[known].all()
    assert (mean.y <= high)[known].all()
    assert (low < high)[known].any()


def test_an_offset_is_stated_where_curves_overlap(drive: Path) -> None:
    along, top = defined(drive)["scaling"].rows[0]
    stated = [re.search(r"\(offset ([+-]0\.\d+)\)", curve.label) for curve in along.curves]
    assert [each and each[1] for each in stated] == ["+0.007", None, "-0.007"]
    for curve, each in zip(along.curves, stated, strict=True):
        offset = float(each[1]) if each else 0.0
        assert set(np.round(curve.y[np.isfinite(curve.y)] - offset, 3)) <= {0.125, 0.25, 0.5}
    assert [curve.label for curve in top.curves] == ["all 4 cameras"]


def test_one_camera_is_called_by_its_name(tmp_path: Path) -> None:
    others = ("front_center", "front_right", "rear_center", "top_front", "top_left", "top_right", "top_rear")
    found = defined(write_drive(tmp_path / "drive", seconds=5, overrides=[f"~cameras.{name}" for name in others]))
    assert [chart.title for row in found["bitrates"].rows for chart in row] == ["front_left"]
    assert [chart.title for row in found["latency"].rows for chart in row] == ["each second", "distribution"]
    assert [curve.label for curve in found["latency"].rows[1][0].curves] == ["front_left"]


@pytest.mark.usefixtures("unprinted")
def test_notes_appear_once_and_figures_above_versions(tod: Command, drive: Path, tmp_path: Path) -> None:
    other = write_drive(tmp_path / "other", seconds=5)
    assert tod("report", str(drive), str(other), f"output={tmp_path / 'out'}").status == 0
    page = (tmp_path / "out" / "index.html").read_text()
    text = page[: page.index("<script type")]
    for once in ("no camera has a rate-quality model", "quality: left out", "Arrival and decode:", "GStreamer 1.22.0"):
        assert text.count(once) == 1, once
    assert text.index('id="quality"' if 'id="quality"' in text else 'id="latency"') < text.index("<h2>Versions</h2>")
    assert text.index('id="bitrate_on_track"') < text.index("GStreamer 1.22.0")


def test_the_same_drive_gives_the_same_files(tod: Command, drive: Path, tmp_path: Path, made: Report) -> None:
    """Here and in another process."""
    tod("report", str(drive), f"output={tmp_path}")
    for path in made.output.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


def test_colours_are_those_of_the_operators_page() -> None:
    script = (STATIC / "colours.js").read_text()
    assert tuple(re.findall("#[0-9a-f]{6}", script)) == (*NIGHT, *DAY)


# --- mistakes ---------------------------------------------------------------------------------------------------------


def test_a_page_of_the_users_own_is_not_overwritten(tod: Command, drive: Path, tmp_path: Path) -> None:
    own = tmp_path / "index.html"
    own.write_text("<title>my site</title>")
    rule = "exists and was not written by tod-runner report; choose another directory"
    assert tod("report", str(drive), f"output={tmp_path}") == (2, "", f"command line: output: '{own}': {rule}\n")
    assert own.read_text() == "<title>my site</title>"


@pytest.mark.usefixtures("unprinted")
def test_a_report_is_made_again(tod: Command, drive: Path, tmp_path: Path) -> None:
    words = ("report", str(drive), f"output={tmp_path}")
    assert (tod(*words).status, tod(*words).status) == (0, 0)


def test_invalid_words(tod: Command, drive: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    out = f"output={tmp_path / 'out'}"
    wrong = [
        ([out], "command line: DRIVE: must be given: a directory that log= wrote"),
        ([str(drive)], "command line: output: must be given: the directory to write the report to"),
        (["/nowhere", out], "/nowhere: no such directory"),
        ([str(drive), f"output={file}"], f"command line: output: '{file}': must be a directory, but {file} is a file"),
        (
            [str(drive), f"output={file}/deep"],
            f"command line: output: '{file}/deep': must be a directory, but {file} is a file",
        ),
        ([str(drive), out, "models=/nowhere"], "command line: models: '/nowhere': no such directory"),
        (
            [str(drive), out, "vehicle=x"],
            "command line: vehicle=x: unknown argument; expected one of output, models, positions, topic, conf",
        ),
        ([str(drive), "--output"], "command line: --output: flags are not supported; write NAME=VALUE, or --help"),
        ([str(tmp_path), out], f"{tmp_path}: contains no drive log: neither drive.jsonl nor operator.jsonl"),
    ]
    for words, expected in wrong:
        status, printed, err = tod("report", *words)
        assert (status, printed, err.splitlines()[-1]) == (2, "", expected)
    assert not (tmp_path / "out").exists()


def test_files_that_are_not_a_model(tod: Command, drive: Path, tmp_path: Path) -> None:
    (tmp_path / "front_left.model.json").write_text("{")
    status, _, err = tod("report", str(drive), f"output={tmp_path / 'out'}", f"models={tmp_path}")
    assert status == 2
    assert err.splitlines()[-1].startswith(f"{tmp_path}/front_left.model.json: is not a model file: ")


@pytest.mark.usefixtures("unprinted")
def test_a_path_may_hold_an_equals_sign(tod: Command, tmp_path: Path) -> None:
    path = write_drive(tmp_path / "rate=6000", ["vehicle"], seconds=3)
    assert tod("report", str(path), f"output={tmp_path / 'out'}").status == 0


def test_a_verb_without_positional_arguments_refuses_them(tod: Command) -> None:
    assert tod("print", "drive").err == "command line: drive: must be NAME=VALUE\n"


@pytest.mark.usefixtures("unprinted")
def test_without_its_libraries(tmp_path: Path, drive: Path, monkeypatch: pytest.MonkeyPatch, tod: Command) -> None:
    real = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "matplotlib" else real(name))
    status, out, err = tod("report", str(drive), f"output={tmp_path / 'out'}")
    assert (status, out) == (1, "")
    assert err == "the Python module matplotlib is not installed: install the extra report, see docs/install.md\n"


def test_charts_of_many_drives_have_letters_of_their_own(drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runner.drive.print.ascii_lowercase", "a")
    sheet = drawn(defined(drive)["bitrates"])
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in sheet.axes]
    assert [title.split()[0] for title in titles if title.startswith("(")] == ["(a)", "(aa)"]


def test_progress_is_shown_on_standard_error(made: Report) -> None:
    assert "figures: 100%" in made.result.err
