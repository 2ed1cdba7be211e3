"""Option groups that commands share: single options, and dataclasses with the method that applies them."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Literal

from typer import Argument, Option

from ftlm.arm.flexible_link import Form, InputOrder, Law, flexible_link
from ftlm.cli.framework import numbers, output_file, pairs, ranges
from ftlm.cli.reading_options import METHOD_PANEL, OUTPUT_PANEL, STRUCTURE_PANEL, Number, Text, Texts
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.confidence_intervals import Intervals
from ftlm.estimation.methods import METHODS_BY_NAME
from ftlm.estimation.output_error import Loss, Noise
from ftlm.order_search.options import Criterion, Norm, RowBasis
from ftlm.structure.order_grid import OrderGrid, order_grid
from ftlm.structure.parser import equation
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import INITIAL_CHOICES, Offset, Structure, check_initial
from ftlm.utils.parameters import parameter

SavedModel = Annotated[str, Argument(metavar="MODEL", help="Saved model.")]
StructureText = Annotated[
    str,
    Option(
        "--structure",
        rich_help_panel=STRUCTURE_PANEL,
        help="flexible-link:1|2|both, arm:1|2|both or an equation in words.",
    ),
]
CandidateTexts = Annotated[
    list[str],
    Option("--structure", rich_help_panel=STRUCTURE_PANEL, help="Largest structure, several to compare, or auto."),
]
GridIncrement = Annotated[float, Option("--increment", help="Increment of the order grid.")]
BlockPulses = Annotated[
    int | None,
    Option("--m", rich_help_panel=METHOD_PANEL, help="Block pulses per run; default 2048, or as many as fit."),
]
Threads = Annotated[
    int | None, Option("--threads", rich_help_panel=METHOD_PANEL, help="Threads; default FTLM_THREADS, or all cores.")
]
StoreFile = Annotated[
    Text,
    Option(metavar="FILE", rich_help_panel=OUTPUT_PANEL, help="Checkpoint file; the same command resumes from it."),
]
Out = Annotated[Text, output_file("Write the model to this .json file.", panel=OUTPUT_PANEL)]
Page = Annotated[str, output_file("Write the page to this file.", metavar="HTML", panel=OUTPUT_PANEL)]
Report = Annotated[
    Text, output_file("Write an HTML report to this file.", "--report", metavar="HTML", panel=OUTPUT_PANEL)
]
Verbose = Annotated[
    bool, Option("-v", "--verbose", rich_help_panel=OUTPUT_PANEL, help="Print all details and all warnings.")
]
LossOption = Annotated[
    Loss | None,
    Option(rich_help_panel=METHOD_PANEL, help="Loss of residuals; huber resists outliers; default squares."),
]
NoiseDeviations = Annotated[
    Texts, Option(metavar="OUTPUT=A", help="Noise standard deviation of an output; default the fit's residual.")
]
Orders = Annotated[Texts, Option(metavar="NAME=VALUE", rich_help_panel=STRUCTURE_PANEL, help="Fix an order.")]
Fixed = Annotated[Texts, Option(metavar="NAME=VALUE", rich_help_panel=STRUCTURE_PANEL, help="Fix a coefficient.")]
ParameterBounds = Annotated[
    Texts,
    Option(metavar="NAME=LOW:HIGH", rich_help_panel=METHOD_PANEL, help="Bounds of a parameter; inf for an open side."),
]
Delay = Annotated[
    Texts,
    Option(metavar="INPUT=SECONDS", rich_help_panel=STRUCTURE_PANEL, help="Delay of an input; LOW:HIGH is estimated."),
]


def methods_with(*options: str) -> tuple[str, ...]:
    """Return the names of the methods of estimation that have these options."""
    return tuple(name for name, method in METHODS_BY_NAME.items() if set(options) <= {f.name for f in fields(method)})


@dataclass(frozen=True)
class StructureOptions:
    """Options that modify a structure; None for an option that is not given."""

    panel: ClassVar[str] = STRUCTURE_PANEL

    only: Annotated[Text, Option(metavar="OUTPUT", help="Fit the equation of this output only; default all.")] = None
    coupling: Annotated[
        Literal["measured", "simulated"] | None,
        Option(help="Other outputs in an equation; default measured for a link."),
    ] = None
    cross_stage: Annotated[
        Literal["torques", "inertial"] | None, Option(help="Terms of the other stage of the arm; default none.")
    ] = None
    cross_sensitivity: Annotated[
        bool, Option("--cross-sensitivity", help="Deflections also follow hub angles (gauge and cable).")
    ] = False
    cross_damping: Annotated[
        bool, Option("--cross-damping", help="With --cross-stage inertial: rate of the other deflection.")
    ] = False
    friction: Annotated[bool, Option("--friction", help="Add Coulomb friction of the hubs.")] = False
    laws: Annotated[
        Literal["none", "orders", "velocities"] | None,
        Option(help="Order law; velocities: also gamma = mu; default none."),
    ] = None
    form: Annotated[
        Form | None,
        Option(help="Equation of the deflection: (15) or (23); default lagrange."),
    ] = None
    input_order: Annotated[InputOrder | None, Option(help="Order of the current in the published form.")] = None
    sensor_filter: Annotated[
        Text, Option(metavar="stock|HZ[:DAMPING]", help="Low-pass filter of the sensors; stock: 2 Hz, damping 0.9.")
    ] = None
    filtered_signals: Annotated[
        Texts, Option(metavar="SIGNAL", help="Signal of an equation in words that passed the filter.")
    ] = None
    orders: Orders = None
    fixed: Fixed = None
    delay: Delay = None
    saturation: Annotated[
        Texts, Option(metavar="INPUT=LIMIT", help="Saturation limit of an input; LOW:HIGH is estimated.")
    ] = None
    dead_zone: Annotated[Texts, Option(metavar="INPUT=LIMIT", help="Dead zone of an input; LOW:HIGH is estimated.")] = (
        None
    )
    initial: Annotated[str, Option(help="auto, rest, caputo, history, or exponents of t: 0,1.")] = "auto"
    offset: Annotated[
        Offset | None,
        Option(help="Offset of each equation and run; default the equation's."),
    ] = None

    def structure(self, text: str, *, alone: bool = False) -> Structure:
        """Return the structure of `text` with the options applied; ``alone`` omits the other stage."""
        if text.startswith("flexible-link"):
            built = self._flexible_link(text)
        elif re.fullmatch(r"arm(:\w*)?", text):
            built = self._arm(text, alone)
        elif "=" not in text:
            raise ModelError(
                f"--structure {text!r} is no equation and has no name of a structure; use auto, flexible-link:1, :2 or "
                ":both, arm:1, :2 or :both, or an equation such as 'D y = a y + b u' (ftlm identify-frequency takes "
                "circuits)"
            )
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
        return built.with_orders(numbers("--orders", self.orders)).with_coefficients(numbers("--fixed", self.fixed))

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
        usual = StructureOptions()
        return [parameter(f.name) for f in fields(self) if getattr(self, f.name) != getattr(usual, f.name)]

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
            "--cross-stage": self.cross_stage is not None,
            "--cross-sensitivity": self.cross_sensitivity,
            "--cross-damping": self.cross_damping,
            "--friction": self.friction,
            "--laws": self.laws is not None,
            "--form": self.form is not None,
            "--input-order": self.input_order is not None,
        }

    def _sensor(self) -> SensorFilter | None:
        """Sensor filter of signals in equations."""
        if not self.filtered_signals:
            if self.sensor_filter is not None:
                raise ModelError(
                    "--sensor-filter is of signals that --filtered-signals names; name them, or leave it out"
                )
            return None
        if self.sensor_filter in (None, "stock"):
            return SensorFilter.low_pass(self.filtered_signals)
        frequency, _, damping = str(self.sensor_filter).partition(":")
        try:
            return SensorFilter.low_pass(self.filtered_signals, float(frequency), float(damping or 0.9))
        except ValueError:
            raise ModelError(
                f"--sensor-filter {self.sensor_filter!r} is not stock, HZ or HZ:DAMPING, such as 2:0.9"
            ) from None

    def _arm(self, text: str, alone: bool) -> Structure:
        """Deflections of the real arm with all angles as inputs, integer orders but that of the links' elasticity.

        For a single link the order of the damping is free instead, which improved the fit on validation runs
        significantly. A strain gauge measures the deflection, and its zero is an offset of each run. A spring-pot of
        nearly integer order has hardly any memory. So runs start from the link's angle and velocity unless a history is
        requested.
        """
        given = self._link_options() | {"--coupling": self.coupling is not None}
        given |= {"--sensor-filter": self.sensor_filter is not None, "--filtered-signals": bool(self.filtered_signals)}
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
        if self.filtered_signals or self.sensor_filter not in (None, "stock"):
            raise ModelError(
                "--filtered-signals and --sensor-filter HZ are of equations in words; the flexible link has "
                "--sensor-filter stock"
            )
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
            cross_stage=self.cross_stage or False,
            cross_sensitivity=self.cross_sensitivity,
            cross_damping=self.cross_damping,
            friction=self.friction,
            laws=laws[self.laws or "none"],
            sensor_filter="stock" if self.sensor_filter == "stock" else None,
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
class OrderGridOptions:
    """Order grid of a search and its norm; None for an option that is not given."""

    panel: ClassVar[str] = METHOD_PANEL
    methods: ClassVar[tuple[str, ...]] = methods_with("order_grid", "norm")

    order_grid: Annotated[
        Texts, Option(metavar="NAME=LOW:HIGH:STEP", help="Values of an order; alpha stands for every alpha.")
    ] = None
    increment: Annotated[Number, Option(help="Increment of the order grid; default 0.05.")] = None
    norm: Annotated[Norm | None, Option(help="Norm of errors: l1 (45) or l2 (46); default l1.")] = None

    def grid(self) -> OrderGrid | None:
        """Order grid of the search; None without options."""
        if self.increment is None and not self.order_grid:
            return None
        named: dict[str, Any] = dict(pairs("--order-grid", self.order_grid))
        alpha = named.pop("alpha", None)
        made = order_grid(**named) if self.increment is None else order_grid(increment=self.increment, **named)
        return made if alpha is None else replace(made, orders={**made.orders, "alpha": alpha})


@dataclass(frozen=True)
class RankingOptions:
    """Options of the ranking of candidates; None for an option that is not given."""

    panel: ClassVar[str] = METHOD_PANEL
    methods: ClassVar[tuple[str, ...]] = methods_with("criterion", "top", "store")

    criterion: Annotated[Criterion | None, Option(help="Error that ranks candidates; default output-error.")] = None
    top: Annotated[int | None, Option(help="Rows of the ranked table; default 20.")] = None
    store: Annotated[Text, Option(metavar="FILE", help="Checkpoint file, from which the search resumes.")] = None


@dataclass(frozen=True)
class MultiInnovationOptions:
    """Options of the multi-innovation method; None for an option that is not given."""

    panel: ClassVar[str] = METHOD_PANEL
    methods: ClassVar[tuple[str, ...]] = methods_with("innovation_length", "prior_covariance", "row_basis")

    innovation_length: Annotated[int | None, Option(help="Innovation length p; default 7.")] = None
    prior_covariance: Annotated[Number, Option(help="Prior covariance K0 of the coefficients; default weak.")] = None
    row_basis: Annotated[RowBasis | None, Option(help="Basis of the rows of (44); default haar.")] = None


@dataclass(frozen=True)
class OutputErrorOptions:
    """Options of the output-error method; None for an option that is not given."""

    panel: ClassVar[str] = METHOD_PANEL
    methods: ClassVar[tuple[str, ...]] = methods_with("loss", "intervals", "start", "reference", "noise", "bounds")

    loss: LossOption = None
    intervals: Annotated[
        Intervals | None,
        Option(help="Confidence intervals: Wald, profile likelihood; default auto."),
    ] = None
    start: Annotated[Text, Option(metavar="MODEL", help="Saved model as an additional initial guess.")] = None
    reference: Annotated[
        Text, Option(metavar="SIGNAL", help="Reference signal of a closed loop; also name it with -u.")
    ] = None
    noise: Annotated[Noise | None, Option(help="Noise of the output; ar: an autoregression; default white.")] = None
    bounds: ParameterBounds = None


@dataclass(frozen=True)
class GeneticOptions:
    """Options of the genetic algorithm; None for an option that is not given."""

    panel: ClassVar[str] = METHOD_PANEL
    methods: ClassVar[tuple[str, ...]] = methods_with("seeds", "evaluations")

    seeds: Annotated[
        list[int] | None, Option("--seeds", min=0, help="Seed of the genetic algorithm; several are several runs.")
    ] = None
    evaluations: Annotated[int | None, Option(help="Evaluations per seed of the genetic algorithm.")] = None
