"""Option groups that commands share: single options, and dataclasses with the method that applies them."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

from typer import Argument, Option

from ftlm.arm.flexible_link import Law, flexible_link
from ftlm.cli.framework import announce_reading, interval, numbers, pairs, ranges
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.io.dialect import Layout
from ftlm.io.load import load
from ftlm.io.preview import OpenedFile, open_file
from ftlm.order_search.options import Criterion
from ftlm.structure.order_grid import OrderGrid, order_grid
from ftlm.structure.parser import equation
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import INITIAL_CHOICES, Structure, check_initial

#: Types of optional options.
Text = str | None
Number = float | None
Texts = list[str] | None

Files = Annotated[list[str], Argument(metavar="FILE...", help="Measured files; several files are several runs.")]
SavedModel = Annotated[str, Argument(metavar="MODEL", help="A saved model.")]
StructureText = Annotated[
    str,
    Option(
        "--structure",
        help="flexible-link:1, :2 or :both; arm:1, :2 or :both (deflections of a real arm); or an equation in words.",
    ),
]
CandidateTexts = Annotated[
    list[str],
    Option(
        "--structure",
        help="One, whose inside is searched, or several to compare: as of identify; or auto, one output, any inputs.",
    ),
]
GridIncrement = Annotated[float, Option("--step", help="Step of the order lattice.")]
BlockPulses = Annotated[int | None, Option("--m", help="Block pulses a run; default 2048, or what the runs carry.")]
Threads = Annotated[int | None, Option("--threads", help="Threads; default FTLM_THREADS, or all cores.")]
Out = Annotated[Text, Option("-o", "--out", metavar="FILE", help="Model to write, .json.")]
Page = Annotated[str, Option("-o", "--out", metavar="HTML", help="Page to write.")]
Force = Annotated[bool, Option("--force", help="Overwrite files.")]
Json = Annotated[bool, Option("--json", help="Results as JSON.")]
Verbose = Annotated[bool, Option("-v", "--verbose", help="Also all else that is known, and all warnings.")]
Noise = Annotated[Texts, Option(metavar="OUTPUT=A", help="Deviation of an output's noise; default what the fit left.")]
#: Options of a text file's layout; `layout_options` collects them from a dataclass.
Separator = Annotated[
    Literal["comma", "semicolon", "tab", "space"] | None,
    Option(help="Between cells of text; default what is there."),
]
Decimal = Annotated[Literal["point", "comma"] | None, Option(help="Mark of decimals in text; default what is there.")]
Thousands = Annotated[
    Literal["none", "point", "comma", "space", "apostrophe"] | None,
    Option(help="What groups thousands of numbers in text; default what is there."),
]
SkippedLines = Annotated[int | None, Option(metavar="LINES", help="Lines above the table; default what is no table.")]
HeaderLines = Annotated[
    int | None, Option(metavar="0|1|2", help="Lines of header: none, names, names and units; default what is there.")
]
Sheet = Annotated[Text, Option(help="Sheet of a workbook that has several.")]


def layout_options(record: object) -> dict[str, Any]:
    """Layout options that a dataclass has and the user has set."""
    said = {f.name: getattr(record, f.name, None) for f in fields(Layout)}
    return {name: value for name, value in said.items() if value is not None}


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading files."""

    time: Annotated[Text, Option(help="Column of time; default by its name.")] = None
    time_unit: Annotated[
        Literal["s", "ms", "us", "min", "h"] | None,
        Option("--time-unit", help="Unit of that column; default what its header says, as in time [ms], or s."),
    ] = None
    sampling: Annotated[Number, Option(help="Sampling step [s] of files without a time column.")] = None
    inputs: Annotated[
        Texts, Option("-u", "--input", metavar="NAME=COLUMN", help="An input; NAME alone where it is its column's.")
    ] = None
    outputs: Annotated[Texts, Option("-y", "--output", metavar="NAME=COLUMN", help="An output, as -u.")] = None
    units: Annotated[Texts, Option("--unit", metavar="NAME=UNIT", help="Unit of a signal, such as deg.")] = None
    columns: Annotated[Text, Option(metavar="TOML", help="File that names columns and units.")] = None
    between: Annotated[
        Texts, Option("--intersample", metavar="NAME=zoh|foh", help="foh for a measured input; a command is zoh.")
    ] = None
    sliced: Annotated[Text, Option("--slice", metavar="FROM:TO", help="Seconds since the first row.")] = None
    resample: Annotated[
        Number,
        Option(
            metavar="STEP", help="Put irregular rows on this step [s]; output error compares when outputs were read."
        ),
    ] = None
    missing: Annotated[
        Literal["refuse", "weight", "hold"] | None,
        Option(help="weight: outputs that are not there weigh nothing; hold: inputs hold their last value besides."),
    ] = None
    encoding: Annotated[Text, Option(help="Encoding of text, such as cp1252; default what its bytes show.")] = None
    separator: Separator = None
    decimal: Decimal = None
    thousands: Thousands = None
    skip: SkippedLines = None
    header: HeaderLines = None
    dates: Annotated[
        Literal["ymd", "dmy", "mdy"] | None, Option(help="Order of day and month where dates leave it open.")
    ] = None
    sheet: Sheet = None
    detrend: Annotated[
        Literal["constant", "linear"] | None,
        Option(help="Subtract the mean or the straight line of every signal; --offset estimates it instead."),
    ] = None

    def runs(self, files: Sequence[str] | None, *, apart: bool = False) -> list[Run]:
        """Load each file as a run, detrended if requested; see :meth:`_read`."""
        runs = self._read(files, apart=apart)
        return runs if self.detrend is None else [run.detrend(self.detrend) for run in runs]

    def _read(self, files: Sequence[str] | None, *, apart: bool) -> list[Run]:
        """Load each file as a run; .mat files with one signal each form one run unless ``apart``."""
        given: dict[str, Any] = {
            "time": self.time,
            "step": self.sampling,
            "inputs": pairs("-u", self.inputs),
            "outputs": pairs("-y", self.outputs),
            "units": pairs("--unit", self.units),
            "columns": self.columns,
            "time_unit": self.time_unit,
            "intersample": pairs("--intersample", self.between),
            "resample": self.resample,
            "missing": self.missing,
            "layout": layout_options(self),
        }
        if not files:
            return []
        announce_reading(files)
        options = {name: value for name, value in given.items() if value not in (None, {}, "")}
        if self.sliced is not None:
            options["window"] = interval(self.sliced, "--slice", "1.1:19.5")
        if not apart and len(files) > 1 and all(f.lower().endswith(".mat") for f in files):
            try:
                load(files[0], **options)
            except DataError:
                # The first file alone lacks a column that is asked for, so the files belong together.
                run = load(list(files), **options)
                print(f"ftlm: {len(files)} .mat files read as one run", file=sys.stderr)
                return [run]
        return [load(f, **options) for f in files]

    def preview_file(self, file: str) -> OpenedFile:
        """Preview a file that is not loaded as a run."""
        if self.detrend is not None:
            raise ModelError("--detrend is not used with open; give it to the commands that open names")
        announce_reading([file])
        return open_file(
            file,
            time=self.time,
            step=self.sampling,
            inputs=pairs("-u", self.inputs) or None,
            outputs=pairs("-y", self.outputs) or None,
            units=pairs("--unit", self.units),
            columns=self.columns,
            time_unit=self.time_unit,
            intersample=pairs("--intersample", self.between),
            layout=layout_options(self),
            window=None if self.sliced is None else interval(self.sliced, "--slice", "1.1:19.5"),
            resample=self.resample,
            missing=self.missing,
        )


