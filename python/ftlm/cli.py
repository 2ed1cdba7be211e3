"""The command line: results to standard output, progress to standard error, exit codes that scripts can read."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import platform
import re
import sys
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ftlm
from ftlm.errors import DataError, FtlmError, InternalError, ModelError, RigFault
from ftlm.rig.commands import record

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ftlm.models import Structure
    from ftlm.order_search import Job, Lattice, SearchResult
    from ftlm.runs import Run
    from ftlm.store import Store

__all__ = ["app", "main"]

EXIT_INTERNAL, EXIT_USAGE, EXIT_DATA, EXIT_VALIDATION, EXIT_RIG, EXIT_INTERRUPTED = 1, 2, 3, 4, 5, 130

app = typer.Typer(
    name="ftlm",
    help="Fractional-order models of flexible machines from measured data.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Method(StrEnum):
    """Estimators."""

    output_error = "output-error"
    instrumental_variables = "instrumental-variables"
    multi_innovation = "multi-innovation"
    least_squares = "least-squares"
    genetic = "genetic"


class Coefficients(StrEnum):
    """Estimators of the coefficients in a search."""

    instrumental_variables = "instrumental-variables"
    multi_innovation = "multi-innovation"
    least_squares = "least-squares"


class Criterion(StrEnum):
    """Errors that rank the candidates."""

    output_error = "output-error"
    equation_error = "equation-error"


class Norm(StrEnum):
    """Sums of an error."""

    l1 = "l1"
    l2 = "l2"


class Coupling(StrEnum):
    """What drives an equation."""

    measured = "measured"
    simulated = "simulated"


class InputOrder(StrEnum):
    """Orders of the current in the deflection's equation."""

    published = "published"
    derived = "derived"


class Laws(StrEnum):
    """Which laws tie a flexible link's orders."""

    none = "none"
    orders = "orders"


class Tool(StrEnum):
    """Tools that models are written for."""

    control = "control"
    matlab = "matlab"
    json = "json"


class Drawing(StrEnum):
    """Figures of a saved model."""

    fit = "fit"
    residuals = "residuals"
    bode = "bode"


class Rows(StrEnum):
    """Coordinates of the rows of the recursion."""

    haar = "haar"
    time = "time"


# ------------------------------------------------------------------------------------------------ options

