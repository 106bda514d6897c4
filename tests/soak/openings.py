"""Players that open cameras in every state, over TCP and UDP, while a watched camera loses no frame."""

from __future__ import annotations

import random
import time

from system import Watched, flowing, newest, player, running

from rig import free_port, until

STATES = ("sending", "switched off", "paused")
EVERY = 8  # openings between two checks of the watched camera


def soak(seed: int, scale: float) -> list[str]:
    """rear is in one of the states, mast is an IP camera that delivers nothing; front is watched."""
    rng, problems = random.Random(seed), []
    dead = f'cameras.mast.source.address="rtsp://127.0.0.1:{free_port()}/none"'
    with running("+source@cameras.mast.source=rtsp", dead, complete=False) as (system, operator):
        until(lambda: flowing(operator, ("front", "rear")), every_s=0.1)
        watched = Watched(system, operator)
        for number in range(max(EVERY, round(64 * scale))):
            state, transport = rng.choice(STATES), rng.choice(("tcp", "udp"))
            camera, seconds = rng.choice(("rear", "rear", "rear", "mast")), rng.uniform(0.3, 3)
            operator.ask(f"on{number}", event="camera_switched", camera="rear", on=state != "switched off")
            operator.ask(f"weight{number}", event="weights_set", weights={"rear": 0 if state == "paused" else 1})
            with player(system, camera, transport):
                time.sleep(seconds)
            print(f"{number:3} {camera} {state:12} {transport} {seconds:.1f} s", flush=True)
            if number % EVERY == EVERY - 1:
                problems += watched.problems()
        operator.ask("last", event="camera_switched", camera="rear", on=True)
        operator.ask("last weight", event="weights_set", weights={"rear": 1})
        opened = Watched(system, operator, "rear")
        time.sleep(1)
        problems += opened.problems()  # its picture has returned, too
        assert newest(operator)["online"]
        problems += system.tracebacks()
    return problems
