"""Everything here needs GStreamer, and most of it depends on real time.

`pytest -m "not gst"` leaves out the tests that need GStreamer. `make test` runs those marked `alone`, whose limits are
tight, at most two drives and one other test at a time, then those marked `timed`, a few files at a time. All others
run on the processor time that these leave over.
"""

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ros_domain import running

from rig import BROWSER, CHROMIUM_FLAGS, free_port
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

UNTIMED = ("test_keyframe", "test_model", "test_report_page")

# Started first, in this order, so that no worker is left with a long file at the end: those of more than 20 s.
LONGEST = (
    "test_feedback",
    "test_who_drives",
    "test_page_layouts",
    "test_server",
    "test_two_uplinks",
    "test_docs",
    "test_secure",
    "test_page",
    "test_ip_camera",
    "test_page_sides",
    "test_control",
    "test_handover",
    "test_fleet",
    "test_live",
    "test_link",
    "test_video_files",
    "test_contract",
    "test_deployment",
    "test_receiver",
    "test_drive_in_step",
    "test_latency",
    "test_record",
    "test_embedded",
    "test_ends",
    "test_watchers",
    "test_bag_source",
    "test_loss",
    "test_slow_cameras",
    "test_apply",
    "test_link_lanes",
    "test_quality",
)

# Files of drives among the tests marked `alone`, in two groups: the tests of a group run one after the other.
DRIVES = {
    "test_link": "1",
    "test_live": "1",
    "test_page_rate": "1",
    "test_players": "1",
    "test_feedback": "2",
    "test_page_sides": "2",
    "test_transports": "2",
}


@pytest.fixture(scope="session", autouse=True)
def patient_server() -> Iterator[None]:
    """In this process a camera may take long to open: otherwise 503 on a busy machine, after which few tests retry.

    How long it really takes is tested where cameras are opened in any state, see test_server.py.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("runner.gst.opening.OPEN_S", 5.0)
        yield


@pytest.fixture(scope="session", autouse=True)
def hangups() -> Iterator[None]:
    """Processes that tests start inherit what SIGHUP does: the default, also if nohup started the tests."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    if config.getvalue("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByGroup(LoadScopeScheduling):
        # xdist's own loadgroup appends groups to node ids, which pytest 9 ignores.
        def _split_scope(self, nodeid: str) -> str:
            return DRIVES.get(Path(nodeid.partition("::")[0]).stem, nodeid)

    return ByGroup(config, log)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """To import files none of whose tests is wanted would take each worker seconds."""
    is_wanted = "not timed and not alone" not in config.option.markexpr or collection_path.stem in UNTIMED
    return True if collection_path.match("test_*.py") and not is_wanted else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(LONGEST)))


def pytest_itemcollected(item: pytest.Item) -> None:
    item.add_marker("gst")
    if item.path.stem not in UNTIMED and not item.get_closest_marker("alone"):
        item.add_marker("timed")
    if "chromium" in getattr(item, "fixturenames", ()):
        item.add_marker("browser")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser; its pages are opened by `browser.opened`."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=BROWSER, args=CHROMIUM_FLAGS)
        yield started
        started.close()


@pytest.fixture
def broker() -> Iterator[Endpoint]:
    """Address of the test's own broker."""
    endpoint = Endpoint("127.0.0.1", free_port())
    with private_broker(endpoint):
        yield endpoint


@pytest.fixture(params=[2, 1], ids=["ros2", "ros1"])
def ros(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    """Each version of ROS that is installed here; see ros_domain.py."""
    with running(request.param, tmp_path) as version:
        yield version


@pytest.fixture
def ros1(tmp_path: Path) -> Iterator[Any]:
    with running(1, tmp_path) as version:
        yield version


@pytest.fixture
def ros2(tmp_path: Path) -> Iterator[Any]:
    with running(2, tmp_path) as version:
        yield version
