"""What the receivers of all cameras have received together, by uplink."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain

from runner.gst.receiver import Receiver
from runner.records.reception import Arrivals, UplinkArrivals


def take_arrivals(receivers: Mapping[str, Receiver]) -> dict[str, Arrivals]:
    """Since the last call, by uplink; "" if the vehicle has one. From one thread."""
    counted = [receiver.rtp.take_counts() for receiver in receivers.values()]
    together = Arrivals(
        frames={name: receiver.rtp.take_arrivals() for name, receiver in receivers.items()},
        newest={name: receiver.newest for name, receiver in receivers.items() if receiver.newest},
        packets=sum(received for received, _ in counted),
        lost=sum(lost for _, lost in counted),
        damaged=[name for name, receiver in receivers.items() if receiver.is_damaged],
        arrived=list(chain.from_iterable(receiver.rtp.take_packets() for receiver in receivers.values())),
    )
    split: dict[str, dict[str, UplinkArrivals]] = {}
    for camera, receiver in receivers.items():
        for uplink, own in (receiver.rtp.uplinks.take() if receiver.rtp.uplinks else {}).items():
            split.setdefault(uplink, {})[camera] = own
    if all(receiver.rtp.uplinks is None for receiver in receivers.values()):
        return {"": together}
    return {uplink: together.of(cameras) for uplink, cameras in split.items()}
