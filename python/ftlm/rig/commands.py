"""The command `ftlm record`."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from ftlm.errors import ModelError

if TYPE_CHECKING:
    from ftlm.runs import Run

__all__ = ["record"]


def record(
    out: Annotated[str, typer.Option("-o", "--out", metavar="CSV", help="Where to write the run.")],
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
    force: Annotated[bool, typer.Option("--force", help="Overwrite files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Results as JSON.")] = False,
) -> None:
    """Drive a rig, simulated by default, and record a run that every other command reads."""
    from ftlm.progress import Progress  # noqa: PLC0415 — a command imports what it needs when it runs
    from ftlm.rig import experiment  # noqa: PLC0415

    currents = _floats("--amplitude", amplitude, (1, 2))
    low, high = _floats("--band", band, (2,))

    def recorded(progress: Progress) -> Run:
        return experiment.record(
            rig, input=shape, amplitude=(currents[0], currents[-1]), period=period,
            band=(low, high), ramp=ramp, file=file, duration=duration, limit=limit, rate=rate, seed=seed,
            parameters=parameters, paced=paced, sensor_filter="stock" if stock_filter else None, watchdog=watchdog,
            arm=arm, card=card, out=out, force=force, progress=progress,
        )  # fmt: skip

    try:
        with Progress("recording", quiet=as_json) as progress:
            run = recorded(progress)
    except KeyboardInterrupt:
        print(f"ftlm: stopped by Ctrl-C; the motors are at 0 V, what was recorded is in {out}", file=sys.stderr)
        raise typer.Exit(130) from None
    if as_json:
        told = {"written": out, "rows": run.length, "step": run.step, "about": run.about}
        print(json.dumps(told, indent=1, ensure_ascii=False))
    else:
        print(f"{run}\nwritten to {out}")
    missed = run.about["missed_deadlines"]
    if missed:
        print(f"ftlm: {missed} deadlines were missed", file=sys.stderr)


def _floats(option: str, text: str, counts: tuple[int, ...]) -> list[float]:
    try:
        found = [float(part) for part in text.split(":")]
    except ValueError:
        found = []
    if len(found) not in counts:
        raise ModelError(f"{option} {text!r} is not {' or '.join(str(c) for c in counts)} numbers joined by a colon")
    return found
