"""Commands record and doctor, for experiments on a rig and for the installation."""

from __future__ import annotations

import json
import math
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any, Literal

import typer

from ftlm import _core
from ftlm.arm.flexible_link import flexible_link
from ftlm.cli.framework import NonNegative, command, numbers, parse_numbers
from ftlm.cli.reading_options import given_fields
from ftlm.data.run import Run
from ftlm.errors import FtlmError, ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.linear import Streaming
from ftlm.estimation.methods import MultiInnovation
from ftlm.estimation.result import Identification
from ftlm.progress import Progress
from ftlm.rig import recording as experiment
from ftlm.rig.arm_parameters import ArmParameters
from ftlm.rig.quanser import driver_state
from ftlm.rig.rig import SignalHandlers
from ftlm.structure.parser import equation
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import available_threads

#: (file types, extra of ftlm that installs the package) by the name of a package for reading files.
_READER_PACKAGES = {
    "scipy": (".mat files", "mat"),
    "h5py": (".mat files of version 7.3 and HDF5", "hdf5"),
    "pyarrow": ("parquet and feather", "parquet"),
    "python-calamine": ("xlsx and ods", "excel"),
}


@command
def doctor(*, as_json: bool = False) -> None:
    """Print versions, processor cores, vector unit, and whether the driver of the rig is installed."""
    about: dict[str, Any] = {
        "ftlm": _core.__version__,
        "core": _core.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": available_threads(),
        "simd": _core.SIMD,
        "numpy": _installed_version("numpy"),
        **{package: _installed_version(package) for package in _READER_PACKAGES},
        "rig driver": driver_state(),
    }
    if as_json:
        print(json.dumps(about, indent=1))
        return
    for name, value in about.items():
        print(f"{name:<17}{value if value is not None else 'not installed'}")
    for package, (files, extra) in _READER_PACKAGES.items():
        if about[package] is None:
            print(f"{package} is needed for {files}: pip install 'ftlm[{extra}]'")


def _installed_version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True)
class LiveOptions:
    """Options of the streaming identification during a recording.

    Options
    -------
    live : STRUCTURE
        Identify while recording: flexible-link:1, :2, an equation.
    orders : NAME=VALUE
        Fix an order of --live; default the arm's.
    innovation_length
        Innovation length of --live; default 7.
    prior_covariance
        Prior covariance of --live; default weak.
    """

    live: str | None = None
    orders: list[str] | None = None
    innovation_length: int | None = None
    prior_covariance: float | None = None

    def stream(self, rig: str, parameters: str, rate: float, limit: float) -> Streaming | None:
        """Return the streaming estimator that --live requests; None without this option.

        `rig` and `parameters` are the values of these options of the command, `rate` is the sampling rate [Hz], and
        `limit` is the maximum duration of the run [s]. Raise ModelError for invalid options.
        """
        if self.live is None:
            useless = [parameter(name) for name in given_fields(self)]
            if useless:
                raise ModelError(f"{', '.join(useless)}: only valid with --live; remove the option, or add --live")
            return None
        orders = numbers("--orders", self.orders)
        if self.live.startswith("flexible-link:"):
            stages: dict[str, Literal[1, 2]] = {"1": 1, "2": 2}
            stage = stages.get(self.live.removeprefix("flexible-link:"))
            if stage is None:
                raise ModelError(
                    f"--live {self.live!r} is not known; use flexible-link:1, flexible-link:2 or an equation"
                )
            structure = flexible_link(stage=stage, laws=("orders",), coupling="measured")
            if rig == "virtual":
                arm = ArmParameters.load(parameters)
                default_orders = (arm.stage1 if stage == 1 else arm.stage2).orders(stage)
                orders = {n: v for n, v in default_orders.items() if n in structure.order_names} | orders
        else:
            structure = equation(self.live)
        return Streaming(
            structure.with_orders(orders),
            step=1.0 / rate,
            max_duration=limit + 1.0,
            innovation_length=self.method.innovation_length,
            prior_covariance=self.method.prior_covariance,
        )

    @property
    def method(self) -> MultiInnovation:
        """Multi-innovation method of the streaming estimator, with the options that the user set."""
        given = {n: v for n, v in vars(self).items() if n in ("innovation_length", "prior_covariance")}
        return MultiInnovation(row_basis="time", **{n: v for n, v in given.items() if v is not None})

    def identify(self, run: Run, stream: Streaming) -> Identification | None:
        """Identify the model of the streaming estimator from the whole recorded run, for a result with a verdict.

        Return None if the identification fails, as for a run that was stopped early.
        """
        try:
            return identify(run, replace(stream.structure, initial="rest"), method=self.method, m=stream.pulses)
        except FtlmError:
            return None


