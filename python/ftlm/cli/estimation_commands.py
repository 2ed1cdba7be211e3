"""Commands for estimation: identify, identify-frequency, search, resume, status, select, consistency."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from ftlm.cli.framework import (
    EXIT_INTERRUPTED,
    OptionalOutputJson,
    OptionalOutputPage,
    OptionDetails,
    command,
    interval,
    numbers,
    pairs,
    print_text,
    ranges,
    show,
    show_json,
)
from ftlm.cli.options import (
    GeneticOptions,
    MultiInnovationOptions,
    OrderGridOptions,
    OutputErrorOptions,
    RankingOptions,
    StructureOptions,
)
from ftlm.cli.reading_options import ReadingOptions, given_fields, layout_options
from ftlm.data.frequency_data import FrequencyData
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.estimation import consistency as consistency_module
from ftlm.estimation import identify as estimation
from ftlm.estimation.frequency_domain import Weights
from ftlm.estimation.frequency_domain import identify_frequency as frequency_estimation
from ftlm.estimation.methods import OutputError, method_with_options
from ftlm.estimation.order_ranking import search_identification, with_verdict
from ftlm.estimation.output_error import Loss
from ftlm.io.load_frequency import load_frequency
from ftlm.model.serialization import load_model
from ftlm.order_search.certificate import DEFAULT_MAX_CELLS, DEFAULT_MAX_TERM_RATIO, DEFAULT_TOLERANCE, certify_orders
from ftlm.order_search.checkpoint import Store
from ftlm.order_search.options import Coefficients, OrderGrid, SearchSettings, restrict_order_grid
from ftlm.order_search.search import announce_time, job_of, make_job, resume_job, run_job, search_status
from ftlm.progress import Progress
from ftlm.structure.structure import Structure
from ftlm.structure_selection import select as choice
from ftlm.structure_selection.automatic import IntegerOrderForm
from ftlm.structure_selection.result import Selection
from ftlm.structure_selection.select import automatic_problems
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import duration_bounds, estimate_duration, output_error_cost
from ftlm.utils.validation import check_threads

Method = Literal["output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic"]


#: Lowest and highest duration of a structure selection, divided by that of one fit per given structure. The first pair
#: is for a list of structures, the second for a stepwise selection.
LIST_TIME_FACTORS, STEPWISE_TIME_FACTORS = (1.0, 8.0), (1.5, 20.0)


def check_structures(texts: Sequence[str], shape: StructureOptions) -> Structure | None:
    """Check structures before any run is read, and return the first of them, or None for ``auto``.

    Raise ModelError for a structure that is invalid for every run. ``auto`` must be the only structure; of the options
    of a structure, only --delay and --only can be combined with it.
    """
    if "auto" not in texts:
        parsed = [shape.structure(text) for text in texts]
        return parsed[0]
    if len(texts) > 1:
        raise ModelError("--structure auto cannot be combined with another structure; leave one of them out")
    options = replace(shape, delay=None, only=None).given_options()
    if options:
        raise ModelError(
            f"{', '.join(options)}: options of a given structure, not used with --structure auto; "
            "leave them out, or give the equation that auto selects as --structure"
        )
    return None


def select_structure(
    runs: Sequence[Run],
    candidates: str | Structure | Sequence[Structure],
    shape: StructureOptions,
    *,
    driven_by: list[str] | None = None,
    validation: str | Sequence[Run] | None = None,
    threads: int | None,
    store: str | None = None,
    quiet: bool,
) -> Selection:
    """Select a structure with a progress bar, and return the selection.

    Of `shape`, only the delays and the option --only are used, and only for ``"auto"``. `driven_by` contains texts of
    the form OUTPUT=SIGNAL,…
    """
    automatic, is_listed = isinstance(candidates, str), isinstance(candidates, list)
    drivers = {name: text.split(",") for name, text in pairs("--driven-by", driven_by).items()}
    if automatic and shape.only is not None:
        runs = [run.select([shape.only, *run.inputs]) for run in runs]
    structure_list = [candidates] if isinstance(candidates, Structure) else candidates
    largest = (
        [IntegerOrderForm(4, 3).structure(problem) for problem in automatic_problems(runs, driven_by=drivers)]
        if isinstance(structure_list, str)
        else structure_list
    )
    seconds = sum(fit_seconds(runs, candidate, threads) for candidate in largest)
    with Progress("fitting candidates", quiet=quiet) as progress:
        progress.announce(
            "the selection of a structure",
            *duration_bounds(seconds, LIST_TIME_FACTORS if is_listed else STEPWISE_TIME_FACTORS),
        )
        return choice.select(
            runs,
            candidates,
            validation=validation,
            delay=ranges("--delay", shape.delay) if automatic else None,
            driven_by=drivers or None,
            threads=threads,
            # The number of candidates of a stepwise selection is not known in advance.
            progress=progress if is_listed else progress.show_count,
            store=store,
        )


def fit_seconds(runs: Sequence[Run], structure: Structure, threads: int | None, fits: int = 1) -> float:
    """Return the expected total time [s] of `fits` output-error fits, each to an equal share of the samples."""
    samples = sum(run.length for run in runs) * len(structure.outputs)
    parameter_count = (
        len(structure.order_names) + len(structure.coefficient_names) + len(structure.free_input_parameters)
    )
    return estimate_duration(fits * output_error_cost(samples // max(fits, 1), parameter_count), check_threads(threads))


def validation_runs(
    reading: ReadingOptions, file: str | None, window: str | None, equation: Structure | None
) -> list[Run]:
    """Return a list with the validation run, or [] if `file` is None.

    `window` is the value of --validation-window, which replaces --window. Raise ModelError for a window without a file.
    """
    if file is None:
        if window is not None:
            raise ModelError("--validation-window is a part of the run that --validation names; name its file, too")
        return []
    if window is not None:
        interval(window, "--validation-window", "1.1:19.5")
    try:
        return replace(reading, window=window).runs([file], equation)
    except DataError as error:
        # The file reader names the option --window in its messages, but here the window comes from another option.
        raise DataError(str(error).replace(f"{parameter('window')}:", "--validation-window:")) from None


@command
def identify(
    files: list[str],
    *,
    structure: str,
    method: Method = "output-error",
    reading: ReadingOptions,
    shape: StructureOptions,
    fit: OutputErrorOptions,
    grid: OrderGridOptions,
    ranking: RankingOptions,
    weighting: MultiInnovationOptions,
    genetic: GeneticOptions,
    driven_by: list[str] | None = None,
    m: int | None = None,
    threads: int | None = None,
    out: OptionalOutputJson = None,
    report: OptionalOutputPage = None,
    validation: str | None = None,
    validation_window: str | None = None,
    force: bool = False,
    verbose: bool = False,
    as_json: bool = False,
) -> None:
    """Identify a model, and print its verdict, equations, parameters, gains, modes, fit and warnings.

    Structure
    ---------
    structure
        flexible-link:1|2|both, arm:1|2|both, an equation, or auto.

    Method
    ------
    method
        Estimation method.

    Output
    ------
    validation : FILE
        Validate the model on this run.
    """
    equation = check_structures([structure], shape)
    if driven_by and structure != "auto":
        raise ModelError("--driven-by is used with --structure auto; give the terms to the equation instead")
    options = given_fields(replace(grid, increment=None), ranking, weighting, fit, genetic)
    options |= {} if grid.grid() is None else {"order_grid": grid.grid()}
    options |= {} if fit.start is None else {"start": load_model(fit.start)}
    options |= {} if fit.bounds is None else {"bounds": ranges("--bounds", fit.bounds)}
    options |= {} if fit.priors is None else {"priors": ranges("--priors", fit.priors)}
    estimator = method_with_options(method, options)
    runs = reading.runs(files, equation)
    validation_data = validation_runs(reading, validation, validation_window, equation)
    selection = None
    if structure == "auto":
        selection = select_structure(runs, "auto", shape, driven_by=driven_by, threads=threads, quiet=as_json)
    target = shape.structure_for_runs(structure, runs) if selection is None else selection.structure
    label = "fitting" if method == "output-error" else "searching orders"
    with resumable(ranking.store, "the same command"), Progress(label, quiet=as_json) as progress:
        if method == "output-error":
            progress.announce("the fit", *duration_bounds(fit_seconds(runs, target, threads)))
        if selection is not None and estimator == OutputError() and m is None:
            result = selection.best
        else:
            result = estimation.identify(runs, target, method=estimator, m=m, threads=threads, progress=progress)
    if out is not None:
        result.model.save(out, force=force)
    if report is not None:
        progress.print_label("writing the report")
        chosen_selection = selection if selection is not None and selection.best is result else None
        (chosen_selection or result).report(report, validation=validation_data or None, force=force)
    checked = result.validate(validation_data) if validation_data else None
    if as_json:
        verdict_entry = {"verdict": (result.verdict if checked is None else checked.verdict).to_dict()}
        chosen_from = {} if selection is None else {"selection": selection.ranking_dict()}
        content = {**verdict_entry, **result.to_dict(), **chosen_from}
        show_json({**content, "validation": None if checked is None else checked.to_dict()})
        return
    if selection is not None:
        print_text("\n".join([selection.reason, *(f"! {w}" for w in selection.warnings), ""]))
    print_text(result.summary(checked))
    if verbose and selection is not None:
        print_text(f"\n{selection.ranking_text()}")
    if verbose:
        print_text(f"\n{result.details()}")
    if verbose and checked is not None:
        print_text(f"\nvalidation on {', '.join(r.name for r in validation_data)}\n{checked}")
    elif checked is not None:
        print(f"validation on {', '.join(r.name for r in validation_data)}")
        print_text("\n".join(f"! {w}" for w in checked.warnings), end="\n" if checked.warnings else "")


@command
def search(
    files: list[str],
    *,
    structure: str,
    coefficients: Coefficients = "multi-innovation",
    reading: ReadingOptions,
    shape: StructureOptions,
    grid: OrderGridOptions,
    ranking: RankingOptions,
    weighting: MultiInnovationOptions,
    m: int | None = None,
    threads: int | None = None,
    out: OptionalOutputJson = None,
    report: OptionalOutputPage = None,
    validation: str | None = None,
    validation_window: str | None = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Search the orders of each equation, or of a joint under an order law, and print the best candidates.

    Method
    ------
    coefficients
        Estimation method of the coefficients.

    Output
    ------
    validation : FILE
        Validate the best model on this run.
    """
    equation = shape.structure(structure)
    runs = reading.runs(files, equation)
    validation_data = validation_runs(reading, validation, validation_window, equation)
    target = shape.structure_for_runs(structure, runs)
    groups = target.independent_groups() or {e.output: target.equation(e.output) for e in target.equations}
    full_grid = grid.grid() or OrderGrid()
    check_order_names(full_grid, target)
    options = given_fields(replace(ranking, store=None), weighting)
    settings = SearchSettings(coefficients=coefficients, **options)
    results = {}
    with resumable(ranking.store), contextlib.ExitStack() as stack:
        jobs = {
            name: make_job(runs, group, restrict_order_grid(full_grid, group), settings, m=m, threads=threads)
            for name, group in groups.items()
        }
        open_store = None
        if ranking.store is not None:
            open_store = stack.enter_context(Store(ranking.store, [job.request(name) for name, job in jobs.items()]))
            show_notes(open_store)
        announce_time(Progress("", quiet=as_json), list(jobs.values()), open_store)
        for number, (name, job) in enumerate(jobs.items()):
            with Progress(f"searching orders of {name}", quiet=as_json) as progress:
                result = run_job(replace(job, progress=progress), store=open_store, number=number)
            results[name] = with_verdict(
                result, runs, groups[name], settings, restrict_order_grid(full_grid, groups[name]), m=m
            )
    if out is None and report is None and not validation_data:
        show_by_output(results, as_json=as_json)
        return
    search_result = search_identification(results, runs, target, settings, full_grid, m=m)
    checked = search_result.validate(validation_data) if validation_data else None
    if as_json:
        content = {name: result.to_dict() for name, result in results.items()}
        show_json(content if checked is None else {**content, "validation": checked.to_dict()})
    else:
        show_by_output(results, as_json=False)
    if checked is not None and not as_json:
        fits = ", ".join(f"{o} {fit:.4g} %" for o, fit in checked.fit.items())
        print_text(f"validation on {', '.join(r.name for r in validation_data)}: fit {fits}; {checked.verdict}")
    if out is not None:
        search_result.model.save(out, force=force)
    if report is not None:
        search_result.report(report, validation=validation_data or None, force=force)