Files = Annotated[
    list[str], typer.Argument(metavar="FILE...", help="csv or .mat files; several files are several runs.")
]
Time = Annotated[str | None, typer.Option("--time", help="Column of time.")]
Step = Annotated[float | None, typer.Option("--sampling", help="Sampling step [s] of files without a time column.")]
Inputs = Annotated[list[str] | None, typer.Option("-u", "--input", metavar="NAME=COLUMN", help="An input.")]
Outputs = Annotated[list[str] | None, typer.Option("-y", "--output", metavar="NAME=COLUMN", help="An output.")]
Units = Annotated[list[str] | None, typer.Option("--unit", metavar="NAME=UNIT", help="Unit of a signal, such as deg.")]
Columns = Annotated[str | None, typer.Option("--columns", metavar="TOML", help="File that names columns and units.")]
Between = Annotated[
    list[str] | None,
    typer.Option("--intersample", metavar="NAME=zoh|foh", help="foh for a measured input; a command is zoh."),
]
Slice = Annotated[str | None, typer.Option("--slice", metavar="FROM:TO", help="Seconds since the first row.")]
Resample = Annotated[float | None, typer.Option("--resample", metavar="STEP", help="Interpolate onto this step [s].")]
Json = Annotated[bool, typer.Option("--json", help="Results as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite files.")]
Threads = Annotated[int | None, typer.Option("--threads", help="Threads; default all cores.")]
M = Annotated[int | None, typer.Option("--m", help="Block pulses a run; default 2048, or what the runs carry.")]
Out = Annotated[str | None, typer.Option("-o", "--out", metavar="FILE", help="Where to write.")]
StructureOption = Annotated[
    str,
    typer.Option("--structure", help="flexible-link:1, flexible-link:2, flexible-link:both, or an equation in words."),
]
OnlyOutput = Annotated[str | None, typer.Option("--only", metavar="OUTPUT", help="Only the equation of this output.")]
CouplingOption = Annotated[Coupling, typer.Option("--coupling", help="What drives free runs of a flexible link.")]
CrossStage = Annotated[bool, typer.Option("--cross-stage", help="Add the other stage's angles and current.")]
Friction = Annotated[bool, typer.Option("--friction", help="Add a Coulomb term.")]
LawsOption = Annotated[Laws, typer.Option("--laws", help="orders: search all equations under the order law.")]
InputOrderOption = Annotated[InputOrder, typer.Option("--input-order", help="Order of the current, see the manual.")]
StockFilter = Annotated[bool, typer.Option("--stock-filter", help="Deflections passed the stock 2 Hz low-pass.")]
Orders = Annotated[list[str] | None, typer.Option("--order", metavar="NAME=VALUE", help="Fix an order.")]
Fixed = Annotated[list[str] | None, typer.Option("--fixed", metavar="NAME=VALUE", help="Fix a coefficient.")]
Delay = Annotated[
    list[str] | None,
    typer.Option("--delay", metavar="INPUT=SECONDS", help="Delay of an input; LEAST:LARGEST is estimated."),
]
InitialOption = Annotated[str, typer.Option("--initial", help="auto, rest, caputo, or exponents of t: 0,1.")]
LatticeOption = Annotated[
    list[str] | None,
    typer.Option("--lattice", metavar="NAME=LOW:HIGH:STEP", help="Values of an order; alpha means every alpha."),
]
LatticeStep = Annotated[float, typer.Option("--step", help="Step of the order lattice.")]
CriterionOption = Annotated[Criterion, typer.Option("--criterion", help="Error that ranks the candidates.")]
NormOption = Annotated[Norm, typer.Option("--norm", help="l1 is (45), l2 is (46).")]
P = Annotated[int, typer.Option("--p", help="Innovation length.")]
K0 = Annotated[float, typer.Option("--k0", help="Prior covariance of the coefficients.")]
RowsOption = Annotated[Rows, typer.Option("--rows", help="Coordinates of the rows of (44).")]
Keep = Annotated[int, typer.Option("--keep", help="Rows of the ranked table.")]
MethodOption = Annotated[Method, typer.Option("--method", help="Estimator.")]
Seeds = Annotated[
    list[int] | None, typer.Option("--seed", min=0, help="Seed of the genetic algorithm; several are several runs.")
]
Evaluations = Annotated[int | None, typer.Option("--evaluations", help="Evaluations a seed of the genetic algorithm.")]
CoefficientsOption = Annotated[Coefficients, typer.Option("--coefficients", help="Estimator of the coefficients.")]


# ------------------------------------------------------------------------------------------------ helpers


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """Turn errors into one line on standard error and an exit code."""

    @functools.wraps(command)
    def run(*args: Any, **options: Any) -> None:
        try:
            command(*args, **options)
            sys.stdout.flush()
        except KeyboardInterrupt:
            print("ftlm: interrupted; nothing was written", file=sys.stderr)
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except BrokenPipeError:
            # The reader of a pipe has gone; what it did not read is nobody's loss.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None
        except FtlmError as error:
            print(f"ftlm: {error}", file=sys.stderr)
            raise typer.Exit(exit_code(error)) from None

    return run


def exit_code(error: FtlmError) -> int:
    """Exit code of an error: 1 internal, 2 usage, 3 data refused, 5 rig."""
    if isinstance(error, InternalError):
        return EXIT_INTERNAL
    if isinstance(error, ModelError):
        return EXIT_USAGE
    return EXIT_RIG if isinstance(error, RigFault) else EXIT_DATA


def pairs(option: str, given: list[str] | None) -> dict[str, str]:
    """NAME=VALUE options as a dictionary; a bare NAME stands for NAME=NAME.

    Raises
    ------
    ModelError
        An empty name or value, or a name given twice.
    """
    found: dict[str, str] = {}
    for item in given or []:
        name, equals, value = item.partition("=")
        value = value if equals else name
        if not equals and name and not re.fullmatch(r"[^\W\d][\w.\[\]]*", name):
            short = re.sub(r"\W+", "_", name.partition("(")[0]).strip("_0123456789").lower() or "name"
            raise ModelError(
                f'{option} {item!r} has no name of its own; write NAME=…, such as {option} "{short}={item}"'
            )
        if not name or not value:
            raise ModelError(f"{option} {item!r} is not NAME=VALUE")
        if name in found:
            raise ModelError(f"{option} names {name!r} twice")
        found[name] = value
    return found