@command
def record(
    *,
    out: str,
    rig: str = "virtual",
    input: str = "square",
    amplitude: str = "0.3",
    period: float | None = None,
    band: str = "0.1:20",
    ramp: float = 0.0,
    file: str | None = None,
    duration: float = 10.0,
    limit: float = 30.0,
    rate: float = 500.0,
    seed: NonNegative = 0,
    parameters: str = "effective",
    offset: str | None = None,
    real_time: bool = False,
    sensor_filter: Literal["stock"] | None = None,
    watchdog: float = 0.1,
    arm: bool = False,
    board: str = "0",
    live: LiveOptions,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Run an experiment on a rig, simulated by default, and record it as a run.

    Options
    -------
    out : FILE
        Write the run to this .csv or .parquet file.
    rig
        Rig: virtual or q8.
    input
        square, sine, chirp, multisine, prbs, doublet or csv.
    amplitude : A or A1:A2
        Amplitude of the current [A], of both motors or each.
    period
        Period, or switching interval of a prbs [s].
    band : LOW:HIGH
        Frequency band of chirp and multisine [Hz].
    ramp
        Time over which the amplitude rises from 0 [s].
    file
        Currents I1, I2 [A] for --input csv.
    duration
        Length of the run [s].
    limit
        Longest permitted run, at most 600 [s].
    rate
        Sampling rate [Hz].
    seed
        Seed of noise and random inputs.
    parameters : NAME or TOML
        Virtual arm: effective, measured, measured-lqr, linear.
    offset : A1:A2
        Virtual arm: current in addition to the command [A].
    real_time
        Run the virtual rig in real time.
    sensor_filter : stock
        Record through the stock 2 Hz low-pass; default none.
    watchdog
        Time without a write after which the motors are stopped [s].
    arm
        Confirm that a real arm may move.
    board
        Identifier of the Q8-USB board.
    """
    # All other options are arguments of `ftlm.rig.record`.
    arguments = {name: value for name, value in locals().items() if name not in ("live", "as_json")}
    currents = parse_numbers("--amplitude", amplitude, 1, 2)
    arguments |= {"amplitude": (currents[0], currents[-1]), "band": tuple(parse_numbers("--band", band, 2))}
    if offset is not None:
        arguments["offset"] = tuple(parse_numbers("--offset", offset, 2))
    stream = live.stream(rig, parameters, rate, limit)
    if stream is not None:
        print(f"live: {stream.structure}", file=sys.stderr)
    signals = SignalHandlers()
    try:
        signals.install()
        with Progress("recording", quiet=as_json) as progress:
            run = experiment.record(**arguments, live=stream, progress=live_reporter(stream, rate, progress))
    except (KeyboardInterrupt, SystemExit) as ended:
        signals.ignore()
        what = experiment.describe_interruption(ended)
        *errors, rows = getattr(ended, "__notes__", None) or ["nothing was recorded"]
        print(f"ftlm: {'; '.join([what, *(errors or ['the motors are at 0 V']), rows])}", file=sys.stderr)
        code = ended.code if isinstance(ended, SystemExit) else 130
        raise typer.Exit(code if isinstance(code, int) else 1) from None
    finally:
        signals.restore()
    if stream is not None:
        print(f"live, after {stream.pulses} rows: {stream}", file=sys.stderr)
        result = live.identify(run, stream)
        if result is not None:
            prior = [f"! {finding}" for finding in result.findings if finding.code == "prior_shifts_estimate"]
            print(f"live: {result.verdict}", *prior, sep="\n", file=sys.stderr)
    if as_json:
        summary = {"written": out, "rows": run.length, "step": run.step, "about": run.metadata}
        print(json.dumps(summary, indent=1, ensure_ascii=False))
    else:
        print(f"{run}\nwritten to {out}")
    missed = run.metadata["missed_deadlines"]
    if missed:
        print(f"ftlm: {missed} deadlines were missed", file=sys.stderr)


def live_reporter(stream: Streaming | None, rate: float, progress: Progress) -> Callable[[int, int], None]:
    """Return a callback that updates the progress bar from (recorded samples, total samples).

    With a streaming estimator, the callback also prints the estimate once per second of the run. `rate` is the sampling
    rate [Hz].
    """
    due = 1.0

    def report_progress(count: int, total: int) -> None:
        nonlocal due
        progress(count, total)
        seconds = count / rate
        if stream is not None and seconds >= due:
            print(f"{seconds:7.2f} s: {stream}", file=sys.stderr, flush=True)
            due = math.floor(seconds) + 1.0

    return report_progress