@command
def certify(
    files: list[str],
    *,
    structure: str,
    reading: ReadingOptions,
    shape: StructureOptions,
    grid: OrderGridOptions,
    tolerance: float = DEFAULT_TOLERANCE,
    min_separation: float | None = None,
    max_term_ratio: float = DEFAULT_MAX_TERM_RATIO,
    max_cells: int = DEFAULT_MAX_CELLS,
    m: int | None = None,
    threads: int | None = None,
    as_json: bool = False,
) -> None:
    """Prove a lower bound of the squared equation error of each equation over all orders in given intervals.

    Method
    ------
    order_grid : NAME=LOW:HIGH:STEP
        Interval of an order; alpha stands for every alpha.
    tolerance
        Fraction by which other orders may beat the smallest error.
    min_separation
        Minimum distance of orders; default the increment.
    max_term_ratio
        Maximum RMS of all terms together per RMS of the output.
    max_cells
        Maximum number of boxes of orders.
    """
    runs = reading.runs(files, shape.structure(structure))
    target = shape.structure_for_runs(structure, runs)
    full_grid = grid.grid() or OrderGrid()
    check_order_names(full_grid, target)
    results = {}
    for equation in target.equations:
        single = target.equation(equation.output)
        with Progress(f"certifying orders of {equation.output}", quiet=as_json) as progress:
            results[equation.output] = certify_orders(
                runs,
                single,
                restrict_order_grid(full_grid, single),
                tolerance=tolerance,
                min_separation=min_separation,
                max_term_ratio=max_term_ratio,
                max_cells=max_cells,
                m=m,
                threads=threads,
                progress=progress.show_count,
            )
    show_by_output(results, as_json=as_json)


