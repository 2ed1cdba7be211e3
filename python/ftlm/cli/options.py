"""Groups of command-line options that several commands share, as dataclasses with methods that apply them."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

from ftlm.arm.flexible_link import Form, InputOrder, Law, flexible_link, link_structure
from ftlm.cli.framework import OptionDetails, numbers, pairs, ranges
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.confidence_intervals import Intervals
from ftlm.estimation.methods import METHODS_BY_NAME
from ftlm.estimation.output_error import Loss, Noise
from ftlm.order_search.options import Criterion, Norm, OrderGrid, RowBasis, order_grid
from ftlm.structure.parser import equation
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import INITIAL_CHOICES, Offset, Structure, check_initial
from ftlm.utils.parameters import flag_of, parameter
from ftlm.utils.validation import nearest

#: Options of the structure flexible-link, in their sequence in messages.
LINK_OPTIONS = ("cross_stage", "cross_sensitivity", "cross_damping", "friction", "laws", "form", "input_order")
#: Joint of the arm, or both joints, by the part of a structure's name after the colon.
STAGES_BY_NAME: dict[str, Literal[1, 2, "both"]] = {"1": 1, "2": 2, "both": "both"}
#: Names of structures, and "auto" for a structure selection.
STRUCTURE_NAMES = ("auto", *(f"{name}:{part}" for name in ("flexible-link", "arm") for part in ("1", "2", "both")))


class MethodOptions:
    """Base class of option groups of estimation methods; the value None marks an option that is not given."""

    @staticmethod
    def methods_of(option: str) -> tuple[str, ...]:
        """Return the names of the estimation methods that use an option."""
        field_name = "order_grid" if option == "increment" else option
        return tuple(n for n, kind in METHODS_BY_NAME.items() if field_name in {f.name for f in fields(kind)})


@dataclass(frozen=True)
class StructureOptions:
    """Options that modify a structure; the value None marks an option that is not given.

    Structure
    ---------
    only : OUTPUT
        Fit the equation of this output only; default all.
    coupling
        Values of other outputs in an equation; default measured.
    cross_stage
        Add terms of the other joint of the arm; default none.
    cross_sensitivity
        Add hub angles to measured deflections (gauge and cable).
    cross_damping
        Add rate of other deflection, with --cross-stage inertial.
    friction
        Add Coulomb friction of the hubs.
    laws
        Order law; velocities adds gamma = mu; default none.
    form
        Deflection by (15) or (23) of the paper; default lagrange.
    input_order
        Order of the current in the published form.
    sensor_filter : stock|HZ[:DAMPING]
        Low-pass filter of the sensors; stock: 2 Hz, damping 0.9.
    filtered_signals : SIGNAL
        Filtered signal of an equation as text.
    orders : NAME=VALUE
        Fix an order.
    saturation : INPUT=LIMIT
        Saturation limit of an input; LOW:HIGH estimates it.
    dead_zone : INPUT=LIMIT
        Dead zone of an input; LOW:HIGH estimates it.
    initial
        Initial terms: auto, rest, caputo, history, exponents 0,1.
    offset
        Offset of each equation and run; default the equation's.
    """

    only: str | None = None
    coupling: Literal["measured", "simulated"] | None = None
    cross_stage: Literal["torques", "inertial"] | None = None
    cross_sensitivity: bool = False
    cross_damping: bool = False
    friction: bool = False
    laws: Literal["none", "orders", "velocities"] | None = None
    form: Form | None = None
    input_order: InputOrder | None = None
    sensor_filter: str | None = None
    filtered_signals: list[str] | None = None
    orders: list[str] | None = None
    fixed: list[str] | None = None
    delay: list[str] | None = None
    saturation: list[str] | None = None
    dead_zone: list[str] | None = None
    initial: str = "auto"
    offset: Offset | None = None

    def structure(self, text: str, *, alone: bool = False) -> Structure:
        """Return the structure of the option --structure, whose value is `text`, with all options applied.

        `alone` restricts a structure of the arm to one link without signals of the other joint. Raise ModelError for an
        invalid text, or options that do not apply to it.
        """
        if text.startswith("flexible-link"):
            built = self._flexible_link(text)
        elif re.fullmatch(r"arm(:\w*)?", text):
            built = self._arm(text, alone)
        elif text == "auto":
            raise ModelError(
                "--structure auto selects a structure in ftlm identify and ftlm select; give this command an equation, "
                "such as the one that ftlm select prints"
            )
        elif "=" not in text:
            raise ModelError(
                f"--structure {text!r} is no equation and has no name of a structure{nearest(text, STRUCTURE_NAMES)}; "
                "use auto, flexible-link:1, :2 or :both, arm:1, :2 or :both, or an equation such as "
                "'D y = a y + b u' (ftlm identify-frequency fits circuits: fit each, and compare their AICc)"
            )
        else:
            built = equation(text, sensor_filter=self._sensor(), coupling=self.coupling)
            self._check_equation(len(built.equations))
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
        """Return the structure of `text` for runs.

        A structure arm:1 or arm:2 is restricted to one link if no run has the angles of the other joint; a note is
        printed on standard error.
        """
        stage = re.fullmatch("arm:([12])", text)
        if stage is not None:
            other_joint = f"theta{3 - int(stage[1])}"
            if not any(name.startswith(other_joint) for run in runs for name in run.signals):
                reason = f"no run has {other_joint}1 or {other_joint}2"
                print(f"ftlm: {reason}: {text} is a link alone, the other locked", file=sys.stderr)
                return self.structure(text, alone=True)
        return self.structure(text)

    def given_options(self) -> list[str]:
        """Return the flags of the options whose values differ from the defaults."""
        defaults = StructureOptions()
        return [parameter(f.name) for f in fields(self) if getattr(self, f.name) != getattr(defaults, f.name)]

    def _check_equation(self, count: int) -> None:
        """Raise ModelError if an option is set that does not apply to a structure of `count` equations as text."""
        inapplicable = self._flags(*LINK_OPTIONS, *(["coupling"] if count == 1 else []))
        if inapplicable:
            owner = "the flexible link or several equations" if inapplicable == ["--coupling"] else "the flexible link"
            kind = "one equation as text" if count == 1 else "equations as text"
            raise ModelError(
                f"{', '.join(inapplicable)}: only valid with {owner}, not with {kind}; leave "
                f"{'it' if len(inapplicable) == 1 else 'them'} "
                "out, or use --structure flexible-link:1, :2 or :both"
            )

    def _flags(self, *names: str) -> list[str]:
        """Return the flags of the named options that the user has set."""
        return [flag_of(name) for name in names if getattr(self, name)]

    def _sensor(self) -> SensorFilter | None:
        """Return the sensor filter of the signals of --filtered-signals; None without these options.

        Raise ModelError for an invalid filter, or a filter without signals.
        """
        if not self.filtered_signals:
            if self.sensor_filter is not None:
                raise ModelError(
                    "--sensor-filter applies to the signals of --filtered-signals; name them, or leave it out"
                )
            return None
        if self.sensor_filter in (None, "stock"):
            return SensorFilter.low_pass(self.filtered_signals)
        frequency, _, damping = str(self.sensor_filter).partition(":")
        try:
            return SensorFilter.low_pass(self.filtered_signals, float(frequency), float(damping or 0.9))
        except ValueError:
            raise ModelError(
                f"--sensor-filter {self.sensor_filter!r} is not a filter; give stock, HZ or HZ:DAMPING, such as 2:0.9"
            ) from None

    def _arm(self, text: str, alone: bool) -> Structure:
        """Return the structure of one or both link deflections of the real arm, with the measured angles as inputs.

        Only the order of the elastic term is free or, if `alone` is True (one link, with the other joint locked), only
        the order of the damping term. These choices improved the fit on validation runs. The offset of each run is
        the zero of the strain gauge. The initial conditions are the angle and velocity of the link by default, because
        terms of nearly integer order have little memory.
        """
        inapplicable = self._flags(*LINK_OPTIONS, "coupling", "sensor_filter", "filtered_signals")
        if inapplicable:
            raise ModelError(
                f"{', '.join(inapplicable)}: not used with --structure {text}, which fixes these options; leave "
                f"{'it' if len(inapplicable) == 1 else 'them'} out, "
                "or use --structure flexible-link:1, :2 or :both"
            )
        stage = STAGES_BY_NAME.get(text.partition(":")[2] or "both")
        if stage is None:
            raise ModelError(f"--structure {text!r} is not known; use arm:1, :2 or :both")
        built = link_structure(stage, both=not alone)
        integer_order = ("beta", 0.0) if alone else ("mu", 1.0)
        return built.with_orders({n: integer_order[1] for n in built.order_names if n.startswith(integer_order[0])})

    def _flexible_link(self, text: str) -> Structure:
        stage = STAGES_BY_NAME.get(text.partition(":")[2])
        if stage is None:
            raise ModelError(f"--structure {text!r} is not known; use flexible-link:1, :2 or :both, or an equation")
        if self.filtered_signals or self.sensor_filter not in (None, "stock"):
            raise ModelError(
                "--filtered-signals and --sensor-filter HZ apply to equations as text; the flexible link has "
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
                f"--initial {self.initial!r} is not known; give {', '.join(INITIAL_CHOICES)} or exponents such as 0,1"
            ) from None


@dataclass(frozen=True)
class OrderGridOptions(MethodOptions):
    """Options of the order grid of a search; the value None marks an option that is not given.

    Method
    ------
    order_grid : NAME=LOW:HIGH:STEP
        Values of an order; alpha stands for every alpha.
    increment
        Increment of the order grid; default 0.05.
    """

    order_grid: list[str] | None = None
    increment: float | None = None

    def grid(self) -> OrderGrid | None:
        """Return the order grid that the options define; None if none is given. Raise ModelError for invalid values."""
        if self.increment is None and not self.order_grid:
            return None
        axes: dict[str, Any] = dict(pairs("--order-grid", self.order_grid))
        alpha = axes.pop("alpha", None)
        grid = order_grid(**axes) if self.increment is None else order_grid(increment=self.increment, **axes)
        return grid if alpha is None else replace(grid, orders={**grid.orders, "alpha": alpha})


@dataclass(frozen=True)
class RankingOptions(MethodOptions):
    """Options for the ranking of candidates; the value None marks an option that is not given.

    Method
    ------
    norm
        Norm of errors, (45) or (46) of the paper; default l1.
    criterion
        Error that ranks candidates; default output-error.
    top
        Rows of the ranked table; default 20.
    store : FILE
        Checkpoint file, from which the search resumes.
    """

    norm: Norm | None = None
    criterion: Criterion | None = None
    top: int | None = None
    store: str | None = None


@dataclass(frozen=True)
class MultiInnovationOptions(MethodOptions):
    """Options of the multi-innovation method; the value None marks an option that is not given.

    Method
    ------
    innovation_length
        Innovation length p; default 7.
    prior_covariance
        Prior covariance K0 of the coefficients; default weak.
    row_basis
        Row basis of the recursion, (44) of the paper; default haar.
    """

    innovation_length: int | None = None
    prior_covariance: float | None = None
    row_basis: RowBasis | None = None


@dataclass(frozen=True)
class OutputErrorOptions(MethodOptions):
    """Options of the output-error method; the value None marks an option that is not given.

    Method
    ------
    intervals
        Confidence intervals: Wald, profile likelihood; default auto.
    start : MODEL
        Saved model as an additional initial guess.
    reference : SIGNAL
        Reference signal of a closed loop; also name it with -u.
    noise
        Noise of the output; ar: an autoregression; default white.
    priors : NAME=MEAN:DEVIATION
        Normal prior of a parameter: its mean and standard deviation.
    """

    loss: Loss | None = None
    intervals: Intervals | None = None
    start: str | None = None
    reference: str | None = None
    noise: Noise | None = None
    bounds: list[str] | None = None
    priors: list[str] | None = None


@dataclass(frozen=True)
class GeneticOptions(MethodOptions):
    """Options of the genetic algorithm; the value None marks an option that is not given.

    Method
    ------
    seeds
        Seed of the genetic algorithm; each seed is one run.
    evaluations
        Evaluations per seed of the genetic algorithm.
    """

    seeds: Annotated[list[int] | None, OptionDetails(min=0)] = None
    evaluations: int | None = None