def numbers(option: str, given: list[str] | None) -> dict[str, float]:
    """NAME=NUMBER options.

    Raises
    ------
    ModelError
        A value that is no number.
    """
    found = {}
    for name, value in pairs(option, given).items():
        try:
            found[name] = float(value)
        except ValueError:
            raise ModelError(f"{option} {name}={value}: {value!r} is no number") from None
    return found


def delays(given: list[str] | None) -> dict[str, float | tuple[float, float]]:
    """INPUT=SECONDS options, or INPUT=LEAST:LARGEST where the delay is to be estimated.

    Raises
    ------
    ModelError
        A value that is neither.
    """
    found: dict[str, float | tuple[float, float]] = {}
    for name, value in pairs("--delay", given).items():
        try:
            ends = [float(v) for v in value.split(":")]
        except ValueError:
            ends = []
        if len(ends) not in (1, 2):
            raise ModelError(f"--delay {name}={value}: {value!r} is neither seconds nor LEAST:LARGEST, as in 0:0.02")
        found[name] = ends[0] if len(ends) == 1 else (ends[0], ends[1])
    return found


def interval(
    text: str | None, option: str = "--slice", example: str = "1.1:19.5"
) -> tuple[float | None, float | None] | None:
    """FROM:TO, either end optional.

    Raises
    ------
    ModelError
        Anything else.
    """
    if text is None:
        return None
    parts = text.split(":")
    try:
        if len(parts) != 2:
            raise ValueError
        start, stop = (float(p) if p.strip() else None for p in parts)
    except ValueError:
        raise ModelError(f"{option} {text!r} is no FROM:TO, such as {example}") from None
    return start, stop


def load_runs(files: list[str], sliced: str | None, **options: Any) -> list[Run]:
    """Each file a run; .mat files that hold one signal each are one run together.

    Raises
    ------
    DataError
        Naming the file.
    """
    options = {name: value for name, value in options.items() if value}
    span = interval(sliced)
    if span is not None:
        options["slice"] = span
    if len(files) > 1 and all(f.lower().endswith(".mat") for f in files):
        try:
            ftlm.load(files[0], **options)
        except DataError:
            # The first file alone lacks a column that is asked for, so the files belong together.
            run = ftlm.load(files, **options)
            print(f"ftlm: {len(files)} .mat files read as one run", file=sys.stderr)
            return [run]
    return [ftlm.load(f, **options) for f in files]


def load_options(
    time: str | None,
    sampling: float | None,
    inputs: list[str] | None,
    outputs: list[str] | None,
    units: list[str] | None,
    columns: str | None,
    between: list[str] | None,
    resample: float | None,
) -> dict[str, Any]:
    """Options of :func:`ftlm.load` from those of the command line."""
    return {
        "time": time,
        "step": sampling,
        "inputs": pairs("-u", inputs),
        "outputs": pairs("-y", outputs),
        "units": pairs("--unit", units),
        "columns": columns,
        "intersample": pairs("--intersample", between),
        "resample": resample,
    }


def structure_of(
    text: str,
    *,
    only: str | None,
    coupling: Coupling,
    cross_stage: bool,
    friction: bool,
    laws: Laws,
    input_order: InputOrder,
    stock_filter: bool,
    orders: list[str] | None,
    fixed: list[str] | None,
    delay: list[str] | None,
    initial: str,
) -> Structure:
    """The structure that the options describe.

    Raises
    ------
    ModelError
        A structure, order or coefficient that is not known.
    """
    if text.startswith("flexible-link"):
        _, _, stage = text.partition(":")
        stages: dict[str, Any] = {"1": 1, "2": 2, "both": "both"}
        if stage not in stages:
            raise ModelError(f"--structure {text!r} is not known; use flexible-link:1, :2 or :both, or an equation")
        structure = ftlm.flexible_link(
            stage=stages[stage], input_order=input_order.value, coupling=coupling.value, cross_stage=cross_stage,
            friction=friction, laws=("orders", "coefficients") if laws is Laws.orders else (),
            sensor_filter="stock" if stock_filter else None,
        )  # fmt: skip
    else:
        structure = ftlm.equation(text)
        if len(structure.equations) > 1:
            structure = replace(structure, coupling=coupling.value)
    if only is not None:
        structure = structure.equation(only)
    if initial not in ("auto", "rest", "caputo"):
        try:
            exponents: Any = tuple(float(e) for e in initial.split(","))
        except ValueError:
            raise ModelError(f"--initial {initial!r} is not auto, rest, caputo or exponents such as 0,1") from None
        initial = exponents
    from ftlm.models import check_initial  # noqa: PLC0415 — the public constructor of equations checks it otherwise

    structure = replace(structure, initial=check_initial(initial)).with_delays(delays(delay))
    return structure.with_orders(numbers("--order", orders)).with_coefficients(numbers("--fixed", fixed))


