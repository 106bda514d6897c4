"""usage: tod-runner simulate [OVERRIDE ...] [links=LINK,...] [predictions=KIND,...] [seeds=1] [windows=6]
                           [duration_s=60] [since_s=3] [output=FILE.json] [figure=FILE.png] [log=DIR] [workers=N]
                           [control=true] [encoder_error=0.03] [late_ms=2] [report_jitter_ms=0] [report_loss=0]
                           [bursts=true] [slot_ms=0] [credit_ms=0] [peak=3] [grant_ms=0]

Simulates drives over links, under predictions that are right or wrong, and prints a table of what they show. Cameras,
encoders, link, repair and reports are models; the rules are those of the vehicle, with the modes file in force. Nothing
is encoded and nobody waits: one core simulates a minute with eight cameras in about a second. All cores are used.

links= names the links: synthetic (all that are generated: gauss_0.2_5, gauss_0.5_5, gauss_0.5_1, gauss_0.3_0.3, markov,
step, ramp, outage, saw), left_out (handover, shared: no number of any rule was chosen by them), a CSV file as
link.file, a file of mahimahi with opportunities to send (.up, .pps), the directory of a drive over a limited link, or
configured: the link of the configuration, and the runs of its experiment. Several uplinks have a link each, as in
one.csv+markov. Of a file or a drive at most windows= parts of duration_s are driven; each drive counts from since_s on.
seeds= is their number, or FIRST-LAST.
Everything else about the link is that of link=: link.queue_ms, link.delay_ms, link.delay_file, link.loss,
link.loss_burst, link.policer, link.tcp, link.reverse, link.share. Without link= it has a queue of 300 ms and 15 ms each
way.

predictions= are all, or some of right, low_30, low_50, high_30, high_50, noise, late_1, late_2, early_2, absent, mixed
(which changes its character), configured (those of pqos=).

output= has the figures of each drive; figure= draws each drive: total, capacity, prediction and queue. With log= the
drives are logged like real ones, for `report` and `replay`: DIR is the drive, or has one directory for each of several.

encoder_error is the deviation (ln) of an encoder's rate over a second; late_ms by how much a frame is sent later than
the earliest on average, 20 or more on a busy machine; report_loss the share of reports that are lost. slot_ms: packets
are delivered at the ends of slots. bursts=false: an idle link passes nothing at once. credit_ms: what an idle link
saves, to serve peak= times as fast; grant_ms: what the first packet then waits. control=false leaves out what the
control link sends.

  tod-runner simulate fps_max=15                                     all links and predictions, a minute or two
  tod-runner simulate links=saw,markov predictions=right,absent seeds=3 modes=steady
  tod-runner simulate links=uplink.csv predictions=absent link=netns link.share=1 link.loss=0.01 log=drive
  tod-runner simulate experiment=rfc8867                             its runs, with their links and predictions
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from math import isfinite
from statistics import fmean
from typing import TYPE_CHECKING

from runner.drive.log import FILES, check_free
from runner.system.files import write_whole
from runner.verbs import Arguments, simulated
from runner.verbs.simulated import Place, row

if TYPE_CHECKING:
    from runner.simulation.runs import Job, Result


def run(arguments: Arguments) -> int:
    from runner.simulation.runs import check, jobs

    common = simulated.common(arguments)
    links, kinds = simulated.links(arguments), simulated.predictions(arguments)
    wanted = jobs(common, links, kinds, simulated.seeds(arguments), simulated.windows(arguments))
    check(common, wanted)
    figure, places, workers = simulated.figure(arguments), _places(arguments, wanted), simulated.workers(arguments)
    results = list(simulated.run_all(common, wanted, places, workers, keep=figure is not None))
    print("\n".join(_table(results)))
    if output := arguments.path("output"):
        write_whole(output, json.dumps([one.to_json() for one in results], indent=1).encode())
    if figure:
        from runner.simulation.picture import draw

        draw(results, figure)
    return 0


def _places(arguments: Arguments, wanted: Sequence[Job]) -> list[Place | None]:
    """Where each drive is logged, if it is.

    raises  UserError if a directory holds a drive
    """
    directory, began = arguments.path("log"), float(int(time.time()))
    if directory is None:
        return [None] * len(wanted)
    places = [directory / job.name if len(wanted) > 1 else directory for job in wanted]
    for place in places:
        for side in FILES:
            check_free(place, side)
    return [(place, began) for place in places]


def _table(results: Sequence[Result]) -> Iterator[str]:
    """A row for each link and prediction, means over windows and seeds."""
    from runner.simulation.figures import FIGURES

    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.job.link_name, result.job.prediction), []).append(result)
    left_out = [] if any(one.figures["tcp"] for one in results) else ["tcp"]
    left_out += [] if any(one.uplinks > 1 for one in results) else ["camera"]
    shown = [key for key in FIGURES if key not in left_out]
    yield row("link", "prediction", "drives", *(FIGURES[key][0] for key in shown))
    yield row(*["---"] * (len(shown) + 3))
    for (link, kind), some in groups.items():
        means = (_mean([one.figures[key] for one in some], FIGURES[key][1]) for key in shown)
        yield row(link, kind, str(len(some)), *means)


def _mean(values: Sequence[float], digits: int) -> str:
    known = [value for value in values if isfinite(value)]
    return f"{fmean(known):.{digits}f}" if known else "-"
