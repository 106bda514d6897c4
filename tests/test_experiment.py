"""Experiments and limited links as configuration: their choices, their errors, the rate of the link."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import Command, UserConf

from runner.configuration.compose import compose
from runner.configuration.config import configuration
from runner.configuration.experiment import LinkSettings
from runner.configuration.files import options
from runner.errors import ConfigError
from runner.resources import directory

HEAD = "# @package _global_\n"
NARROW = (
    "vehicle=delivery_robot",
    "graph=h264_rtsp",
    "source=test",
    "study=paper",
    "recording=x264",
)  # few files are enough
TAIL = "experiment: {about: x, duration_s: 5}\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("bottleneck", "driving_test") else pytest.mark.soak)
        for name in options("experiment", [directory("conf")])
    ],  # `validate all=true` in test_validate.py composes all of them
)
def test_every_packaged_experiment_and_each_of_its_runs_can_be_driven(name: str) -> None:
    config = configuration([f"experiment={name}"], runnable=False)
    experiment, link = config.experiment(), config.link()
    assert (link is not None) == (name in ("bottleneck", "loss", "rfc8867", "two_uplinks", "wrong_prediction"))
    for words in ((), *experiment.runs.values()):
        run = configuration([f"experiment={name}", *words], runnable=False)
        own = [word for word in words if word.startswith("experiment.duration_s=")]
        assert run.experiment().duration_s == float(own[0].partition("=")[2] if own else experiment.duration_s)
        assert (run.link() is not None) == (link is not None)
        run.pqos()


@pytest.mark.parametrize(
    "words", [["pqos=live"], ["pqos=map", "pqos.position={kind: live}"], ["pqos=map", "~pqos.position"]]
)
def test_a_link_without_a_rate_is_a_problem(words: list[str]) -> None:
    """It would pass nothing, without a word."""
    with pytest.raises(ConfigError, match="file: must be given: live predictions give no rate"):
        configuration([*words, "link=relay"], runnable=False).link()


PAUSE = "{at_s: 9, request: {event: camera_switched, camera: rear_center, on: false}}"


def test_requests_are_sorted_by_time() -> None:
    early = "{at_s: 2.5, request: {event: mode_selected, mode: collective}}"
    requests = configuration(
        ["experiment=driving_test", f"+experiment.requests=[{PAUSE}, {early}]"], runnable=False
    ).experiment()
    assert [(request.at_s, request.event["event"]) for request in requests.requests] == [
        (2.5, "mode_selected"),
        (9, "camera_switched"),
    ]


@pytest.mark.slow
def test_a_request_that_is_not_an_event_is_a_problem(tod: Command) -> None:
    wrong = PAUSE.replace("rear_center, on: false", "rear_center")
    result = tod("validate", "experiment=driving_test", f"+experiment.requests=[{wrong}]")
    assert result.status == 2
    assert "on: missing" in result.err
    result = tod("validate", "experiment=driving_test", f"+experiment.requests=[{PAUSE.replace('rear_c', 'raer_c')}]")
    assert result.status == 2
    assert "raer_center: unknown camera, did you mean rear_center?" in result.err


def test_the_command_line_takes_precedence() -> None:
    chosen = compose(["experiment=driving_test"]).document
    assert chosen["modes"] == compose(["modes=paper"]).document["modes"]
    assert chosen["pqos"]["file"] == "maps/driving_test.csv"
    other = compose(
        ["experiment=driving_test", "modes=safe", "pqos.file=maps/demo_loop.csv", "experiment.duration_s=7"]
    )
    assert other.document["modes"] == compose(["modes=safe"]).document["modes"]
    assert (other.document["pqos"]["file"], other.document["experiment"]["duration_s"]) == ("maps/demo_loop.csv", 7)


def limited(*words: str) -> LinkSettings:
    link = configuration(words, runnable=False).link()
    assert link is not None
    return link


def test_a_link_follows_the_map_without_looking_ahead_or_a_trace_of_its_own(tmp_path: Path) -> None:
    link = limited("experiment=driving_test", "link=relay", "link.share=2")
    assert link.kind == "relay"
    rates = [link.limit.kbps_at(t / 10) / 2 for t in range(1000)]
    assert min(rates) == 3030 and max(rates) < 8000
    assert rates[120] > 4000  # while the prediction, which looks ahead, is already in the dip
    trace = tmp_path / "uplink.csv"
    trace.write_text("t_s,uplink_kbps\n0,1000\n1,2000\n")
    link = limited("link=netns", f"link.file={trace}", "link.share=1.5")
    assert [link.limit.kbps_at(t) for t in (0, 0.9, 1, 2.5)] == [1500, 1500, 3000, 1500]
    link = limited("link=relay", "pqos=constant", "pqos.kbps=700", "link.share=1")
    assert [link.limit.kbps_at(t) for t in (0, 0.3, 50)] == [700, 700, 700]


@pytest.mark.parametrize(
    "text, expected",
    [
        (
            HEAD + "defaults: [_self_]\n" + TAIL + "pqos: {file: nowhere.csv}\n",
            "pqos.file: nowhere.csv: no such file in",
        ),
        (
            HEAD + "defaults: [{override /modes: papr}, _self_]\n" + TAIL,
            "defaults: 'modes/papr': no such file, did you",
        ),
        ("defaults: [{override /modes: paper}, _self_]\n" + TAIL, "must begin with the line # @package _global_"),
        (HEAD + "defaults: [_self_]\nexperiment: {about: x}\n", "experiment.duration_s: missing: must be given"),
        (
            HEAD + "defaults: [_self_]\nexperiment: {about: x, duration_s: 5, claims: driving_tst}\n",
            "experiment.claims: 'driving_tst': must be one of driving_test, null, did you mean driving_test?",
        ),
        (HEAD + "defaults: [_self_]\nfsp_max: 3\n" + TAIL, "fsp_max: unknown key, did you mean fps_max?"),
    ],
)
def test_mistakes_of_an_experiment_are_reported_for_its_file(
    tod: Command, conf: UserConf, text: str, expected: str
) -> None:
    path = conf.write("experiment/mine.yaml", text).path / "experiment/mine.yaml"
    result = tod("validate", conf.word, *NARROW)
    assert result.status == 2
    assert result.err.startswith(f"{path}: {expected}"), result.err


def test_a_run_that_cannot_be_composed_is_reported(tod: Command, conf: UserConf) -> None:
    runs = "experiment: {about: x, duration_s: 5, runs: {a: [modes=papr]}}\n"
    conf.write("experiment/mine.yaml", HEAD + "defaults: [_self_]\n" + runs)
    result = tod("validate", conf.word, *NARROW)
    assert result.status == 2
    path = conf.path / "experiment/mine.yaml"
    assert result.err.startswith(f"{path}: experiment.runs.a: modes=papr: no such file in conf/modes/ or ")
    assert "did you mean paper?" in result.err


def test_a_link_and_an_experiment_need_not_be_chosen() -> None:
    assert "link" not in compose(["experiment=bottleneck", "link=null"]).document
    assert "experiment" not in compose(["experiment=null"]).document


@pytest.mark.slow
def test_an_experiment_may_build_on_another(tod: Command, conf: UserConf) -> None:
    conf.write(
        "experiment/mine.yaml",
        HEAD + "defaults: [driving_test, _self_]\nlog: {video: true}\nlatency: {fixed_ms: 60}\ninsecure: true\n"
        "experiment: {about: x, duration_s: 9}\n",
    )
    result = tod("validate", conf.word, *NARROW)
    assert result.status == 0, result.err
    conf.write("experiment/mine.yaml", HEAD + "defaults: [bottleneck, _self_]\nmode: collective\n")
    assert "experiment: missing: must be given" not in tod("validate", conf.word, *NARROW).err
    conf.write(
        "experiment/mine.yaml",
        HEAD + "defaults: [_self_]\nexperiment: {about: x, duration_s: 9, runs: {a: [modes=papr]}}\n",
    )
    assert "did you mean paper?" in tod("validate", conf.word, *NARROW).err


def test_a_relay_supports_rtsp_only(tod: Command) -> None:
    result = tod("demo", "link=relay", "graph=h264_srt", "log=/nowhere")
    assert result.status == 2
    rule = "supports RTSP only; the graph of front_left has its own transport; choose link=netns"
    other = "see conf/graph/h264_srt.yaml: transport: 'pipeline'"
    assert result.problems == [f"conf/link/relay.yaml: kind: relay: {rule}; {other}"]


def test_the_reverse_direction_has_one_rate(tmp_path: Path) -> None:
    trace = tmp_path / "downlink.csv"
    trace.write_text("t_s,kbps\n0,500\n1,50\n")
    back = "link.reverse={{{}, queue_ms: 100, delay_ms: 5}}"
    limit = limited("link=netns", "link.loop=false", back.format(f"file: {trace}")).limit
    assert [limit.rates(t).down for t in (0, 0.9, 1, 90)] == [500, 500, 50, 50]
    assert limited("link=relay", back.format("kbps: 70")).limit.rates(3).down == 70
    with pytest.raises(ConfigError, match=r"reverse\.file: donwlink.csv: no such file"):
        limited("link=netns", back.format("file: donwlink.csv"))
    with pytest.raises(ConfigError, match=r"tcp\.bytes: .*: must be \[smallest, largest\]"):
        limited("link=netns", "link.tcp={flows: 1, bytes: [9, 3]}")
    with pytest.raises(ConfigError, match="choose link=netns"):
        limited("link=relay", "+link.tcp={flows: 1}")
    for words in ("kbps: null", f"kbps: 5, file: {trace}"):
        with pytest.raises(ConfigError, match="must give either kbps or file"):
            limited("link=relay", back.format(words))


def test_delays_over_time_add_to_the_constant_one(tmp_path: Path) -> None:
    one_way, both = tmp_path / "delay.csv", tmp_path / "rtt.csv"
    one_way.write_text("t_s,delay_ms\n0,10\n1,200\n")
    both.write_text("t_s,rtt_ms\n0,30\n0.5,50\n")
    back = f"link.reverse={{kbps: 70, queue_ms: 100, delay_ms: 5, delay_file: {both}}}"
    limit = limited("link=netns", "link.loop=false", "link.delay_ms=20", f"link.delay_file={one_way}", back).limit
    assert [limit.rates(t)[2:4] for t in (0, 0.5, 1, 9)] == [(30, 20), (30, 30), (220, 30), (220, 30)]
    assert limited("link=relay").limit.rates(0)[2:4] == (None, None)
    with pytest.raises(ConfigError, match=r"delay_file: .*: no column delay_ms: must be a header with the columns"):
        limited("link=relay", f"link.delay_file={_rates(tmp_path)}")


def test_lanes_differ_from_the_link_and_are_cut(tmp_path: Path) -> None:
    """The rate of a lane replaces the link's, in whatever form that is stated."""
    lanes = f"link.lanes={{a: {{file: {_rates(tmp_path)}}}, b: {{delay_ms: 60}}, c: {{kbps: 70, share: 1}}}}"
    silent, moves = "{lane: b, at_s: 3, for_s: 2, how: silence}", "{lane: b, at_s: 4, how: address}"
    words = ("pqos=live", "link.kbps=1000", "link.share=2", "link.delay_ms=5", "link.loop=false")
    link = limited("link=netns", lanes, f"link.cuts=[{silent}, {moves}]", *words)
    found = {name: [lane.rates(t)[0] for t in (0, 9)] for name, lane in link.lanes.items()}
    assert found == {"a": [1000, 100], "b": [2000, 2000], "c": [70, 70]}
    assert [lane.delay_ms for lane in link.lanes.values()] == [5, 60, 5]
    assert [link.lanes["b"].rates(t)[4:] for t in (2.9, 3, 4, 5)] == [
        (None, 0),
        ("silence", 0),
        ("silence", 1),
        (None, 1),
    ]
    assert link.lanes["a"].rates(3)[4:] == (None, 0)


