"""The lines that `print` shows run unchanged, and the streams play in third-party clients."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess

import pytest

from rig import CLIPS, free_port, run, streaming, until

GRAPHS = ["h264_rtsp", "openh264_rtsp", "h264_srt"]


def printed(tod, *words):
    done = tod("print", "format=json", "total_kbps=6000", *words)
    assert done.status == 0, done.err
    return json.loads(done.out)["cameras"]


def start(line):
    return subprocess.Popen(
        ["sh", "-c", f"exec gst-launch-1.0 -v {line}"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def end(process):
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=20)
    return output


@pytest.mark.parametrize("graph", GRAPHS)
def test_a_printed_pair_of_lines_sends_and_shows_the_decided_size(tod, graph):
    camera = printed(
        tod, "source=test", f"graph={graph}", f"graph.first_port={free_port(3)}", "vehicle=delivery_robot"
    )["rear"]
    operator = start(camera["operator"])
    until(lambda: "PLAYING" in operator.stdout.readline())  # it needs the first picture, with the parameter sets
    vehicle = start(camera["vehicle"])
    size = f"width=(int){camera['decision']['width']}, height=(int){camera['decision']['height']}"
    try:
        until(lambda: "sink.GstPad:sink: caps" in (line := operator.stdout.readline()) and size in line)
    finally:
        end(operator)
        end(vehicle)


@pytest.mark.parametrize("source", [pytest.param("test", marks=pytest.mark.soak), "appsrc", "synthetic"])
def test_every_line_of_the_paper_s_vehicle_runs(source, tmp_path):
    """Also with a stand-in: for frames generated in Python, and for a drive that is not rendered."""
    done = run("print", "format=json", f"source={source}", env={"XDG_CACHE_HOME": str(tmp_path)})
    cameras = json.loads(done.stdout)["cameras"]
    assert ("stands in" in done.stderr) == (source != "test")
    processes = [start(camera["vehicle"]) for camera in cameras.values()]
    for process in processes:
        until(lambda process=process: "PLAYING" in process.stdout.readline())
    for process in processes:
        assert "ERROR" not in end(process)


def test_a_clip_with_blanks_in_its_path_plays(tod, tmp_path):
    clip = tmp_path / "it's a clip.mp4"
    if CLIPS:
        shutil.copy(CLIPS[2], clip)
    else:
        line = "videotestsrc num-buffers=50 ! x264enc ! mp4mux ! filesink location=clip.mp4"
        subprocess.run(["gst-launch-1.0", "-q", *line.split()], cwd=tmp_path, check=True)
        (tmp_path / "clip.mp4").rename(clip)
    camera = printed(tod, "source=file", f'source.clip="{clip}"', "vehicle=delivery_robot")["rear"]
    process = start(camera["vehicle"])
    until(lambda: "PLAYING" in process.stdout.readline())
    assert "ERROR" not in end(process)


@pytest.mark.parametrize("transport", ["tcp", "udp"])
@pytest.mark.parametrize("retransmission_ms", [pytest.param(0, marks=pytest.mark.soak), 200])
def test_a_third_party_client_plays_the_stream(transport, retransmission_ms):
    words = ("vehicle=delivery_robot", f"graph.retransmission_ms={retransmission_ms}")
    with streaming(*words, cameras=("rear",)) as (_, setup, _, _reported):
        url = f"rtsp://127.0.0.1:{setup.media.port}/rear"
        command = ["ffmpeg", "-v", "error", "-rtsp_transport", transport, "-i", url, "-frames:v", "30"]
        picture = ["-f", "rawvideo", "-pix_fmt", "gray", "-"]
        done = subprocess.run([*command, *picture], capture_output=True, timeout=60, check=True)
        assert len(done.stdout) == 30 * 848 * 480