def lattice_of(given: list[str] | None, step: float) -> Lattice:
    """The lattice that the options describe.

    Raises
    ------
    ModelError
        An interval that cannot be read, a step that is not positive.
    """
    named: dict[str, Any] = dict(pairs("--lattice", given))
    alpha = named.pop("alpha", None)
    found = ftlm.lattice(step=step, **named)
    return found if alpha is None else replace(found, orders={**found.orders, "alpha": alpha})


def genetic_of(seeds: list[int] | None, evaluations: int | None, method: str) -> Any:
    """Settings of the genetic algorithm, or None where they are not asked for.

    Raises
    ------
    ModelError
        Settings for another method.
    """
    if seeds is None and evaluations is None:
        return None
    if method != "genetic":
        raise ModelError(f"--seed and --evaluations are of the genetic algorithm, not of --method {method}")
    return ftlm.Genetic(seeds=tuple(seeds or ftlm.Genetic().seeds), evaluations=evaluations)


def check_writable(paths: list[str | None], *, force: bool) -> None:
    """Refuse before any work what could not be written after it.

    Raises
    ------
    DataError
        A file that exists, or a folder that does not.
    """
    for path in paths:
        if path is None:
            continue
        if Path(path).is_dir():
            raise DataError(f"{path} is a folder; name a file in it")
        if Path(path).exists() and not force:
            raise DataError(f"{path} exists; choose another name, or overwrite it with --force")
        if not Path(path).resolve().parent.is_dir():
            raise DataError(f"{Path(path).parent} is no folder; make it first")


def show(result: Any, *, as_json: bool) -> None:
    """A result for people, or as JSON."""
    if as_json:
        print(json.dumps(result.to_dict(), indent=1, ensure_ascii=False, allow_nan=False, default=plain))
    else:
        print(result)


def plain(value: Any) -> Any:
    """NumPy scalars and arrays as JSON knows them."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


# ------------------------------------------------------------------------------------------------ commands


@app.callback(invoke_without_command=True)
def version(
    show_version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    """Fractional-order models of flexible machines from measured data."""
    if show_version:
        print(f"ftlm {ftlm.__version__}")
        raise typer.Exit


@app.command()
@guarded
def demo(
    out: Annotated[str, typer.Option("-o", "--out", metavar="FOLDER", help="Where to write.")] = "ftlm-demo",
    step: LatticeStep = 0.1,
    noise: Annotated[float, typer.Option("--noise", help="Noise on every angle [rad].")] = 1e-4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the noise.")] = 1,
    threads: Threads = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Simulate both stages, identify every equation with p = 1, 3, 5, 7, compare, save, draw.

    The paper's lattice is that of --step 0.05, which takes minutes.
    """
    from ftlm.demo import run_demo  # noqa: PLC0415 — a command imports what it needs when it runs
    from ftlm.progress import Progress  # noqa: PLC0415
    from ftlm.report.demo import demo_page, demo_text  # noqa: PLC0415

    with Progress("", quiet=as_json) as progress:
        found = run_demo(
            Path(out), step=step, noise=noise, seed=seed, threads=threads, force=force, say=progress.say,
            progress=progress,
        )  # fmt: skip
        progress.say("writing the page")
        page = demo_page(found, Path(out) / "demo.html", force=force)
    found.files.append(page)
    if as_json:
        show(found, as_json=True)
    else:
        print(demo_text(found))
        print("\nwritten: " + ", ".join(str(f) for f in found.files))


app.command()(guarded(record))