@dataclass(frozen=True)
class StructureOptions:
    """Options that modify a structure; None for an option that is not given."""

    only: Annotated[Text, Option(metavar="OUTPUT", help="Only the equation of this output.")] = None
    coupling: Annotated[
        Literal["measured", "simulated"] | None,
        Option(help="Whose other outputs drive a free run; default measured of a flexible link, else simulated."),
    ] = None
    cross_stage: Annotated[bool, Option("--cross-stage", help="Add the other stage's angles and current.")] = False
    inertial: Annotated[
        bool, Option("--inertial", help="Add the other stage's accelerations, by the energies of the arm.")
    ] = False
    cross_sensitivity: Annotated[
        bool, Option("--cross-sensitivity", help="Deflections follow hub angles through gauge and cable, too.")
    ] = False
    cross_damping: Annotated[
        bool, Option("--cross-damping", help="With --inertial: the rate of the other deflection, an observer's gain.")
    ] = False
    friction: Annotated[bool, Option("--friction", help="Add Coulomb friction of the hubs.")] = False
    laws: Annotated[
        Literal["none", "orders", "velocities"] | None,
        Option(
            help="orders: search all equations under the order law; velocities: with gamma = mu besides; default none."
        ),
    ] = None
    form: Annotated[
        Literal["lagrange", "published"] | None,
        Option(help="Equation of the deflection: the paper's (15), or its (23) as printed; default lagrange."),
    ] = None
    input_order: Annotated[
        Literal["published", "derived"] | None,
        Option(help="Order of the current in the published form, which it implies."),
    ] = None
    stock_filter: Annotated[bool, Option("--stock-filter", help="Deflections passed the stock 2 Hz low-pass.")] = False
    filtered: Annotated[
        Texts, Option("--filtered", metavar="SIGNAL", help="Signal of equations in words that passed a low-pass.")
    ] = None
    low_pass: Annotated[
        Text, Option("--low-pass", metavar="HZ[:DAMPING]", help="That low-pass; default 2:0.9, the arm's stock one.")
    ] = None
    orders: Annotated[Texts, Option("--order", metavar="NAME=VALUE", help="Fix an order.")] = None
    fixed: Annotated[Texts, Option(metavar="NAME=VALUE", help="Fix a coefficient.")] = None
    delay: Annotated[Texts, Option(metavar="INPUT=SECONDS", help="Delay of an input; LEAST:LARGEST is estimated.")] = (
        None
    )
    saturation: Annotated[
        Texts, Option(metavar="INPUT=LIMIT", help="How far an input acts at most; LEAST:LARGEST is estimated.")
    ] = None
    dead_zone: Annotated[
        Texts,
        Option("--dead-zone", metavar="INPUT=LIMIT", help="What an input exceeds before it acts; or LEAST:LARGEST."),
    ] = None
    initial: Annotated[str, Option(help="auto, rest, caputo, history, or exponents of t: 0,1.")] = "auto"
    offset: Annotated[
        Literal["none", "constant", "ramp", "auto"] | None,
        Option(help="Unknown constant (and ramp) in each equation, one a run; default what the equation says."),
    ] = None

    def structure(self, text: str, *, alone: bool = False) -> Structure:
        """Return the structure of `text` with the options applied; ``alone`` omits the other stage."""
        if text.startswith("flexible-link"):
            built = self._flexible_link(text)
        elif re.fullmatch(r"arm(:\w*)?", text):
            built = self._arm(text, alone)
        else:
            built = equation(text, sensor_filter=self._sensor())
            self._check_equation(len(built.equations))
            if len(built.equations) > 1:
                built = replace(built, coupling=self.coupling or "simulated")
        if self.only is not None:
            built = built.equation(self.only)
        if self.offset is not None:
            built = replace(built, offset=self.offset)
        if self.initial != "auto":
            built = replace(built, initial=check_initial(self._initial()))
        built = built.with_delays(ranges("--delay", self.delay))
        built = built.with_limits(
            saturation=ranges("--saturation", self.saturation), dead_zone=ranges("--dead-zone", self.dead_zone)
        )
        return built.with_orders(numbers("--order", self.orders)).with_coefficients(numbers("--fixed", self.fixed))

    def structure_for_runs(self, text: str, runs: Sequence[Run]) -> Structure:
        """Return the structure of `text` for runs: one link alone if no run contains the other stage."""
        stage = re.fullmatch("arm:([12])", text)
        if stage is not None:
            other = f"theta{3 - int(stage[1])}"
            if not any(name.startswith(other) for run in runs for name in run.signals):
                absent = f"no run has {other}1 or {other}2"
                print(f"ftlm: {absent}: {text} is a link alone, the other locked", file=sys.stderr)
                return self.structure(text, alone=True)
        return self.structure(text)

    def given_options(self) -> list[str]:
        """Options with values other than their defaults."""
        names = {"orders": "--order", "fixed": "--fixed"}
        usual = StructureOptions()
        said = [f.name for f in fields(self) if getattr(self, f.name) != getattr(usual, f.name)]
        return [names.get(n, "--" + n.replace("_", "-")) for n in said]

    def _check_equation(self, count: int) -> None:
        """Raise for options of the flexible link, given the number of equations."""
        given = self._link_options() | {
            "--coupling": self.coupling is not None and count == 1,
        }
        wrong = [option for option, is_given in given.items() if is_given]
        if wrong:
            owner = "the flexible link or of several equations" if wrong == ["--coupling"] else "the flexible link"
            kind = "one equation in words" if count == 1 else "equations in words"
            raise ModelError(
                f"{', '.join(wrong)}: of {owner}, not used with {kind}; leave {'it' if len(wrong) == 1 else 'them'} "
                "out, or use --structure flexible-link:1, :2 or :both"
            )

    def _link_options(self) -> dict[str, bool]:
        """Whether each option of the flexible link is given."""
        return {
            "--cross-stage": self.cross_stage,
            "--inertial": self.inertial,
            "--cross-sensitivity": self.cross_sensitivity,
            "--cross-damping": self.cross_damping,
            "--friction": self.friction,
            "--laws": self.laws is not None,
            "--form": self.form is not None,
            "--input-order": self.input_order is not None,
            "--stock-filter": self.stock_filter,
        }

    def _sensor(self) -> SensorFilter | None:
        """Sensor filter of signals in equations."""
        if not self.filtered:
            if self.low_pass is not None:
                raise ModelError("--low-pass is of signals that --filtered names; name them, or leave it out")
            return None
        frequency, _, damping = (self.low_pass or "2:0.9").partition(":")
        try:
            return SensorFilter.low_pass(self.filtered, float(frequency), float(damping or 0.9))
        except ValueError:
            raise ModelError(f"--low-pass {self.low_pass!r} is not HZ or HZ:DAMPING, such as 2:0.9") from None

    def _arm(self, text: str, alone: bool) -> Structure:
        """Deflections of the real arm with all angles as inputs, integer orders but that of the links' elasticity.

        For a single link the order of the damping is free instead, which improved the fit on validation runs
        significantly. A strain gauge measures the deflection, and its zero is an offset of each run. A spring-pot of
        nearly integer order has hardly any memory. So runs start from the link's angle and velocity unless a history is
        requested.
        """
        given = self._link_options() | {"--coupling": self.coupling is not None}
        given |= {"--filtered": bool(self.filtered), "--low-pass": self.low_pass is not None}
        wrong = [option for option, is_given in given.items() if is_given]
        if wrong:
            raise ModelError(
                f"{', '.join(wrong)}: --structure {text} has its own; leave {'it' if len(wrong) == 1 else 'them'} out, "
                "or use --structure flexible-link:1, :2 or :both"
            )
        stages: dict[str, Literal[1, 2, "both"]] = {"1": 1, "2": 2, "both": "both", "": "both"}
        stage = stages.get(text.partition(":")[2])
        if stage is None:
            raise ModelError(f"--structure {text!r} is not known; use arm:1, :2 or :both")
        built = flexible_link(
            stage=stage,
            hub=False,
            cross_stage=False if alone else "inertial",
            cross_sensitivity=True,
            cross_damping=not alone,
            sensor_filter="stock",
            laws=("orders", "coefficients", "velocities"),
            offset="constant",
        )
        built = replace(built, initial="caputo")
        whole = ("beta", 0.0) if alone else ("mu", 1.0)
        return built.with_orders({n: whole[1] for n in built.order_names if n.startswith(whole[0])})

    def _flexible_link(self, text: str) -> Structure:
        stages: dict[str, Literal[1, 2, "both"]] = {"1": 1, "2": 2, "both": "both"}
        stage = stages.get(text.partition(":")[2])
        if stage is None:
            raise ModelError(f"--structure {text!r} is not known; use flexible-link:1, :2 or :both, or an equation")
        if self.filtered or self.low_pass:
            raise ModelError(
                "--filtered and --low-pass are of equations in words; the flexible link has --stock-filter"
            )
        if self.cross_stage and self.inertial:
            raise ModelError("--cross-stage adds torques, --inertial accelerations of the other stage; use one of them")
        laws: dict[str, Sequence[Law]] = {
            "none": (),
            "orders": ("orders", "coefficients"),
            "velocities": ("orders", "coefficients", "velocities"),
        }
        return flexible_link(
            stage=stage,
            form=self.form,
            input_order=self.input_order,
            coupling=self.coupling,
            cross_stage="inertial" if self.inertial else self.cross_stage,
            cross_sensitivity=self.cross_sensitivity,
            cross_damping=self.cross_damping,
            friction=self.friction,
            laws=laws[self.laws or "none"],
            sensor_filter="stock" if self.stock_filter else None,
        )

    def _initial(self) -> Any:
        if self.initial in INITIAL_CHOICES:
            return self.initial
        try:
            return tuple(float(exponent) for exponent in self.initial.split(","))
        except ValueError:
            raise ModelError(
                f"--initial {self.initial!r} is not {', '.join(INITIAL_CHOICES)} or exponents such as 0,1"
            ) from None


