"""The command line: results to standard output, progress to standard error, exit codes that scripts can read."""

from __future__ import annotations

import contextlib
import functools
import json
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import ftlm
from ftlm import _core
from ftlm.base.checks import available_threads
from ftlm.base.errors import ModelError
from ftlm.base.output import COMMAND, check_folder, check_free, write_atomically
from ftlm.base.progress import Progress
from ftlm.cli.options import (
    EXIT_INTERRUPTED,
    EXIT_VALIDATION,
    K0,
    Between,
    Coefficients,
    CoefficientsOption,
    Columns,
    Coupling,
    CouplingOption,
    Criterion,
    CriterionOption,
    CrossStage,
    Delay,
    Drawing,
    Evaluations,
    Files,
    Fixed,
    Force,
    Friction,
    InitialOption,
    InputOrder,
    InputOrderOption,
    Inputs,
    Json,
    Keep,
    LatticeOption,
    LatticeStep,
    Laws,
    LawsOption,
    M,
    Method,
    MethodOption,
    Norm,
    NormOption,
    OnlyOutput,
    Orders,
    Out,
    Outputs,
    P,
    Resample,
    Rows,
    RowsOption,
    Seeds,
    Slice,
    Step,
    StockFilter,
    StructureOption,
    Threads,
    Time,
    Tool,
    Units,
    app,
    genetic_of,
    guarded,
    interval,
    lattice_of,
    load_options,
    load_runs,
    plain,
    show,
    structure_of,
)
from ftlm.cli.record import record
from ftlm.data.inspection import inspect_run
from ftlm.paper.demo import run_demo
from ftlm.paper.demo_page import demo_page, demo_text
from ftlm.paper.page import reproduction_text
from ftlm.paper.reproduction import ALWAYS_SAVED
from ftlm.report import plots
from ftlm.report.model_page import model_page
from ftlm.rig.quanser import driver_state
from ftlm.search.job import Job, run_job
from ftlm.search.orders import make_job, resume_job
from ftlm.search.result import SearchResult
from ftlm.search.store import Store
from ftlm.solve.exports import export_text


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
    check_free(out, report, force=force, words=COMMAND)
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
    check_free(out, force=force, words=COMMAND)
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
    check_free(out, force=force, words=COMMAND)
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
    check_free(out, force=force, words=COMMAND)
    if save is not None:
        check_folder(Path(save), ALWAYS_SAVED, force=force)
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

    check_free(out, force=force, words=COMMAND)
    suffix = Path(out).suffix.removeprefix(".").lower()
    if suffix not in ("png", "pdf", "svg"):
        raise ModelError(f"{out} ends in {suffix or 'nothing'!r}; write .png, .pdf or .svg")
    loaded = ftlm.load_model(model)
    options = load_options(time, sampling, inputs, outputs, units, columns, between, resample)
    runs = load_runs(files, sliced, **options) if files else []
    if not runs and kind is not Drawing.bode:
        raise ModelError(f"--kind {kind.value} needs at least one run; give files")
    if kind is Drawing.bode:
        figure = plots.bode(loaded)
    elif kind is Drawing.fit:
        figure = plots.fit(loaded, runs)
    else:
        figure = plots.residuals(loaded.resid(runs))
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
    check_free(out, force=force, words=COMMAND)
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
