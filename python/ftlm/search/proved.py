"""What a certificate over all orders says."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class OrderCertificate:
    """What is proved of the equation errors of all orders in some intervals.

    Parameters
    ----------
    at_least
        No orders of the intervals leave a smaller RMS equation error, with any coefficients whose terms are not beyond
        `largest`, in exact arithmetic on the pulse means; 0 where nothing is proved.
    best
        The smallest that was found on the way, infinite where none was.
    orders
        Where that is: free orders by name.
    asked
        How much better than that other orders might have been, as a share.
    intervals
        Lowest and highest value of each free order.
    apart
        How far orders of the output stay below its highest one, and orders of one signal from one another.
    largest
        How many times the RMS size of the output those of an equation's terms have together at most.
    cells
        Boxes of orders that were bounded.
    open
        Those of them whose bound is lower than was asked for, too small to be halved or one too many.
    m
        Block pulses a run.
    """

    at_least: float
    best: float
    orders: dict[str, float]
    asked: float
    intervals: dict[str, tuple[float, float]]
    apart: float
    largest: float
    cells: int
    open: int
    m: int

    @property
    def within(self) -> float:
        """By what share of the best found other orders may be better: 1 where nothing is proved."""
        return max(0.0, 1 - self.at_least / self.best)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "at_least": self.at_least,
            "best": self.best if self.orders else None,
            "within": self.within,
            "asked": self.asked,
            "orders": self.orders,
            "intervals": {name: list(interval) for name, interval in self.intervals.items()},
            "apart": self.apart,
            "largest": self.largest,
            "cells": self.cells,
            "open": self.open,
            "m": self.m,
        }

    def __str__(self) -> str:
        intervals = ", ".join(f"{n} from {low:g} to {high:g}" for n, (low, high) in self.intervals.items())
        apart = f"orders of the output {self.apart:g} below its highest, of one signal {self.apart:g} apart"
        found = ", ".join(f"{name} {value:.5g}" for name, value in self.orders.items())
        cells = f"{self.cells} boxes of orders"
        if self.at_least == 0:
            return (
                f"certificate: nothing is proved of all orders with {intervals} ({apart}): {self.open} of {cells} are "
                "left; narrow the intervals, keep orders farther apart, or allow more boxes"
            )
        # Rounded up: a share that is said must be true.
        share = math.ceil(1000 * self.within - 1e-4) / 10
        text = (
            f"certificate: no orders with {intervals} ({apart}), on a lattice or between, leave an RMS equation error "
            f"below {self.at_least:.5g} with coefficients whose terms are together at most {self.largest:g} times the "
            f"output; {found} leave {self.best:.5g}, so nothing is better by more than {share:g} % ({cells})"
        )
        if self.open:
            text += f"; {100 * self.asked:g} % was asked for, and {self.open} boxes were too small to halve or too many"
        return text
