"""Commands for designs: controllers, input shapers, optimal inputs."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from typer import Option

from ftlm import control as designs
from ftlm.cli.framework import (
    announce_design,
    check_ending,
    command,
    figure_kind,
    numbers,
    parse_numbers,
    print_text,
    say_written,
    show,
    show_json,
    write_figure,
)
from ftlm.cli.options import Force, Json, Noise, Number, ReadingOptions, SavedModel, Text, Texts
from ftlm.errors import ModelError
from ftlm.experiment_design import design_input as experiment
from ftlm.model.serialization import load_model
from ftlm.plot import matplotlib_figures as design_plots
from ftlm.progress import Progress
from ftlm.utils.files import COMMAND_MESSAGES, check_free, write_atomically

#: Options of one design only.
PID_OPTIONS = ("crossover", "phase_margin")
LQG_OPTIONS = ("allowed", "effort", "drift", "noise", "measured", "band", "poles")


@command
def control(
    *,
    model: SavedModel,
    design: Annotated[
        Literal["pid", "lqg"], Option(help="A fractional PID, or LQG: an observer (of --noise) and state feedback.")
    ] = "pid",
    signal: Annotated[
        Text, Option("--input", metavar="NAME", help="What is controlled with, if there are several.")
    ] = None,
    output: Annotated[Text, Option(metavar="NAME", help="What follows the reference, if there are several.")] = None,
    crossover: Annotated[Number, Option(help="Of the PID: where the loop's gain is 1 [rad/s].")] = None,
    phase_margin: Annotated[Number, Option(help="Of the PID: there [degrees]; default 60.")] = None,
    allowed: Annotated[
        Texts, Option(metavar="OUTPUT=A", help="Of LQG: a deviation as dear as --effort; sums such as a+b, too.")
    ] = None,
    effort: Annotated[Number, Option(help="Of LQG: of the input, in its unit.")] = None,
    drift: Annotated[
        Number, Option(help="Of LQG: what is unknown of the input walks so far in a second; default effort/5.")
    ] = None,
    noise: Noise = None,
    measured: Annotated[Texts, Option(metavar="OUTPUT", help="Of LQG: an output it reads; default all.")] = None,
    band: Annotated[
        Text, Option(metavar="LOW:HIGH", help="Of LQG: where its poles stand for the model [rad/s].")
    ] = None,
    poles: Annotated[int | None, Option(help="Of LQG: their number; default what makes them good.")] = None,
    rate: Annotated[float, Option(help="Of the loop [Hz].")] = 500.0,
    limit: Annotated[Number, Option(help="Largest command.")] = None,
    move: Annotated[
        Text, Option(metavar="SIZE:SECONDS", help="Plan a smooth move of --of along which the loop leads it.")
    ] = None,
    of: Annotated[
        Text, Option(metavar="OUTPUTS", help="What moves so, such as theta11+theta12; default --output.")
    ] = None,
    plan: Annotated[
        Text, Option(metavar="FILE", help="Its reference, row by row, with command and path, .csv.")
    ] = None,
    samples: Annotated[int, Option(help="Of the model's numbers, from their covariance, to be judged.")] = 100,
    seed: Annotated[int, Option(min=0, help="Of these samples.")] = 0,
    out: Annotated[Text, Option("-o", "--out", metavar="FILE", help="Controller to write, .json.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design a controller on a model: margins, their ranges over the model's uncertainty, controller file."""
    given = dict(locals())
    check_free(out, plan, force=force, words=COMMAND_MESSAGES)
    check_ending(out, ".json")
    check_ending(plan, ".csv")
    if plan is not None and move is None:
        raise ModelError("--plan is of a move; give --move SIZE:SECONDS")
    if of is not None and move is None:
        raise ModelError("--of is of a move; give --move SIZE:SECONDS")
    wrong = [n for n in (LQG_OPTIONS if design == "pid" else PID_OPTIONS) if given[n] not in (None, [])]
    if wrong:
        other = "lqg" if design == "pid" else "pid"
        shown = ", ".join("--" + n.replace("_", "-") for n in wrong)
        raise ModelError(f"{shown}: of --design {other}, not used with {design}; leave out what is not meant")
    loaded = load_model(model)
    most = np.inf if limit is None else limit
    common: dict[str, Any] = {"input": signal, "output": output, "rate": rate, "samples": samples, "seed": seed}
    found: designs.PidDesign | designs.LqgDesign
    running: designs.DiscretePid | designs.Lqg
    if design == "pid":
        if crossover is None:
            raise ModelError("--crossover is missing: where the loop's gain is to be 1 [rad/s]")
        announce_design(design, samples)
        found = designs.fractional_pid(
            loaded, crossover=crossover, phase_margin=60.0 if phase_margin is None else phase_margin, **common
        )
        running = designs.DiscretePid(found.pid, rate, limit=most)
    else:
        if effort is None or not allowed:
            raise ModelError(
                "--allowed OUTPUT=A and --effort A are missing: which deviations are as dear as which input"
            )
        low_high = None if band is None else parse_numbers("--band", band, 2)
        announce_design(design, samples)
        found = designs.lqg(
            loaded,
            max_deviation=numbers("--allowed", allowed),
            max_input=effort,
            process_noise=drift,
            noise=numbers("--noise", noise) or None,
            measured=measured or None,
            limit=most,
            poles=poles,
            band=None if low_high is None else (low_high[0], low_high[1]),
            **common,
        )
        running = found.controller
    planned = None
    if move is not None:
        size, seconds = parse_numbers("--move", move, 2)
        path = designs.point_to_point(size, seconds, rate)
        told = found.plants[0].output if design == "pid" else running.tracked  # type: ignore[union-attr]
        planned = designs.inverse_dynamics(
            found, path, output=of or told, limit=most, samples=min(samples, 40), seed=seed
        )
    if out is not None:
        designs.save_controller(running, out, model=f"{loaded.structure.name} ({Path(model).name})", force=force)
    if plan is not None and planned is not None:
        _write_trajectory(planned, rate, plan, force=force)
    if as_json:
        show_json(found.to_dict() | {"planned": None if planned is None else planned.to_dict()})
        return
    for line in (found, *([running] if design == "pid" else []), *([planned] if planned is not None else [])):
        print_text(str(line))
    say_written(out, plan)