@app.command()
@guarded
def inspect(
    files: Files,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    as_json: Json = False,
) -> None:
    """Show what a run holds: ranges, noise, quantisation, rest, and what to do about it before identification."""
    from ftlm.inspection import inspect_run  # noqa: PLC0415

    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    runs = load_runs(files, sliced, **options)
    found = [(inspect_run(run), run.advice()) for run in runs]
    if as_json:
        data = [{**figures.to_dict(), "advice": advice.to_dict()} for figures, advice in found]
        print(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        print("\n\n".join(f"{figures}\n{advice}" for figures, advice in found))


@app.command()
@guarded
def identify(
    files: Files,
    structure: StructureOption,
    method: MethodOption = Method.output_error,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    only: OnlyOutput = None,
    coupling: CouplingOption = Coupling.simulated,
    cross_stage: CrossStage = False,
    friction: Friction = False,
    laws: LawsOption = Laws.none,
    input_order: InputOrderOption = InputOrder.published,
    stock_filter: StockFilter = False,
    orders: Orders = None,
    fixed: Fixed = None,
    delay: Delay = None,
    initial: InitialOption = "auto",
    criterion: CriterionOption = Criterion.output_error,
    norm: NormOption = Norm.l1,
    lattice: LatticeOption = None,
    step: LatticeStep = 0.05,
    p: P = 7,
    k0: K0 = 1.0,
    rows: RowsOption = Rows.haar,
    m: M = None,
    keep: Keep = 20,
    seeds: Seeds = None,
    evaluations: Evaluations = None,
    threads: Threads = None,
    store: Annotated[
        str | None,
        typer.Option("--store", metavar="FILE", help="Keep finished order searches there; the same command goes on."),
    ] = None,
    out: Out = None,
    report: Annotated[str | None, typer.Option("--report", metavar="HTML", help="Page to write.")] = None,
    validation: Annotated[str | None, typer.Option("--validation", metavar="FILE", help="Another run.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Identify a model: orders on a lattice, coefficients, both errors, warnings in words."""
    from ftlm.progress import Progress  # noqa: PLC0415

    check_writable([out, report], force=force)
    wanted = structure_of(
        structure, only=only, coupling=coupling, cross_stage=cross_stage, friction=friction, laws=laws,
        input_order=input_order, stock_filter=stock_filter, orders=orders, fixed=fixed, delay=delay, initial=initial,
    )  # fmt: skip
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    runs = load_runs(files, sliced, **options)
    others = load_runs([validation], None, **options) if validation is not None else []
    with resumable(store, "the same command"), Progress("searching orders", quiet=as_json) as progress:
        found = ftlm.identify(
            runs, wanted, method=method.value, criterion=criterion.value, lattice=lattice_of(lattice, step),
            norm=norm.value, innovation_length=p, prior_covariance=k0, rows=rows.value, m=m, keep=keep,
            genetic=genetic_of(seeds, evaluations, method.value), threads=threads, progress=progress, store=store,
        )  # fmt: skip
    if out is not None:
        found.model.save(out, force=force)
    if report is not None:
        progress.say("writing the report")
        found.report(report, validation=others or None, force=force)
    checked = found.validate(others) if others else None
    if as_json:
        document = {**found.to_dict(), "validation": None if checked is None else checked.to_dict()}
        print(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False, default=plain))
    else:
        show(found, as_json=False)
        if checked is not None:
            print(f"\nvalidation on {', '.join(r.name for r in others)}\n{checked}")


@app.command()
@guarded
def search(
    files: Files,
    structure: StructureOption,
    coefficients: CoefficientsOption = Coefficients.multi_innovation,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    only: OnlyOutput = None,
    coupling: CouplingOption = Coupling.simulated,
    cross_stage: CrossStage = False,
    friction: Friction = False,
    laws: LawsOption = Laws.none,
    input_order: InputOrderOption = InputOrder.published,
    stock_filter: StockFilter = False,
    orders: Orders = None,
    fixed: Fixed = None,
    delay: Delay = None,
    initial: InitialOption = "auto",
    criterion: CriterionOption = Criterion.output_error,
    norm: NormOption = Norm.l1,
    lattice: LatticeOption = None,
    step: LatticeStep = 0.05,
    p: P = 7,
    k0: K0 = 1.0,
    rows: RowsOption = Rows.haar,
    m: M = None,
    keep: Keep = 20,
    threads: Threads = None,
    store: Annotated[
        str | None, typer.Option("--store", metavar="FILE", help="Keep finished work there; go on with ftlm resume.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Rank the orders of each equation, or of a stage under its order law, and account for every candidate."""
    from ftlm.order_search import make_job, run_job  # noqa: PLC0415
    from ftlm.progress import Progress  # noqa: PLC0415
    from ftlm.store import Store  # noqa: PLC0415

    wanted = structure_of(
        structure, only=only, coupling=coupling, cross_stage=cross_stage, friction=friction, laws=laws,
        input_order=input_order, stock_filter=stock_filter, orders=orders, fixed=fixed, delay=delay, initial=initial,
    )  # fmt: skip
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    runs = load_runs(files, sliced, **options)
    parts = wanted.parts() or {e.output: wanted.equation(e.output) for e in wanted.equations}
    chosen = lattice_of(lattice, step)
    known = {"alpha", *wanted.order_names}
    for name in chosen.orders:
        if name not in known:
            free = ", ".join(wanted.order_names) or "none"
            raise ModelError(f"--lattice {name!r} is no free order; free are {free}")
    jobs: dict[str, Callable[..., Job]] = {}
    for name, part in parts.items():
        own = {n: v for n, v in chosen.orders.items() if n == "alpha" or n in part.order_names}
        jobs[name] = functools.partial(
            make_job, runs, part, replace(chosen, orders=own), criterion=criterion.value,
            coefficients=coefficients.value, norm=norm.value, innovation_length=p, prior_covariance=k0,
            rows=rows.value, m=m, keep=keep, threads=threads,
        )  # fmt: skip
    found = {}
    with resumable(store), contextlib.ExitStack() as stack:
        kept = None
        if store is not None:
            ready = {name: make() for name, make in jobs.items()}
            kept = stack.enter_context(Store(store, [job.request(name) for name, job in ready.items()]))
            show_notes(kept)
        for number, (name, make) in enumerate(jobs.items()):
            with Progress(f"searching orders of {name}", quiet=as_json) as progress:
                found[name] = run_job(make(progress=progress), store=kept, number=number)
    show_searches(found, as_json=as_json)


def show_searches(found: dict[str, SearchResult], *, as_json: bool) -> None:
    """Searches by output, for people or as JSON."""
    if as_json:
        data = {n: r.to_dict() for n, r in found.items()}
        print(json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False, default=plain))
    else:
        print("\n\n".join(f"{name}\n{result}" for name, result in found.items()))


@contextlib.contextmanager
def resumable(path: str | None, how: str | None = None) -> Iterator[None]:
    """Say after Ctrl-C how to go on with a store, if there is one."""
    try:
        yield
    except KeyboardInterrupt:
        if path is None or not Path(path).exists():
            raise
        print(f"ftlm: interrupted; go on with: {how or f'ftlm resume {path}'}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def show_notes(store: Store) -> None:
    """What was mended in a store."""
    for note in store.notes:
        print(f"ftlm: {store.path}: {note}", file=sys.stderr)


StoreFile = Annotated[str, typer.Argument(metavar="STORE", help="A file written with --store.")]


@app.command()
@guarded
def resume(
    store: StoreFile,
    salvage: Annotated[
        bool, typer.Option("--salvage", help="Go on with a damaged store; the damaged file is kept beside it.")
    ] = False,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Go on with the searches of a store, and show them; it needs no other file."""
    from ftlm.order_search import resume_job  # noqa: PLC0415
    from ftlm.progress import Progress  # noqa: PLC0415
    from ftlm.store import Store  # noqa: PLC0415

    found = {}
    with resumable(store), Store(store, salvage=salvage) as kept:
        show_notes(kept)
        for number, request in enumerate(kept.contents.requests):
            with Progress(f"searching orders of {request.name}", quiet=as_json) as progress:
                found[request.name] = resume_job(kept, number, threads=threads, progress=progress)
    show_searches(found, as_json=as_json)


@app.command()
@guarded
def status(store: StoreFile, as_json: Json = False) -> None:
    """Show how far the searches of a store are; it may be in use."""
    found = ftlm.search_status(store)
    if as_json:
        print(json.dumps({n: s.to_dict() for n, s in found.items()}, indent=1, ensure_ascii=False, allow_nan=False))
    else:
        print("\n".join(str(s) for s in found.values()))


@app.command()
@guarded
def compare(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A saved model.")],
    files: Files,
    min_fit: Annotated[
        float | None, typer.Option("--min-fit", help="Exit with 4 where a free run fits less than this percentage.")
    ] = None,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    m: M = None,
    as_json: Json = False,
) -> None:
    """Equation error and output error of a saved model on measured runs."""
    loaded = ftlm.load_model(model)
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    found = loaded.compare(load_runs(files, sliced, **options), m=m)
    show(found, as_json=as_json)
    if min_fit is not None:
        # Negated so that a fit that is not a number is too low.
        low = {name: fit for name, fit in found.fit_percent.items() if not fit >= min_fit}
        if low:
            listed = ", ".join(f"{name} {fit:.4g} %" for name, fit in low.items())
            print(f"ftlm: fit below {min_fit:g} %: {listed}", file=sys.stderr)
            raise typer.Exit(EXIT_VALIDATION)


@app.command()
@guarded
def resid(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A saved model.")],
    files: Files,
    lags: Annotated[int, typer.Option("--lags", min=1, help="Largest lag in samples.")] = 25,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    as_json: Json = False,
) -> None:
    """Test a saved model's residuals: are they white, and independent of the inputs? Exit with 4 where not."""
    loaded = ftlm.load_model(model)
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    found = loaded.resid(load_runs(files, sliced, **options), lags=lags)
    show(found, as_json=as_json)
    if not found.passed:
        raise typer.Exit(EXIT_VALIDATION)


@app.command()
@guarded
def simulate(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A saved model.")],
    file: Annotated[str, typer.Argument(metavar="FILE", help="A run whose inputs drive the model.")],
    out: Annotated[str, typer.Option("-o", "--out", metavar="CSV", help="Where to write the simulated run.")],
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    tolerance: Annotated[float, typer.Option("--tolerance", help="Relative change at which refinement ends.")] = 1e-6,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Free run of a saved model on a run's inputs, written as csv."""
    check_writable([out], force=force)
    loaded = ftlm.load_model(model)
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    (run,) = load_runs([file], sliced, **options)
    found = loaded.simulate(run, tolerance=tolerance)
    found.to_csv(out, force=force)
    if as_json:
        print(json.dumps({"written": out, "rows": found.length, "outputs": list(found.outputs)}, ensure_ascii=False))
    else:
        print(f"{found.length} rows of {', '.join(found.outputs)} written to {out}")


@app.command()
@guarded
def report(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A saved model.")],
    out: Annotated[str, typer.Option("-o", "--out", metavar="HTML", help="Page to write.")],
    validation: Annotated[
        list[str] | None, typer.Option("--validation", metavar="FILE", help="A run that the model has not seen.")
    ] = None,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the report of a saved model, with validation runs: one page that opens offline."""
    from ftlm.report.page import model_page  # noqa: PLC0415

    check_writable([out], force=force)
    loaded = ftlm.load_model(model)
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    runs = load_runs(validation, sliced, **options) if validation else None
    page = model_page(loaded, out, validation=runs, force=force)
    print(json.dumps({"written": str(page)}, ensure_ascii=False) if as_json else f"written: {page}")


@app.command()
@guarded
def reproduce(
    out: Annotated[str, typer.Option("-o", "--out", metavar="HTML", help="Page to write.")] = "paper.html",
    save: Annotated[
        str | None, typer.Option("--save", metavar="FOLDER", help="Also write runs, models and the tables' numbers.")
    ] = None,
    square: Annotated[
        str | None, typer.Option("--square", metavar="FILE", help="A measured run to identify from.")
    ] = None,
    sine: Annotated[str | None, typer.Option("--sine", metavar="FILE", help="Another one, to validate on.")] = None,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    step: LatticeStep = 0.05,
    noise: Annotated[float, typer.Option("--noise", help="Noise on every angle of the virtual rig [rad].")] = 1e-4,
    seed: Annotated[int, typer.Option("--noise-seed", min=0, help="Seed of that noise.")] = 1,
    seeds: Seeds = None,
    evaluations: Evaluations = None,
    threads: Threads = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Recompute the tables and figures of the paper, on the virtual rig or on measured runs, as one page."""
    from ftlm.progress import Progress  # noqa: PLC0415 — a command imports what it needs when it runs
    from ftlm.report.page import check_free  # noqa: PLC0415
    from ftlm.report.reproduction import reproduction_text  # noqa: PLC0415
    from ftlm.reproduction import check_folder  # noqa: PLC0415

    check_writable([out], force=force)
    check_free(out, force=force)
    if save is not None:
        check_folder(Path(save), {}, force=force)
    if sine is not None and square is None:
        raise ModelError("--sine is given without --square; give both, or neither for the virtual rig")
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    loaded = [load_runs([f], sliced, **options)[0] for f in (square, sine) if f is not None]
    with Progress("", quiet=as_json) as progress:
        found = ftlm.reproduce(
            *loaded, step=step, noise=noise, seed=seed, genetic=genetic_of(seeds, evaluations, "genetic"),
            threads=threads, say=progress.say, progress=progress,
        )  # fmt: skip
        progress.say("writing the page")
        files = [found.page(out, force=force), *(found.save(save, force=force) if save is not None else [])]
    if as_json:
        document = {**found.to_dict(), "files": [str(f) for f in files]}
        print(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False, default=plain))
    else:
        print(reproduction_text(found))
        print("\nwritten: " + ", ".join(str(f) for f in files))


@app.command()
@guarded
def plot(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A saved model.")],
    out: Annotated[str, typer.Option("-o", "--out", metavar="FILE", help="Figure to write: .png, .pdf or .svg.")],
    files: Annotated[list[str] | None, typer.Argument(metavar="[RUN]...", help="Runs; bode needs none.")] = None,
    kind: Annotated[Drawing, typer.Option("--kind", help="What to draw.")] = Drawing.fit,
    time: Time = None,
    sampling: Step = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    units: Units = None,
    columns: Columns = None,
    between: Between = None,
    sliced: Slice = None,
    resample: Resample = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Draw a saved model for a paper: its fit or residual tests on runs, or its Bode plot."""
    import io  # noqa: PLC0415

    from ftlm import plot as drawings  # noqa: PLC0415
    from ftlm.models import write_atomically  # noqa: PLC0415

    check_writable([out], force=force)
    suffix = Path(out).suffix.removeprefix(".").lower()
    if suffix not in ("png", "pdf", "svg"):
        raise ModelError(f"{out} ends in {suffix or 'nothing'!r}; write .png, .pdf or .svg")
    loaded = ftlm.load_model(model)
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    runs = load_runs(files, sliced, **options) if files else []
    if not runs and kind is not Drawing.bode:
        raise ModelError(f"--kind {kind.value} needs at least one run; give files")
    if kind is Drawing.bode:
        figure = drawings.bode(loaded)
    elif kind is Drawing.fit:
        figure = drawings.fit(loaded, runs)
    else:
        figure = drawings.residuals(loaded.resid(runs))
    data = io.BytesIO()
    figure.savefig(data, format=suffix, dpi=200)
    write_atomically(out, data.getvalue(), force=force)
    print(json.dumps({"written": out}, ensure_ascii=False) if as_json else f"written: {out}")


@app.command()
@guarded
def export(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A saved model.")],
    to: Annotated[Tool, typer.Option("--to", help="control: Python script; matlab: script for FOMCON; json.")],
    band: Annotated[
        str | None, typer.Option("--band", metavar="LOW:HIGH", help="Frequencies [rad/s] that control needs.")
    ] = None,
    order: Annotated[int, typer.Option("--order", help="Order of Oustaloup's filter, for control.")] = 5,
    out: Out = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write a saved model for another tool, to a file or to standard output."""
    from ftlm.exports import export_text  # noqa: PLC0415
    from ftlm.models import write_atomically  # noqa: PLC0415

    check_writable([out], force=force)
    limits = None
    if band is not None:
        low, high = interval(band, "--band", "0.1:100") or (None, None)
        if low is None or high is None:
            raise ModelError(f"--band {band!r} lacks an end; write LOW:HIGH in rad/s, such as 0.1:100")
        limits = (low, high)
    text = export_text(ftlm.load_model(model), to.value, band=limits, order=order)
    if out is None:
        print(json.dumps({"to": to.value, "text": text}, ensure_ascii=False) if as_json else text.rstrip("\n"))
    else:
        write_atomically(out, text.encode(), force=force)
        print(json.dumps({"to": to.value, "written": out}, ensure_ascii=False) if as_json else f"written: {out}")


@app.command()
@guarded
def doctor(as_json: Json = False) -> None:
    """Show versions, cores, vector unit, and whether the rig's driver is there."""
    from importlib import metadata  # noqa: PLC0415

    from ftlm import _core  # noqa: PLC0415
    from ftlm.order_search import available_threads  # noqa: PLC0415
    from ftlm.rig.quanser import driver_state  # noqa: PLC0415

    def installed(package: str) -> str | None:
        try:
            return metadata.version(package)
        except metadata.PackageNotFoundError:
            return None

    found: dict[str, Any] = {
        "ftlm": ftlm.__version__,
        "core": _core.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": available_threads(),
        "simd": _core.SIMD,
        "numpy": installed("numpy"),
        "scipy": installed("scipy"),
        "rig driver": driver_state(),
    }
    if as_json:
        print(json.dumps(found, indent=1))
        return
    for name, value in found.items():
        print(f"{name:<12}{value if value is not None else 'not installed'}")
    if found["scipy"] is None:
        print("scipy is needed for .mat files: pip install 'ftlm[mat]'")


def main() -> None:
    """Entry point."""
    app()
