"""The command `ftlm record`."""

from __future__ import annotations

import json
import math
import sys
from typing import Annotated, Literal

import typer

from ftlm.arm.link import flexible_link
from ftlm.base.errors import ModelError
from ftlm.base.progress import Progress
from ftlm.cli.options import numbers
from ftlm.data.language import equation
from ftlm.data.run import Run
from ftlm.fit.streaming import Streaming
from ftlm.rig import experiment
from ftlm.rig.virtual import ArmParameters


def record(
    out: Annotated[str, typer.Option("-o", "--out", metavar="FILE", help="Run to write, .csv or .parquet.")],
    rig: Annotated[str, typer.Option("--rig", help="virtual or q8.")] = "virtual",
    shape: Annotated[
        str, typer.Option("--input", help="square, sine, chirp, multisine, prbs, doublet or csv.")
    ] = "square",
    amplitude: Annotated[
        str, typer.Option("--amplitude", metavar="A or A1:A2", help="Largest current [A] of both motors, or of each.")
    ] = "0.3",
    period: Annotated[float | None, typer.Option("--period", help="Period [s]; of a prbs its clock.")] = None,
    band: Annotated[str, typer.Option("--band", metavar="LOW:HIGH", help="Of chirp and multisine [Hz].")] = "0.1:20",
    ramp: Annotated[float, typer.Option("--ramp", help="Time over which the amplitude grows [s].")] = 0.0,
    file: Annotated[str | None, typer.Option("--file", help="Currents I1, I2 [A] for --input csv.")] = None,
    duration: Annotated[float, typer.Option("--duration", help="Length of the run [s].")] = 10.0,
    limit: Annotated[float, typer.Option("--limit", help="Longest run that is allowed [s], at most 600.")] = 30.0,
    rate: Annotated[float, typer.Option("--rate", help="Samples per second.")] = 500.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of noise and random inputs.")] = 0,
    parameters: Annotated[
        str, typer.Option("--parameters", metavar="NAME or TOML", help="Virtual arm: effective, linear or a file.")
    ] = "effective",
    paced: Annotated[bool, typer.Option("--real-time", help="Pace the virtual rig.")] = False,
    stock_filter: Annotated[
        bool, typer.Option("--stock-filter", help="Record behind the stock 2 Hz low-pass.")
    ] = False,
    watchdog: Annotated[float, typer.Option("--watchdog", help="Time after which the motors are stopped [s].")] = 0.1,
    arm: Annotated[bool, typer.Option("--arm", help="Real hardware: yes, the arm may move.")] = False,
    card: Annotated[str, typer.Option("--card", help="Which Q8-USB board.")] = "0",
    live: Annotated[
        str | None,
        typer.Option("--live", metavar="STRUCTURE", help="Identify meanwhile: flexible-link:1, :2, an equation."),
    ] = None,
    orders: Annotated[
        list[str] | None, typer.Option("--order", metavar="NAME=VALUE", help="Orders of --live; default the arm's own.")
    ] = None,
    p: Annotated[int, typer.Option("--p", help="Innovation length of --live.")] = 7,
    k0: Annotated[float, typer.Option("--k0", help="Prior covariance of --live.")] = 1.0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Results as JSON.")] = False,
) -> None:
    """Drive a rig, simulated by default, and record a run that every other command reads."""
    currents = _floats("--amplitude", amplitude, (1, 2))
    low, high = _floats("--band", band, (2,))

    stream = None if live is None else _stream(live, orders, rig, parameters, rate, limit, p, k0)

    def recorded(progress: Progress) -> Run:
        shown = _Shown(stream, rate, progress)
        return experiment.record(
            rig, input=shape, amplitude=(currents[0], currents[-1]), period=period,
            band=(low, high), ramp=ramp, file=file, duration=duration, limit=limit, rate=rate, seed=seed,
            parameters=parameters, paced=paced, sensor_filter="stock" if stock_filter else None, watchdog=watchdog,
            arm=arm, card=card, out=out, force=force, live=stream, progress=shown,
        )  # fmt: skip

    try:
        with Progress("recording", quiet=as_json) as progress:
            run = recorded(progress)
    except (KeyboardInterrupt, SystemExit) as ended:
        what = experiment.stopped_by(ended)
        print(f"ftlm: {what}; the motors are at 0 V, what was recorded is in {out}", file=sys.stderr)
        code = ended.code if isinstance(ended, SystemExit) else 130
        raise typer.Exit(code if isinstance(code, int) else 1) from None
    if stream is not None:
        print(f"live, after {stream.pulses} rows: {stream}", file=sys.stderr)
    if as_json:
        told = {"written": out, "rows": run.length, "step": run.step, "about": run.about}
        print(json.dumps(told, indent=1, ensure_ascii=False))
    else:
        print(f"{run}\nwritten to {out}")
    missed = run.about["missed_deadlines"]
    if missed:
        print(f"ftlm: {missed} deadlines were missed", file=sys.stderr)


class _Shown:
    """Shows the live estimate once a second of the run, and the progress.

    Parameters
    ----------
    stream, rate, progress
        What is shown, samples per second, and the bar.
    """

    def __init__(self, stream: Streaming | None, rate: float, progress: Progress) -> None:
        self._stream, self._rate, self._progress, self._next = stream, rate, progress, 1.0

    def __call__(self, done: int, total: int) -> None:
        self._progress(done, total)
        seconds = done / self._rate
        if self._stream is not None and seconds >= self._next:
            print(f"{seconds:7.2f} s: {self._stream}", file=sys.stderr, flush=True)
            self._next = math.floor(seconds) + 1.0


def _stream(
    text: str, orders: list[str] | None, rig: str, parameters: str, rate: float, limit: float, p: int, k0: float
) -> Streaming:
    free = numbers("--order", orders)
    if text.startswith("flexible-link:"):
        stages: dict[str, Literal[1, 2]] = {"1": 1, "2": 2}
        stage = stages.get(text.removeprefix("flexible-link:"))
        if stage is None:
            raise ModelError(f"--live {text!r} is not known; use flexible-link:1, flexible-link:2 or an equation")
        structure = flexible_link(stage=stage, laws=("orders",), coupling="measured")
        if rig == "virtual":
            arm = ArmParameters.of(parameters)
            free = (arm.stage1 if stage == 1 else arm.stage2).orders(stage) | free
    else:
        structure = equation(text)
    return Streaming(
        structure.with_orders(free), step=1.0 / rate, longest=limit + 1.0, innovation_length=p, prior_covariance=k0
    )


def _floats(option: str, text: str, counts: tuple[int, ...]) -> list[float]:
    try:
        found = [float(part) for part in text.split(":")]
    except ValueError:
        found = []
    if len(found) not in counts:
        raise ModelError(f"{option} {text!r} is not {' or '.join(str(c) for c in counts)} numbers joined by a colon")
    return found
