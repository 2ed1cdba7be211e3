"""The main job from end to end on simulated runs of both stages: identify, compare, tabulate, draw, save."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ftlm.arm.link import flexible_link, link_model
from ftlm.base.output import check_folder
from ftlm.data.equations import Equation
from ftlm.data.lattice import Lattice
from ftlm.data.run import Run
from ftlm.fit.recursion import Trace, multi_innovation_trace
from ftlm.identification.identify import identify
from ftlm.identification.result import Identification
from ftlm.judge.comparison import compare
from ftlm.judge.metrics import Metrics, metrics
from ftlm.model.model import Model
from ftlm.paper.arm import PLANTS, demo_run
from ftlm.solve.free_run import explicit_euler

#: Innovation lengths of the paper's Tables 4 and 5.
INNOVATION_LENGTHS = (1, 3, 5, 7)
#: Steps between two points of a convergence curve: 128 points are more than a page shows.
TRACE_EVERY = 16


@dataclass(frozen=True)
class StageRow:
    """One row of a table in the shape of the paper's Tables 4 and 5, for one output.

    Parameters
    ----------
    label
        Which model.
    output
        Which equation.
    orders, coefficients
        By name; an integer-order model without the term has none.
    equation_error, output_error
        On the run that the model was identified from.
    validation
        Output error on the other run.
    """

    label: str
    output: str
    orders: Mapping[str, float]
    coefficients: Mapping[str, float]
    equation_error: Metrics
    output_error: Metrics
    validation: Metrics


@dataclass(frozen=True)
class Demo:
    """Everything the demonstration made.

    Parameters
    ----------
    square, sine
        The runs.
    rows
        Table rows by stage.
    results
        Identifications by stage and label.
    traces
        Convergence by output and p.
    files
        What was written.
    """

    square: Run
    sine: Run
    rows: dict[int, list[StageRow]]
    results: dict[int, dict[str, Identification]]
    traces: dict[str, dict[int, Trace]]
    files: list[Path]

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """Orders and free coefficients of the simulated arm, by stage."""
        return {
            stage: {**orders, **{(f"r{stage}" if n == "r" else n): v for n, v in free.items()}}
            for stage, (orders, free) in PLANTS.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "rows": {
                str(stage): [
                    {
                        "model": r.label,
                        "output": r.output,
                        "orders": dict(r.orders),
                        "coefficients": dict(r.coefficients),
                        "equation_error": r.equation_error.to_dict(),
                        "output_error": r.output_error.to_dict(),
                        "validation": r.validation.to_dict(),
                    }
                    for r in rows
                ]
                for stage, rows in self.rows.items()
            },
            "warnings": {
                f"stage {stage}, {label}": list(result.warnings)
                for stage, results in self.results.items()
                for label, result in results.items()
            },
            "files": [str(f) for f in self.files],
        }


def integer_rows(stage: int, square: Run, sine: Run) -> list[StageRow]:
    """The maker's integer-order model, stepped by explicit Euler at the run's step, as the paper's first rows."""
    model = link_model(stage=1 if stage == 1 else 2)
    on_square = compare(replace_coupling(model), square)
    responses = {run.name: explicit_euler(model, run) for run in (square, sine)}
    rows = []
    for item in model.equations:
        name = item.output
        figures = {run.name: metrics(run[name], responses[run.name][name]) for run in (square, sine)}
        rows.append(
            StageRow(
                "integer order", name, *numbers_of(item),
                on_square.equation_error[name], figures["square"], figures["sine"],
            )
        )  # fmt: skip
    return rows


def numbers_of(item: Equation) -> tuple[dict[str, float], dict[str, float]]:
    """Orders and coefficients of an identified equation of the arm, by the paper's names."""
    coefficients = {t.name: float(t.coefficient) for t in item.terms if t.name is not None}
    index = next(iter(coefficients))[1:]
    greek = {"a": "beta", "b": "gamma", "d": "mu"}
    orders = {f"alpha{index}": item.order.constant}
    orders |= {greek[t.name[0]] + index: t.order.constant for t in item.terms if t.name and t.name[0] in greek}
    return orders, coefficients


