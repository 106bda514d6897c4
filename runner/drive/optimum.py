"""What a static allocation could have reached on the screen, by the cameras' own rate-quality models. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from math import inf

from runner.core.hull import Contender, best_shares
from runner.core.model import Camera
from runner.core.rules.seen import DETAIL, displayed_curve
from runner.core.view import View
from runner.drive.seen_file import Optimum
from runner.drive.views import seen_of


def static_optimum(cameras: Mapping[str, Camera], view: View, kbps: float) -> Optimum | None:
    """The shares of a total that look best in a view, all the time: each camera sends just what is seen.

    kbps     the total
    returns  None: a camera that is seen has no measured quality, or that is no MSSIM
    """
    contenders: dict[str, Contender] = {}
    for name, camera in cameras.items():
        seen = seen_of(view, camera)
        if seen.is_empty or not seen.scale:
            continue
        curve = displayed_curve(camera, seen.roi, min(Fraction(1), seen.scale), float(DETAIL))
        if curve is None or curve.quality[-1] > 1:
            return None
        contenders[name] = Contender(curve, seen.screen_width * seen.screen_height, 0.0, inf)
    if not contenders:
        return None
    shares, _ = best_shares(list(contenders.values()), kbps)
    found = {name: one.curve.at(share) for (name, one), share in zip(contenders.items(), shares, strict=True)}
    px = {name: one.weight for name, one in contenders.items()}
    return Optimum(round(kbps, 1), sum(px[n] * q for n, q in found.items()) / sum(px.values()), found)