@dataclass(frozen=True)
class SearchOptions:
    """Options of candidates, their computation and ranking; None for an option that is not given."""

    criterion: Annotated[Criterion | None, Option(help="Error that ranks the candidates; default output-error.")] = None
    norm: Annotated[
        Literal["l1", "l2"] | None,
        Option(help="Of errors: l1 their sizes, the paper's (45), l2 their squares, (46); default l1."),
    ] = None
    values: Annotated[
        Texts, Option("--lattice", metavar="NAME=LOW:HIGH:STEP", help="Values of an order; alpha means every alpha.")
    ] = None
    step: Annotated[Number, Option("--step", help="Step of the order lattice; default 0.05.")] = None
    p: Annotated[int | None, Option(help="Innovation length, of multi-innovation; default 7.")] = None
    k0: Annotated[Number, Option(help="Prior covariance of the coefficients, of multi-innovation; default 1.")] = None
    rows: Annotated[
        Literal["haar", "time"] | None,
        Option(help="Rows of multi-innovation, the paper's (44), in Haar coordinates or in time; default haar."),
    ] = None
    m: BlockPulses = None
    keep: Annotated[int | None, Option(help="Rows of the ranked table; default 20.")] = None

    def lattice(self) -> OrderGrid | None:
        """Order grid of the search; None without options."""
        if self.step is None and not self.values:
            return None
        named: dict[str, Any] = dict(pairs("--lattice", self.values))
        alpha = named.pop("alpha", None)
        made = order_grid(**named) if self.step is None else order_grid(increment=self.step, **named)
        return made if alpha is None else replace(made, orders={**made.orders, "alpha": alpha})

    def settings(self) -> dict[str, Any]:
        """Given settings of an order search, by their names in Python."""
        given = {
            "criterion": self.criterion,
            "norm": self.norm,
            "innovation_length": self.p,
            "prior_covariance": self.k0,
            "row_basis": self.rows,
            "top": self.keep,
        }
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class GeneticOptions:
    """Options of the genetic algorithm."""

    seeds: Annotated[
        list[int] | None, Option("--seed", min=0, help="Seed of the genetic algorithm; several are several runs.")
    ] = None
    evaluations: Annotated[int | None, Option(help="Evaluations a seed of the genetic algorithm.")] = None

    def settings(self) -> dict[str, Any]:
        """Given options of the genetic algorithm, by their names in Python."""
        given = {"seeds": tuple(self.seeds) if self.seeds else None, "evaluations": self.evaluations}
        return {name: value for name, value in given.items() if value is not None}