def check_order_names(grid: OrderGrid, structure: Structure) -> None:
    """Raise ModelError if the grid names an order that is neither ``alpha`` nor a free order of the structure."""
    for name in grid.orders:
        if name not in {"alpha", *structure.order_names}:
            free = ", ".join(structure.order_names) or "none"
            raise ModelError(f"--order-grid {name!r} is not a free order; free are {free}")


def show_by_output(results: Mapping[str, Any], *, as_json: bool) -> None:
    """Print a dictionary of results by name (of an output or a search) as text, or as JSON."""
    if as_json:
        show_json({name: result.to_dict() for name, result in results.items()})
    else:
        print_text("\n\n".join(f"{name}\n{result}" for name, result in results.items()))


@contextlib.contextmanager
def resumable(path: str | None, resume_command: str | None = None) -> Iterator[None]:
    """Context manager that prints on Ctrl-C how to resume from the checkpoint file `path`.

    `resume_command` is the command to print; by default ``ftlm resume PATH``. Without a checkpoint file, Ctrl-C is not
    handled.
    """
    try:
        yield
    except KeyboardInterrupt:
        if path is None or not Path(path).exists():
            raise
        print(f"ftlm: interrupted; go on with: {resume_command or f'ftlm resume {path}'}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def show_notes(store: Store) -> None:
    """Print the notes on a checkpoint file, such as repairs of a damaged file, to standard error."""
    for note in store.notes:
        print(f"ftlm: {store.path}: {note}", file=sys.stderr)


@command
def resume(store: str, *, recover: bool = False, threads: int | None = None, as_json: bool = False) -> None:
    """Resume the searches of a checkpoint file and print their results; no other file is needed.

    Options
    -------
    recover
        Resume from a damaged file, of which a copy is kept.
    """
    results = {}
    with resumable(store), Store(store, recover=recover) as open_store:
        show_notes(open_store)
        listener = Progress("", quiet=as_json)
        if not listener.quiet:
            announce_time(
                listener, [job_of(open_store, n, threads) for n in range(len(open_store.contents.requests))], open_store
            )
        for number, request in enumerate(open_store.contents.requests):
            with Progress(f"searching orders of {request.name}", quiet=as_json) as progress:
                results[request.name] = resume_job(open_store, number, threads=threads, progress=progress)
    show_by_output(results, as_json=as_json)


@command
def status(store: str, *, as_json: bool = False) -> None:
    """Print the progress of the searches of a checkpoint file, which may be in use."""
    states = search_status(store)
    if as_json:
        show_json({name: state.to_dict() for name, state in states.items()})
    else:
        print("\n".join(str(state) for state in states.values()))


@dataclass(frozen=True)
class ResponseOptions:
    """Options for reading frequency responses; the value None marks an option that is not given.

    File
    ----
    columns : PART=COLUMN
        Column of frequency, real, imag, magnitude, phase, deviation.
    frequency_unit : UNIT
        Hz, kHz, MHz, mHz or rad/s; default the file's.
    magnitude_unit
        Unit of magnitudes; default the file's, or abs.
    phase_unit
        Unit of phases; default the file's, or deg.
    negated
        Whether the imaginary column is -Z''; default by its name.
    output : NAME
        Output of the response.
    input : NAME
        Input of the response.
    """

    columns: list[str] | None = None
    frequency_unit: str | None = None
    magnitude_unit: Literal["dB", "abs"] | None = None
    phase_unit: Literal["deg", "rad"] | None = None
    negated: Annotated[bool | None, OptionDetails(flags=("--negated/--not-negated",))] = None
    output: Annotated[str | None, OptionDetails(flags=("-y", "--output"))] = None
    input: Annotated[str | None, OptionDetails(flags=("-u", "--input"))] = None
    separator: Literal["comma", "semicolon", "tab", "space"] | None = None
    decimal: Literal["point", "comma"] | None = None
    thousands: Literal["none", "point", "comma", "space", "apostrophe"] | None = None
    skip: int | None = None
    header: int | None = None
    sheet: str | None = None

    def load(self, file: str) -> FrequencyData:
        """Read the frequency response in a file with these options."""
        layout = layout_options(self)
        options = {name: value for name, value in given_fields(self).items() if name not in layout}
        columns: dict[str, Any] | None = pairs("--columns", options.pop("columns", None)) or None
        return load_frequency(file, columns=columns, layout=layout, **options)


@command
def identify_frequency(
    files: list[str],
    *,
    structure: Annotated[str, OptionDetails(flags=("--structure", "--circuit"))],
    weights: Weights = "auto",
    reading: ResponseOptions,
    orders: list[str] | None = None,
    fixed: list[str] | None = None,
    delay: list[str] | None = None,
    start: list[str] | None = None,
    bounds: list[str] | None = None,
    out: OptionalOutputJson = None,
    report: OptionalOutputPage = None,
    validation: str | None = None,
    force: bool = False,
    verbose: bool = False,
    as_json: bool = False,
) -> None:
    """Identify a model from a frequency response or impedance, with 95 % intervals.

    Arguments
    ---------
    files : FILE...
        Frequency responses or impedance spectra.

    Structure
    ---------
    structure : EQUATION|CIRCUIT
        Equation 'D y = a y + b u', or circuit 'R0-p(R1,CPE1)'.
    orders : NAME=VALUE
        Fix an order, or give its grid LOW:HIGH:STEP.

    Method
    ------
    weights
        Weights; auto: deviations if the file has them.
    start : NAME=VALUE
        Additional initial guess of a free parameter.

    Output
    ------
    validation : FILE
        Validate the model on this response.
    """
    if structure.startswith(("flexible-link", "arm:")) or structure == "auto":
        raise ModelError(f"--structure {structure!r}: a frequency response needs an equation, such as 'D y = a y + u'")
    records = [reading.load(file) for file in files]
    with Progress("fitting", quiet=as_json) as progress:
        result = frequency_estimation(
            records,
            structure,
            weights=weights,
            orders=dict(pairs("--orders", orders)),
            fixed=numbers("--fixed", fixed),
            delay=ranges("--delay", delay),
            start=numbers("--start", start) or None,
            bounds=cast("Any", ranges("--bounds", bounds)),
            progress=progress,
        )
    checked = None if validation is None else result.validate(reading.load(validation))
    if out is not None:
        result.model.save(out, force=force)
    if report is not None:
        result.report(report, validation=checked, force=force)
    if as_json:
        verdict_entry = {"verdict": (result.verdict if checked is None else checked.verdict).to_dict()}
        show_json({**verdict_entry, **result.to_dict(), "validation": None if checked is None else checked.to_dict()})
        return
    print_text(result.summary(checked))
    if verbose:
        print_text("\n".join(f"warning: {w}" for w in result.warnings))


@command
def select(
    files: list[str],
    *,
    structures: list[str],
    reading: ReadingOptions,
    shape: StructureOptions,
    driven_by: list[str] | None = None,
    validation: str | None = None,
    validation_window: str | None = None,
    threads: int | None = None,
    store: str | None = None,
    out: OptionalOutputJson = None,
    report: OptionalOutputPage = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Select terms and orders that improve the score on validation data.

    Structure
    ---------
    structures
        Largest structure, several to compare, or auto.

    Method
    ------
    validation : runs|blocks|FILE
        Cross-validation over runs or quarters of runs, or a run.

    Output
    ------
    store : FILE
        Checkpoint file; the same command resumes from it.
    """
    equation = check_structures(structures, shape)
    runs = reading.runs(files, equation)
    targets = [shape.structure_for_runs(text, runs) for text in structures if text != "auto"]
    candidates = "auto" if not targets else targets[0] if len(targets) == 1 else targets
    validation_file = validation if validation not in ("runs", "blocks") else None
    if validation_file is not None and not Path(validation_file).exists():
        raise ModelError(f"--validation {validation_file!r} is neither runs nor blocks nor a file; check the path")
    validation_data = validation_runs(reading, validation_file, validation_window, equation) or validation
    with resumable(store, "the same command"):
        selection = select_structure(
            runs,
            candidates,
            shape,
            driven_by=driven_by,
            validation=validation_data,
            threads=threads,
            store=store,
            quiet=as_json,
        )
    if out is not None:
        selection.best.model.save(out, force=force)
    if report is not None:
        selection.report(report, force=force)
    show(selection, as_json=as_json)


@command
def consistency(
    files: list[str],
    *,
    structure: str,
    reading: ReadingOptions,
    shape: StructureOptions,
    segments: int | None = None,
    loss: Loss | None = None,
    threads: int | None = None,
    report: OptionalOutputPage = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Identify segments of a run separately, and list the parameters that differ significantly.

    Method
    ------
    segments
        Number of segments of one run; default 2.
    """
    runs = reading.runs(files, shape.structure(structure))
    target = shape.structure_for_runs(structure, runs)
    method = OutputError() if loss is None else OutputError(loss=loss)
    with Progress("fitting segments", quiet=as_json) as progress:
        count = max(segments or 0, 2) if len(runs) == 1 else len(runs)
        progress.announce("the fits of all segments", *duration_bounds(fit_seconds(runs, target, threads, count)))
        result = consistency_module.consistency(
            runs, target, segments=segments, method=method, threads=threads, progress=progress
        )
    if report is not None:
        result.report(report, force=force)
    show(result, as_json=as_json)
