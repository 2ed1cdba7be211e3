"""The command that finds a model in a frequency response: identify-frequency."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from typer import Argument, Option

from ftlm.base.errors import ModelError
from ftlm.base.output import COMMAND, check_free
from ftlm.base.progress import Progress
from ftlm.cli.command import command, say, show_json
from ftlm.cli.options import (
    Decimal,
    Force,
    HeaderLines,
    Json,
    Out,
    Separator,
    Sheet,
    Skipped,
    Text,
    Texts,
    Thousands,
    Verbose,
    layout_of,
)
from ftlm.cli.words import numbers, pairs, ranges
from ftlm.data.response import FrequencyData
from ftlm.files.response import load_frequency
from ftlm.identification.frequency import identify_frequency as estimation


@dataclass(frozen=True)
class ResponseOptions:
    """How files of frequency responses are read; None is an option that is not given."""

    columns: Annotated[
        Texts,
        Option(
            "--column",
            metavar="PART=COLUMN",
            help="Column of frequency, real, imag, magnitude, phase or deviation; default by their names.",
        ),
    ] = None
    frequency_unit: Annotated[
        Text, Option("--frequency-unit", metavar="UNIT", help="Hz, kHz, MHz, mHz or rad/s; default what is stated.")
    ] = None
    magnitude_unit: Annotated[
        Literal["dB", "abs"] | None, Option("--magnitude-unit", help="Of sizes; default what is stated, or abs.")
    ] = None
    phase_unit: Annotated[
        Literal["deg", "rad"] | None, Option("--phase-unit", help="Of phases; default what is stated, or deg.")
    ] = None
    negated: Annotated[
        bool | None,
        Option("--negated/--not-negated", help="Whether the imaginary column holds -Z''; default by its name."),
    ] = None
    output: Annotated[Text, Option("-y", "--output", metavar="NAME", help="What the response is of.")] = None
    input: Annotated[Text, Option("-u", "--input", metavar="NAME", help="What it is from.")] = None
    separator: Separator = None
    decimal: Decimal = None
    thousands: Thousands = None
    skip: Skipped = None
    header: HeaderLines = None
    sheet: Sheet = None

    def load(self, file: str) -> FrequencyData:
        """The record of one file."""
        columns: dict[str, Any] | None = pairs("--column", self.columns) or None
        return load_frequency(
            file, columns=columns, frequency_unit=self.frequency_unit, magnitude_unit=self.magnitude_unit,
            phase_unit=self.phase_unit, negated=self.negated, output=self.output or "", input=self.input or "",
            layout=layout_of(self),
        )  # fmt: skip


@command
def identify_frequency(
    *, files: Annotated[list[str], Argument(metavar="FILE...", help="Frequency responses or impedance spectra.")],
    structure: Annotated[str, Option(metavar="EQUATION", help="Equation in words, such as D^alpha y = a0 y + b0 u.")],
    weights: Annotated[
        Literal["auto", "relative", "uniform", "deviation"],
        Option(help="relative to the size, uniform, or by stated deviations; auto: those where there are some."),
    ] = "auto",
    reading: ResponseOptions,
    orders: Annotated[Texts, Option("--order", metavar="NAME=VALUE", help="Fix an order, or LOW:HIGH:STEP.")] = None,
    fixed: Annotated[Texts, Option(metavar="NAME=VALUE", help="Fix a coefficient.")] = None,
    delay: Annotated[Texts, Option(metavar="INPUT=SECONDS", help="Delay of an input; LEAST:LARGEST is estimated.")] = (
        None
    ),
    start: Annotated[Texts, Option(metavar="NAME=VALUE", help="Value of a free number to start from besides.")] = None,
    out: Out = None,
    report: Annotated[Text, Option(metavar="HTML", help="Page to write.")] = None,
    validation: Annotated[Text, Option(metavar="FILE", help="Another response, to judge the model on.")] = None,
    force: Force = False, verbose: Verbose = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Identify a model from a frequency response or an impedance: orders and coefficients with 95 % intervals."""
    check_free(out, report, force=force, words=COMMAND)
    if structure.startswith(("flexible-link", "arm:")) or structure == "auto":
        raise ModelError(f"--structure {structure!r}: a frequency response takes an equation in words")
    records = [reading.load(file) for file in files]
    with Progress("fitting", quiet=as_json) as progress:
        result = estimation(
            records, structure, weights=weights, orders=dict(pairs("--order", orders)), fixed=numbers("--fixed", fixed),
            delay=ranges("--delay", delay), start=numbers("--start", start) or None, progress=progress,
        )  # fmt: skip
    checked = None if validation is None else result.validate(reading.load(validation))
    if out is not None:
        result.model.save(out, force=force)
    if report is not None:
        result.report(report, validation=checked, force=force)
    if as_json:
        judged = {"verdict": result.verdict(checked).to_dict()}
        show_json({**judged, **result.to_dict(), "validation": None if checked is None else checked.to_dict()})
        return
    say(result.summary(checked).replace("result.warnings", "--verbose shows all"))
    if verbose:
        say("\n".join(f"warning: {w}" for w in result.warnings))
