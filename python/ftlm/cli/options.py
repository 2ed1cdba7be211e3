"""What commands share: options, files, errors and exit codes that scripts can read."""

from __future__ import annotations

import functools
import json
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from typing import Annotated, Any

import typer

from ftlm.arm.link import flexible_link
from ftlm.base.errors import DataError, FtlmError, InternalError, ModelError, RigFault
from ftlm.data.language import equation
from ftlm.data.lattice import Lattice, lattice
from ftlm.data.run import Run
from ftlm.data.structures import Structure, check_initial
from ftlm.files.load import load
from ftlm.fit.genetic import Genetic

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
            load(files[0], **options)
        except DataError:
            # The first file alone lacks a column that is asked for, so the files belong together.
            run = load(files, **options)
            print(f"ftlm: {len(files)} .mat files read as one run", file=sys.stderr)
            return [run]
    return [load(f, **options) for f in files]


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
        structure = flexible_link(
            stage=stages[stage], input_order=input_order.value, coupling=coupling.value, cross_stage=cross_stage,
            friction=friction, laws=("orders", "coefficients") if laws is Laws.orders else (),
            sensor_filter="stock" if stock_filter else None,
        )  # fmt: skip
    else:
        structure = equation(text)
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
    found = lattice(step=step, **named)
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
    return Genetic(seeds=tuple(seeds or Genetic().seeds), evaluations=evaluations)


def show(result: Any, *, as_json: bool) -> None:
    """A result for people, or as JSON."""
    if as_json:
        print(json.dumps(result.to_dict(), indent=1, ensure_ascii=False, allow_nan=False, default=plain))
    else:
        print(result)


def plain(value: Any) -> Any:
    """NumPy scalars and arrays as JSON knows them."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