def test_wrong_lanes_and_cuts_are_reported_together(tod: Command) -> None:
    down = "{lane: wwan1, at_s: 1, for_s: 2, how: down}"
    cuts = f"{down}, {{lane: b, at_s: 1, for_s: 2, how: hold}}, {{lane: b, at_s: 2.5, for_s: 1, how: down}}"
    more = "{lane: b, at_s: 5, how: silence}, {lane: b, at_s: 2, for_s: 3, how: address}"
    words = ("link=netns", "link.lanes={wwan0: {}, b: {kbps: 9, file: x.csv}}", f"link.cuts=[{cuts}, {more}]")
    assert tod("demo", *words, "log=/nowhere").problems == [
        "command line: link.lanes.b.kbps: 9: must not be given beside file",
    ]
    words = ("link=netns", "link.lanes={wwan0: {}, b: {}}", f"link.cuts=[{cuts}, {more}]")
    assert tod("demo", *words, "log=/nowhere").problems == [
        "command line: link.cuts[0].lane: wwan1: unknown lane, did you mean wwan0?",
        "command line: link.cuts[3].for_s: must be given: how long it lasts, s",
        "command line: link.cuts[4].for_s: 3: must not be given: the address changes for good",
        "command line: link.cuts[2]: from 2.5 to 3.5 s: must not overlap cuts[1] of the same lane, from 1 to 3 s",
    ]
    name = "must be a name for a network device: at most 15 letters, digits, _, - and ., and not lo, all or default"
    found = tod("demo", "link=netns", "link.lanes={abcdefghijklmnop: {}, lo: {}}", "log=/nowhere").problems
    assert found == [f"command line: link.lanes: '{each}': {name}" for each in ("abcdefghijklmnop", "lo")]
    many = ", ".join(f"l{n}: {{}}" for n in range(13))
    (found,) = tod(
        "demo", "link=netns", f"link.lanes={{{many}}}", "link.cuts=[{lane: l0, at_s: 1, how: address}]"
    ).problems
    assert found.endswith("need 14 addresses, one each and one for each change: must be at most 13")
    rule = (
        "must be silence or hold: link=relay has no devices; choose link=netns; see conf/link/relay.yaml: kind: 'relay'"
    )
    relayed = ("link=relay", "link.lanes={b: {}}", "link.cuts=[{lane: b, at_s: 1, for_s: 2, how: down}]")
    assert tod("demo", *relayed).problems == [f"command line: link.cuts[0].how: down: {rule}"]
    assert (
        "link.lanes: a: must be null without uplinks: nothing would use but the first lane"
        in tod("simulate", "link=netns", "link.lanes={a: {}}").err
    )


def _rates(tmp_path: Path) -> Path:
    path = tmp_path / "rates.csv"
    path.write_text("t_s,kbps\n0,500\n1,50\n")
    return path


def test_a_link_needs_a_log_of_its_effect(tod: Command) -> None:
    result = tod("demo", "link=relay", "source=test")
    assert result.status == 2
    rule = "needs a log to show its effect: give log=DIR or output=OUT"
    assert result.err == f"command line: link: relay: {rule}\n"


def test_the_demo_does_not_write_into_a_directory_with_other_files(tod: Command, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    result = tod("demo", "source=test", f"output={tmp_path}")
    rule = "must be a new or empty directory, but contains thesis.tex"
    assert (result.status, result.err) == (2, f"command line: output: '{tmp_path}': {rule}\n")