def replace_coupling(model: Model) -> Model:
    """The model with each equation driven by the measured other output."""
    return replace(model, structure=replace(model.structure, coupling="measured"))


def run_demo(
    folder: Path,
    *,
    step: float = 0.1,
    noise: float = 1e-4,
    seed: int = 1,
    threads: int | None = None,
    force: bool = False,
    say: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] | None = None,
) -> Demo:
    """Simulate, identify every equation with p = 1, 3, 5, 7, by least squares and by output error, compare, save.

    Parameters
    ----------
    folder
        Where runs and models go; made if it is not there.
    step
        Step of the order lattice; the paper's is 0.05, which takes minutes.
    noise, seed
        See :func:`demo_run`.
    threads, progress
        See :func:`ftlm.search_orders`.
    force
        Whether to overwrite.
    say
        Called with a line about what happens next.

    Returns
    -------
    Demo
        Tables and files.

    Raises
    ------
    DataError
        A file is there already and ``force`` is not set, or the folder cannot be written.
    """
    models = [f"stage{s}-{n}.json" for s in (1, 2) for n in ("paper", "output-error")]
    check_folder(folder, ("square.csv", "sine.csv", *models, "demo.html"), force=force)
    say("recording both stages on the virtual rig, under a square and a sine current")
    square = demo_run("square", noise=noise, seed=seed)
    sine = demo_run("sine", noise=noise, seed=seed)
    files = []
    for run in (square, sine):
        path = folder / f"{run.name}.csv"
        run.to_csv(path, force=force)
        files.append(path)
    rows: dict[int, list[StageRow]] = {}
    results: dict[int, dict[str, Identification]] = {}
    traces: dict[str, dict[int, Trace]] = {}
    for stage in (1, 2):
        structure = flexible_link(stage=1 if stage == 1 else 2, coupling="measured", laws=())
        own = list(structure.signals)
        on, off = square.select(own), sine.select(own)
        rows[stage], results[stage] = integer_rows(stage, on, off), {}
        for p in (*INNOVATION_LENGTHS, None):
            label = f"p = {p}" if p else "least squares"
            say(f"stage {stage}: searching the orders of both equations, {label}")
            result = identify(
                on, structure, method="multi-innovation" if p else "least-squares", innovation_length=p or 1,
                lattice=Lattice(step=step), threads=threads, progress=progress,
            )  # fmt: skip
            results[stage][label] = result
            validation = result.model.compare(off)
            for item, free in zip(result.model.equations, structure.equations, strict=True):
                name = item.output
                rows[stage].append(
                    StageRow(
                        label, name,
                        {n: result.orders[n] for n in free.order_names},
                        {n: result.coefficients[n] for n in free.coefficient_names},
                        result.equation_error[name], result.output_error[name], validation.output_error[name],
                    )
                )  # fmt: skip
                if p:
                    at = structure.equation(name).with_orders({n: result.orders[n] for n in free.order_names})
                    traces.setdefault(name, {})[p] = multi_innovation_trace(
                        on, at, innovation_length=p, every=TRACE_EVERY
                    )
        say(f"stage {stage}: all orders and coefficients together by output error, from the current alone")
        label = "output error"
        result = identify(on, flexible_link(stage=1 if stage == 1 else 2), threads=threads, progress=progress)
        results[stage][label] = result
        validation = result.model.compare(off)
        rows[stage] += [
            StageRow(
                label, e.output, *numbers_of(e),
                result.equation_error[e.output], result.output_error[e.output], validation.output_error[e.output],
            )
            for e in result.model.equations
        ]  # fmt: skip
        for label, stem in ((f"p = {INNOVATION_LENGTHS[-1]}", "paper"), ("output error", "output-error")):
            path = folder / f"stage{stage}-{stem}.json"
            results[stage][label].model.save(path, force=force)
            files.append(path)
    return Demo(square, sine, rows, results, traces, files)
