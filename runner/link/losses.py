"""Which packets are lost. Pure."""

from __future__ import annotations

import random


class LossModel:
    """Decides which packets are lost: Gilbert's two-state model (Bell System Technical Journal, 1960).

    loss   share of all packets
    burst  mean number lost in a row; 1: each independently
    """

    def __init__(self, loss: float, burst: float, seed: int = 1) -> None:
        self._end_probability = min(1 / burst, 1 - loss)  # bursts may follow each other by chance
        self._start_probability = 1.0 if loss >= 1 else loss * self._end_probability / (1 - loss)
        self._random = random.Random(seed)  # the same losses in every run
        self._losing = False

    def draw(self) -> bool:
        """Draw whether the next packet is lost."""
        if self._start_probability:
            change = self._end_probability if self._losing else self._start_probability
            self._losing ^= self._random.random() < change
        return self._losing
