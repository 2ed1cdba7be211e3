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
    output_file,
    parse_numbers,
    print_text,
    say_written,
    show,
    show_json,
    write_figure,
)
from ftlm.cli.options import NoiseDeviations, SavedModel
from ftlm.cli.reading_options import Force, Json, Number, ReadingOptions, Text, Texts
from ftlm.errors import ModelError
from ftlm.experiment_design import design_input as experiment
from ftlm.experiment_design.problem import Kind
from ftlm.model.serialization import load_model
from ftlm.plot import matplotlib_figures as design_plots
from ftlm.progress import Progress
from ftlm.utils.files import write_atomically
from ftlm.utils.parameters import parameter

#: Options of one design only.
PID_OPTIONS = ("crossover", "phase_margin")
LQG_OPTIONS = ("max_deviation", "max_input", "process_noise", "noise", "measured", "band", "poles")


@command
def control(
    *,
    model: SavedModel,
    design: Annotated[
        Literal["pid", "lqg"], Option(help="Fractional PID, or LQG: observer and state feedback.")
    ] = "pid",
    input: Annotated[Text, Option(metavar="NAME", help="Input of the loop, if the model has several.")] = None,
    output: Annotated[
        Text, Option(metavar="OUTPUT", help="Output that follows; with --path also a sum such as a+b.")
    ] = None,
    crossover: Annotated[Number, Option(help="PID: gain crossover frequency [rad/s].")] = None,
    phase_margin: Annotated[Number, Option(help="PID: phase margin [degrees]; default 60.")] = None,
    max_deviation: Annotated[
        Texts, Option(metavar="OUTPUT=A", help="LQG: acceptable deviation of an output or a sum such as a+b.")
    ] = None,
    max_input: Annotated[Number, Option(help="LQG: acceptable input, in its unit.")] = None,
    process_noise: Annotated[
        Number, Option(help="LQG: drift of the unknown input per second; default max-input/5.")
    ] = None,
    noise: NoiseDeviations = None,
    measured: Annotated[Texts, Option(metavar="OUTPUT", help="LQG: measured output; default all.")] = None,
    band: Annotated[
        Text, Option(metavar="LOW:HIGH", help="LQG: band in which its poles match the model [rad/s].")
    ] = None,
    poles: Annotated[int | None, Option(help="LQG: number of poles; default chosen by accuracy.")] = None,
    rate: Annotated[float, Option(help="Sampling rate of the loop [Hz].")] = 500.0,
    limit: Annotated[Number, Option(help="Largest command; default none.")] = None,
    path: Annotated[Text, Option(metavar="SIZE:SECONDS", help="Plan a smooth move of --output of this size.")] = None,
    trajectory: Annotated[
        Text, output_file("Write reference, command and path to this .csv file.", "--trajectory")
    ] = None,
    samples: Annotated[int, Option(help="Parameter samples on which the design is checked.")] = 100,
    seed: Annotated[int, Option(min=0, help="Seed of these samples.")] = 0,
    out: Annotated[Text, output_file("Write the controller to this .json file.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design a controller on a model: margins, their ranges over the model's uncertainty, controller file."""
    given = dict(locals())
    check_ending(out, ".json")
    check_ending(trajectory, ".csv")
    if trajectory is not None and path is None:
        raise ModelError("--trajectory is of a move; give --path SIZE:SECONDS")
    wrong = [n for n in (LQG_OPTIONS if design == "pid" else PID_OPTIONS) if given[n] not in (None, [])]
    if wrong:
        other = "lqg" if design == "pid" else "pid"
        shown = ", ".join(map(parameter, wrong))
        raise ModelError(f"{shown}: of --design {other}, not used with {design}; leave out what is not meant")
    loaded = load_model(model)
    most = np.inf if limit is None else limit
    # A sum moves along the path; the loop itself has one output.
    followed = output
    if path is not None and output is not None and "+" in output:
        followed = output.partition("+")[0].strip() if design == "pid" else None
    common: dict[str, Any] = {"input": input, "output": followed, "rate": rate, "samples": samples, "seed": seed}
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
        if max_input is None or not max_deviation:
            raise ModelError(
                "--max-deviation OUTPUT=A and --max-input A are missing: which deviations weigh as much as which input"
            )
        low_high = None if band is None else parse_numbers("--band", band, 2)
        announce_design(design, samples)
        found = designs.lqg(
            loaded,
            max_deviation=numbers("--max-deviation", max_deviation),
            max_input=max_input,
            process_noise=process_noise,
            noise=numbers("--noise", noise) or None,
            measured=measured or None,
            limit=most,
            poles=poles,
            band=None if low_high is None else (low_high[0], low_high[1]),
            **common,
        )
        running = found.controller
    planned = None
    if path is not None:
        size, seconds = parse_numbers("--path", path, 2)
        told = found.plants[0].output if design == "pid" else running.tracked  # type: ignore[union-attr]
        planned = designs.inverse_dynamics(
            found,
            designs.point_to_point(size, seconds, rate),
            output=output or told,
            limit=most,
            samples=min(samples, 40),
            seed=seed,
        )
    if out is not None:
        designs.save_controller(running, out, model=f"{loaded.structure.name} ({Path(model).name})", force=force)
    if trajectory is not None and planned is not None:
        _write_trajectory(planned, rate, trajectory, force=force)
    if as_json:
        show_json(found.to_dict() | {"planned": None if planned is None else planned.to_dict()})
        return
    for line in (found, *([running] if design == "pid" else []), *([planned] if planned is not None else [])):
        print_text(str(line))
    say_written(out, trajectory)


@command
def input_shaper(
    *,
    model: SavedModel,
    kind: Annotated[Literal["zv", "zvd"], Option(help="zvd tolerates pole errors, at twice the delay.")] = "zv",
    modes: Annotated[int, Option(help="Number of modes, the least damped first.")] = 1,
    coupling: Annotated[
        Literal["simulated", "measured"], Option(help="Poles of the equations together, or of each alone.")
    ] = "simulated",
    rate: Annotated[float, Option(help="Sampling rate of the reference [Hz].")] = 500.0,
    out: Annotated[Text, output_file("Write its impulse response to this .csv file.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design an input shaper from the poles of a model."""
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
    reference_run: Annotated[
        Text, Option(metavar="FILE", help="Admissible run, whose limits and step are the defaults.")
    ] = None,
    reading: ReadingOptions,
    duration: Annotated[Number, Option(help="Length of the run [s].")] = None,
    peak: Annotated[
        Texts, Option(metavar="A or INPUT=A", help="Largest absolute value of each input, or of one.")
    ] = None,
    slew: Annotated[
        Texts, Option(metavar="A or INPUT=A", help="Largest rate of change of an input [1/s]; default none.")
    ] = None,
    limits: Annotated[Texts, Option(metavar="OUTPUT=A", help="Largest absolute value of an output, or inf.")] = None,
    parameters: Annotated[
        Texts, Option(metavar="NAME", help="Parameter of interest; default every free order.")
    ] = None,
    criterion: Annotated[Kind, Option(help="Criterion: D (all intervals together) or E (the widest).")] = "D",
    noise: NoiseDeviations = None,
    period: Annotated[
        Number, Option(help="Period of the reference square wave [s]; default a fifth of the duration.")
    ] = None,
    seed: Annotated[int, Option(min=0, help="Seed of random initial inputs.")] = 0,
    out: Annotated[Text, output_file("Write the run to this .csv file for ftlm record.")] = None,
    plot: Annotated[Text, output_file("Write a figure to this .png, .pdf or .svg file.", "--plot")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design the input that determines the parameters best within the limits of the machine."""
    check_ending(out, ".csv", ", as a run for a rig does")
    figure_kind(plot)
    loaded = load_model(model)
    run = None if reference_run is None else reading.runs([reference_run], loaded.structure)[0]
    with Progress("designing", quiet=as_json) as progress:
        found = experiment.design_input(
            loaded,
            reference_run=run,
            duration=duration,
            step=None if reference_run is not None else reading.step,
            peak=_sizes("--peak", peak),
            slew=_sizes("--slew", slew),
            limits=numbers("--limits", limits) or None,
            parameters=parameters,
            criterion=criterion,
            noise=numbers("--noise", noise) or None,
            period=period,
            seed=seed,
            progress=progress,
        )
    if out is not None:
        found.save(out, force=force)
    if plot is not None:
        write_figure(design_plots.design(found), plot, force=force)
    show(found, as_json=as_json)
    if not as_json:
        say_written(out, plot)


def _sizes(option: str, given: list[str] | None) -> float | dict[str, float] | None:
    """Return one number for all inputs, or numbers by name."""
    if given and len(given) == 1 and "=" not in given[0]:
        try:
            return float(given[0])
        except ValueError:
            raise ModelError(f"{option} {given[0]!r} is neither a number nor INPUT=NUMBER") from None
    return numbers(option, given) or None
