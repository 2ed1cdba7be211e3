"""What a recomputed section 5 consists of: stages, what verdicts are made of, printed models run, both readings."""

from __future__ import annotations

from dataclasses import dataclass, field

from ftlm.data.lattice import Lattice
from ftlm.data.run import Run
from ftlm.fit.recursion import Trace
from ftlm.paper.arm import truth_of
from ftlm.paper.asprinted import AsPrinted
from ftlm.paper.panel import Panel
from ftlm.paper.ran import Ran
from ftlm.paper.records import Rival, Stage


@dataclass(frozen=True)
class Recomputed:
    """Both stages and the runs; its fields are those of :class:`ftlm.Reproduction`."""

    square: Run
    sine: Run | None
    simulated: bool
    stages: dict[int, Stage]
    lattice: Lattice
    notes: tuple[str, ...] = field(default=())
    panel: Panel = field(default_factory=Panel)
    ran: tuple[Ran, ...] = ()
    as_printed: dict[str, AsPrinted] = field(default_factory=dict)

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """Orders and coefficients of the simulated arm by stage; empty for measured runs."""
        return {n: truth_of(n) for n in self.stages} if self.simulated else {}

    @property
    def runs(self) -> list[Run]:
        """The square run, and the sine run if there is one."""
        return [self.square] if self.sine is None else [self.square, self.sine]

    @property
    def angles(self) -> list[tuple[Stage, str]]:
        """Every stage with each of its outputs."""
        return [(stage, output) for stage in self.stages.values() for output in stage.outputs]

    @property
    def rivals(self) -> dict[str, Rival]:
        """The genetic comparisons of all stages by output."""
        return {output: rival for stage in self.stages.values() for output, rival in stage.rivals.items()}

    @property
    def traces(self) -> dict[str, dict[int, Trace]]:
        """Convergence of all stages by output and p."""
        return {output: each for stage in self.stages.values() for output, each in stage.traces.items()}

    @property
    def weak_traces(self) -> dict[str, dict[int, Trace]]:
        """The same with the weak prior."""
        return {output: each for stage in self.stages.values() for output, each in stage.weak_traces.items()}
