"""The runs of a joint fit as the core asks for them: sampled on a grid, as records, as they were read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.data.run import Run
from ftlm.fit.clock import spans
from ftlm.fit.grid import experiment
from ftlm.fit.problem import FreeProblem
from ftlm.solve.records import record


@dataclass(frozen=True)
class Asked:
    """A problem's runs; questions come on the thread that called the core."""

    problem: FreeProblem
    runs: Sequence[Run]

    def sampled(self, every: int, decimation: int, first: int | None) -> list[Any]:
        """The runs with so many pulses a sample interval, of every so many samples one, or their first intervals."""
        weights = [1.0] * len(self.problem.structure.outputs)
        runs = self.runs if first is None else [run.slice(None, (first + 0.5) * run.step) for run in self.runs]
        return [experiment(run, self.problem, weights, every=every, decimation=decimation) for run in runs]

    def records(self, m: int, inputs: Sequence[float]) -> list[Any]:
        """Records of so many pulses, driven by what was measured, inputs acting with these numbers."""
        names = (item.name for item in self.problem.inputs)
        structure = self.problem.structure.with_inputs(dict(zip(names, inputs, strict=True)))
        structure = replace(structure, coupling="measured")
        return [record(run, structure, m).core() for run in self.runs]

    def read(self, signal: int) -> list[Floats]:
        """A signal of each run at regular times; NaN where it was not read."""
        name = self.problem.structure.signals[signal]
        return [np.ascontiguousarray(run[name]) for run in self.runs]

    def core(self, told: Callable[[int, int], None] | None = None) -> tuple[Any, ...]:
        """The runs as the core takes them, and who is told how far it is."""

        def between(name: str) -> str | None:
            if name not in self.runs[0].inputs:
                return None
            return "zoh" if any(run.intersample.get(name) == "zoh" for run in self.runs) else "foh"

        return self, spans(self.runs), [between(name) for name in self.problem.structure.signals], told