@command
def shape(
    *,
    model: SavedModel,
    kind: Annotated[Literal["zv", "zvd"], Option(help="zvd bears an error of the pole, at twice the delay.")] = "zv",
    modes: Annotated[int, Option(help="How many modes, the least damped first.")] = 1,
    coupling: Annotated[
        Literal["simulated", "measured"], Option(help="Poles of the equations together, or of each alone.")
    ] = "simulated",
    rate: Annotated[float, Option(help="Of the reference [Hz].")] = 500.0,
    out: Annotated[
        Text, Option("-o", "--out", metavar="FILE", help="Its samples to write, .csv: convolve a reference with them.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design an input shaper from the poles of a model."""
    check_free(out, force=force, words=COMMAND_MESSAGES)
    check_ending(out, ".csv")
    made = designs.input_shaper(load_model(model), kind, modes=modes, coupling=coupling)
    taps = made.impulses(rate)
    if out is not None:
        rows = np.column_stack([np.arange(taps.size) / rate, taps])
        _write_table(rows, ("time_s", "share"), out, force=force)
    if as_json:
        show_json(made.to_dict() | {"rate": rate, "samples": taps})
        return
    print_text(str(made))
    say_written(out)


def _write_trajectory(planned: designs.Trajectory, rate: float, path: str, *, force: bool) -> None:
    """Write a trajectory as csv rows."""
    time = np.arange(len(planned.path)) / rate
    rows = np.column_stack([time, planned.reference, planned.command, planned.path, *planned.outputs.values()])
    _write_table(rows, ("time_s", "reference", "command", "path", *planned.outputs), path, force=force)


def _write_table(rows: np.ndarray[Any, Any], names: tuple[str, ...], path: str, *, force: bool) -> None:
    text = io.StringIO()
    text.write(",".join(names) + "\n")
    np.savetxt(text, rows, fmt="%.12g", delimiter=",")
    write_atomically(path, text.getvalue().encode(), force=force)


@command
def design_input(
    *,
    model: SavedModel,
    like: Annotated[
        Text, Option(metavar="FILE", help="A run that the machine bore: what is not said is as in it.")
    ] = None,
    reading: ReadingOptions,
    duration: Annotated[Number, Option(help="Length of the run [s].")] = None,
    peak: Annotated[
        Texts, Option(metavar="A or INPUT=A", help="Largest size of each input, or of one of several.")
    ] = None,
    slew: Annotated[
        Texts, Option(metavar="A or INPUT=A", help="Fastest change of an input, a second; default none.")
    ] = None,
    limits: Annotated[
        Texts, Option("--limit", metavar="OUTPUT=A", help="Largest size of an output, in the model's units; or inf.")
    ] = None,
    names: Annotated[
        Texts, Option("--for", metavar="NAME", help="A number to be told; default every free order.")
    ] = None,
    criterion: Annotated[
        Literal["D", "E"], Option(help="D: all their intervals together; E: the widest of them.")
    ] = "D",
    noise: Noise = None,
    period: Annotated[Number, Option(help="Of the square set beside it [s]; default a fifth of the duration.")] = None,
    seed: Annotated[int, Option(min=0, help="Of random inputs to begin with.")] = 0,
    out: Annotated[
        Text, Option("-o", "--out", metavar="FILE", help="Run to write, .csv: ftlm record --input csv takes it.")
    ] = None,
    picture: Annotated[Text, Option("--plot", metavar="FILE", help="Figure to write: .png, .pdf or .svg.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design the input that determines the parameters best within the limits of the machine."""
    check_free(out, picture, force=force, words=COMMAND_MESSAGES)
    check_ending(out, ".csv", ", as a run for a rig does")
    figure_kind(picture)
    loaded = load_model(model)
    run = None if like is None else reading.runs([like])[0]
    with Progress("designing", quiet=as_json) as progress:
        found = experiment.design_input(
            loaded,
            reference_run=run,
            duration=duration,
            step=None if like is not None else reading.sampling,
            peak=_sizes("--peak", peak),
            slew=_sizes("--slew", slew),
            limits=numbers("--limit", limits) or None,
            parameters=names,
            criterion=criterion,
            noise=numbers("--noise", noise) or None,
            period=period,
            seed=seed,
            progress=progress,
        )
    if out is not None:
        found.save(out, force=force)
    if picture is not None:
        write_figure(design_plots.design(found), picture, force=force)
    show(found, as_json=as_json)
    if not as_json:
        say_written(out, picture)


def _sizes(option: str, given: list[str] | None) -> float | dict[str, float] | None:
    """Return one number for all inputs, or numbers by name."""
    if given and len(given) == 1 and "=" not in given[0]:
        try:
            return float(given[0])
        except ValueError:
            raise ModelError(f"{option} {given[0]!r} is neither a number nor INPUT=NUMBER") from None
    return numbers(option, given) or None
