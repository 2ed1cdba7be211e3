"""Commands control, input-shaper and design-input."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ftlm import control as designs
from ftlm.cli.framework import (
    NonNegative,
    OptionalOutputCsv,
    OptionalOutputFile,
    OptionalOutputJson,
    announce_design,
    command,
    figure_kind,
    numbers,
    parse_numbers,
    print_text,
    print_written_files,
    show,
    show_json,
    write_figure,
)
from ftlm.cli.reading_options import ReadingOptions
from ftlm.errors import ModelError
from ftlm.experiment_design import design_input as experiment
from ftlm.experiment_design.problem import Kind
from ftlm.model.serialization import load_model
from ftlm.plot import matplotlib_figures as design_plots
from ftlm.progress import Progress
from ftlm.utils.files import write_atomically
from ftlm.utils.parameters import parameter

#: Options that only the PID design uses, and options that only the LQG design uses.
PID_OPTIONS = ("crossover", "phase_margin")
LQG_OPTIONS = ("max_deviation", "max_input", "process_noise", "noise", "measured", "band", "poles")


@command
def control(
    model: str,
    *,
    design: Literal["pid", "lqg"] = "pid",
    input: str | None = None,
    output: str | None = None,
    crossover: float | None = None,
    phase_margin: float | None = None,
    max_deviation: list[str] | None = None,
    max_input: float | None = None,
    process_noise: float | None = None,
    noise: list[str] | None = None,
    measured: list[str] | None = None,
    band: str | None = None,
    poles: int | None = None,
    rate: float = 500.0,
    limit: float | None = None,
    path: str | None = None,
    trajectory: OptionalOutputCsv = None,
    samples: int = 100,
    seed: NonNegative = 0,
    out: OptionalOutputJson = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Design a controller for a model, and print stability margins with 95 % intervals over the model uncertainty.

    Options
    -------
    design
        Fractional PID, or LQG: observer and state feedback.
    input : NAME
        Input of the loop, if the model has several.
    output : OUTPUT
        Controlled output; with --path also a sum such as a+b.
    crossover
        PID: gain crossover frequency [rad/s].
    phase_margin
        PID: phase margin [degrees]; default 60.
    max_deviation : OUTPUT=A
        LQG: acceptable deviation of an output or a sum such as a+b.
    max_input
        LQG: acceptable input, in its unit.
    process_noise
        LQG: change of the input disturbance in 1 s; default max-input/5.
    measured : OUTPUT
        LQG: measured output; default all.
    band : LOW:HIGH
        LQG: band in which its poles match the model [rad/s].
    poles
        LQG: number of poles; default chosen by accuracy.
    rate
        Sampling rate of the loop [Hz].
    limit
        Maximum command; default none.
    path : SIZE:SECONDS
        Plan a smooth move of --output of this size.
    trajectory : FILE
        Write reference, command and path to this .csv file.
    samples
        Parameter samples on which the design is checked.
    seed
        Seed of the parameter samples.
    out : FILE
        Write the controller to this .json file.
    """
    arguments = dict(locals())
    if trajectory is not None and path is None:
        raise ModelError("--trajectory needs a move; give --path SIZE:SECONDS")
    inapplicable = [n for n in (LQG_OPTIONS if design == "pid" else PID_OPTIONS) if arguments[n] not in (None, [])]
    if inapplicable:
        other_design = "lqg" if design == "pid" else "pid"
        text = ", ".join(map(parameter, inapplicable))
        raise ModelError(
            f"{text}: used with --design {other_design}, not with {design}; leave it out, or change --design"
        )
    loaded = load_model(model)
    maximum = np.inf if limit is None else limit
    # The path may apply to a sum of outputs, but the loop controls a single output.
    tracked_output = output
    if path is not None and output is not None and "+" in output:
        tracked_output = output.partition("+")[0].strip() if design == "pid" else None
    common: dict[str, Any] = {"input": input, "output": tracked_output, "rate": rate, "samples": samples, "seed": seed}
    result: designs.PidDesign | designs.LqgDesign
    discrete_controller: designs.DiscretePid | designs.Lqg
    if design == "pid":
        if crossover is None:
            raise ModelError("--crossover is missing; give the frequency at which the loop gain is 1 [rad/s]")
        announce_design(design, samples)
        result = designs.fractional_pid(
            loaded, crossover=crossover, phase_margin=60.0 if phase_margin is None else phase_margin, **common
        )
        discrete_controller = designs.DiscretePid(result.pid, rate, limit=maximum)
    else:
        if max_input is None or not max_deviation:
            raise ModelError(
                "--max-deviation OUTPUT=A and --max-input A are missing; give the acceptable deviations and input"
            )
        low_high = None if band is None else parse_numbers("--band", band, 2)
        announce_design(design, samples)
        result = designs.lqg(
            loaded,
            max_deviation=numbers("--max-deviation", max_deviation),
            max_input=max_input,
            process_noise=process_noise,
            noise=numbers("--noise", noise) or None,
            measured=measured or None,
            limit=maximum,
            poles=poles,
            band=None if low_high is None else (low_high[0], low_high[1]),
            **common,
        )
        discrete_controller = result.controller
    planned = None
    if path is not None:
        distance, seconds = parse_numbers("--path", path, 2)
        tracked = result.plants[0].output if design == "pid" else discrete_controller.tracked  # type: ignore[union-attr]
        planned = designs.inverse_dynamics(
            result,
            designs.point_to_point(distance, seconds, rate),
            output=output or tracked,
            limit=maximum,
            samples=min(samples, 40),
            seed=seed,
        )
    if out is not None:
        designs.save_controller(
            discrete_controller, out, model=f"{loaded.structure.name} ({Path(model).name})", force=force
        )
    if trajectory is not None and planned is not None:
        _write_trajectory(planned, rate, trajectory, force=force)
    if as_json:
        show_json(result.to_dict() | {"planned": None if planned is None else planned.to_dict()})
        return
    for line in (
        result,
        *([discrete_controller] if design == "pid" else []),
        *([planned] if planned is not None else []),
    ):
        print_text(str(line))
    print_written_files(out, trajectory)


@command
def input_shaper(
    model: str,
    *,
    kind: Literal["zv", "zvd"] = "zv",
    modes: int = 1,
    coupling: Literal["simulated", "measured"] = "simulated",
    rate: float = 500.0,
    out: OptionalOutputCsv = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Design an input shaper from the poles of a model.

    Options
    -------
    kind
        zvd tolerates pole errors, at twice the delay.
    modes
        Number of modes, the least damped first.
    coupling
        Poles of the coupled equations, or of each equation alone.
    rate
        Sampling rate of the reference [Hz].
    out : FILE
        Write the shaper's impulse response to this .csv file.
    """
    shaper = designs.input_shaper(load_model(model), kind, modes=modes, coupling=coupling)
    taps = shaper.impulses(rate)
    if out is not None:
        rows = np.column_stack([np.arange(taps.size) / rate, taps])
        _write_table(rows, ("time_s", "share"), out, force=force)
    if as_json:
        show_json(shaper.to_dict() | {"rate": rate, "samples": taps})
        return
    print_text(str(shaper))
    print_written_files(out)


def _write_trajectory(planned: designs.Trajectory, rate: float, path: str, *, force: bool) -> None:
    """Write a trajectory as a csv file with the columns time [s], reference, command, path, and the outputs."""
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
    model: str,
    *,
    reference_run: str | None = None,
    reading: ReadingOptions,
    duration: float | None = None,
    peak: list[str] | None = None,
    slew: list[str] | None = None,
    limits: list[str] | None = None,
    parameters: list[str] | None = None,
    criterion: Kind = "D",
    noise: list[str] | None = None,
    period: float | None = None,
    seed: NonNegative = 0,
    out: OptionalOutputCsv = None,
    plot: OptionalOutputFile = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Design the input that minimizes the confidence intervals of the parameters within the limits of the machine.

    Options
    -------
    reference_run : FILE
        Admissible run, whose limits and step are the defaults.
    duration
        Length of the run [s].
    peak : A or INPUT=A
        Maximum absolute value of all inputs, or of one.
    slew : A or INPUT=A
        Maximum rate of change of an input [1/s]; default none.
    limits : OUTPUT=A
        Maximum absolute value of an output, or inf.
    parameters : NAME
        Parameter of interest; default every free order.
    criterion
        Criterion: D (all intervals together) or E (the widest).
    period
        Period of the reference square wave [s]; default a fifth of the duration.
    seed
        Seed of random initial inputs.
    out : FILE
        Write the run to this .csv file for ftlm record.
    plot : FILE
        Write a figure to this .png, .pdf or .svg file.
    """
    figure_kind(plot)
    loaded = load_model(model)
    run = None if reference_run is None else reading.runs([reference_run], loaded.structure)[0]
    with Progress("designing", quiet=as_json) as progress:
        result = experiment.design_input(
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
        result.save(out, force=force)
    if plot is not None:
        write_figure(design_plots.design(result), plot, force=force)
    show(result, as_json=as_json)
    if not as_json:
        print_written_files(out, plot)


def _sizes(option: str, texts: list[str] | None) -> float | dict[str, float] | None:
    """Parse the values of an option: one number for all inputs, or numbers by input name; None without values.

    Raise ModelError for other text.
    """
    if texts and len(texts) == 1 and "=" not in texts[0]:
        try:
            return float(texts[0])
        except ValueError:
            raise ModelError(
                f"{option} {texts[0]!r} is neither a number nor INPUT=NUMBER; give one of the two"
            ) from None
    return numbers(option, texts) or None
