"""Result of an identification: model, task, fit, errors, residual tests; physical parameters of the flexible arm."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.objective import propagated_errors
from ftlm.estimation.output_error import JointFit, ProfileInterval
from ftlm.findings import Finding, texts
from ftlm.model.model import Model
from ftlm.model.parameter_estimates import Parameter, parameter_estimates, parameter_frame
from ftlm.order_search.options import OrderGrid, restrict_order_grid
from ftlm.order_search.result import SearchResult
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import attributes, format_bound
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Floats, check_threads, real_number
from ftlm.validation.comparison import Comparison, Metrics, filter_state
from ftlm.validation.information_criteria import InformationCriteria
from ftlm.validation.residual_tests import Residuals, resid

if TYPE_CHECKING:
    from ftlm.estimation.verdict import Validation, Verdict

#: Physical parameters of stage j by name, and their units (of whole orders).
PHYSICAL_UNITS = {
    "K_s{j}": "N m/rad",
    "J_{j}1": "kg m^2",
    "J_{j}2": "kg m^2",
    "B_{j}1": "N m s/rad",
    "B_{j}2": "N m s/rad",
    "K_tau{j}": "N m/A",
}
#: Relative step of the numerical gradient: its error is far below any standard error's own.
GRADIENT_STEP = 1e-6


@dataclass(frozen=True)
class PhysicalParameter:
    """Physical parameter with its uncertainty.

    Parameters
    ----------
    value, standard_error
        In ``unit``; a known parameter has standard error 0.
    unit
        For whole orders; a fractional order adds a power of a second.
    """

    value: float
    standard_error: float
    unit: str

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval."""
        return self.value - NORMAL_95 * self.standard_error, self.value + NORMAL_95 * self.standard_error

    def __str__(self) -> str:
        return f"{self.value:.6g} ± {format_bound(self.standard_error)} {self.unit}"


@check_arguments
def physical_parameters(joint: JointFit, known_values: Mapping[str, float]) -> dict[str, PhysicalParameter]:
    """Compute the physical parameters of a link from its coefficients, given one parameter per stage.

    a = K_s/J_1, b = -B_1/J_1, d = B_2/J_1, g = K_tau/J_1 and r = (J_1 + J_2)/J_2 (paper (16)-(21)), or j = J_1/J_2, fix
    five ratios of six parameters. Standard errors follow from the joint covariance to first order; the known value is
    taken as exact.

    Parameters
    ----------
    joint
        Joint output-error fit of a :func:`flexible_link` with its coefficient law.
    known_values
        One parameter per stage by name: K_s1, J_11, J_12, B_11, B_12 or K_tau1 (2 for the second stage).

    Returns
    -------
    dict
        All parameters of every stage that a known one belongs to.

    Raises
    ------
    ModelError
        No or an unknown name, two of one stage, a value that is not positive, a fit without the coefficient law.
    """
    out: dict[str, PhysicalParameter] = {}
    names = {name.format(j=j): (j, unit) for j in (1, 2) for name, unit in PHYSICAL_UNITS.items()}
    if not known_values:
        raise ModelError(f"no physical parameter is given; one per stage must be known: {', '.join(names)}")
    stages = []
    for name, value in known_values.items():
        if name not in names:
            raise ModelError(f"{name!r} is not a physical parameter of the arm; use one of {', '.join(names)}")
        stage = names[name][0]
        if stage in stages:
            raise ModelError(f"two parameters of stage {stage} are given, but only one may be known; leave {name} out")
        stages.append(stage)
        amount = real_number(name, value)
        if not 0 < amount < math.inf:
            raise ModelError(f"{name} = {value!r} is not positive")
        h = 2 * stage - 1
        ratio = f"j{stage}" if f"j{stage}" in joint.coefficients else f"r{stage}"
        needed = [f"a{h}", f"b{h}", f"d{h}", f"g{h}", ratio]
        missing = [n for n in needed if n not in joint.coefficients]
        if missing:
            raise ModelError(
                f"coefficient {missing[0]} is not in the fit; identify flexible_link(stage={stage}) with "
                "laws=('orders', 'coefficients') and all terms free"
            )
        place = [joint.names.index(n) for n in needed]
        # J_1/J_2, or that and 1.
        centre = joint.values[place] + np.array([0.0, 0.0, 0.0, 0.0, float(ratio.startswith("j"))])
        spread = joint.covariance[np.ix_(place, place)]
        values = _physical(centre, name, amount, stage)
        slopes = []
        for i, c in enumerate(centre):
            step = GRADIENT_STEP * (abs(c) if c else 1.0)
            shift = step * np.eye(centre.size)[i]
            above, below = (_physical(centre + side, name, amount, stage) for side in (shift, -shift))
            slopes.append((above - below) / (2 * step))
        gradient = np.array(slopes).T
        errors = propagated_errors(gradient, spread)
        units = list(PHYSICAL_UNITS.items())
        for (pattern, unit), v, e in zip(units, values.tolist(), errors.tolist(), strict=True):
            out[pattern.format(j=stage)] = PhysicalParameter(v, e, unit)
    return out


def _physical(coefficients: NDArray[np.float64], name: str, value: float, stage: int) -> NDArray[np.float64]:
    """Return K_s, J_1, J_2, B_1, B_2 and K_tau from a, b, d, g, r and one of them."""
    a, b, d, g, r = coefficients
    # Every parameter in units of J_1.
    shares = np.array([a, 1.0, 1.0 / (r - 1.0), -b, d, g])
    index = [pattern.format(j=stage) for pattern in PHYSICAL_UNITS].index(name)
    out: NDArray[np.float64] = value / shares[index] * shares
    return out


@dataclass(frozen=True)
class Task:
    """Identification task: runs, structure and order grid.

    Parameters
    ----------
    runs
        Estimation runs.
    structure
        Structure to identify, with free orders and coefficients.
    order_grid
        Grid of the order search; None for the default.
    """

    runs: tuple[Run, ...]
    structure: Structure
    order_grid: OrderGrid | None = None

    def part_order_grid(self, part: Structure) -> OrderGrid:
        """Return the order grid of one independently searched part of the structure."""
        return restrict_order_grid(self.order_grid, part) or OrderGrid()


@dataclass(frozen=True)
class Identification:
    """Result of an identification: model, fit, residuals, settings and verdict.

    Parameters
    ----------
    model
        Identified model.
    method
        Estimator of the coefficients.
    comparison
        Simulation error and equation error on the estimation runs.
    searches
        Order searches that gave the orders: by output, or under ``"stage"`` for a search under the order law; empty if
        all orders were given.
    settings
        Settings of the estimator.
    findings
        Findings about data, fit and model.
    joint
        Optimum of the joint output error with its covariance; None for the equation-error methods.
    residuals
        Residual tests on the estimation runs; None if these are too short.
    information
        Information criteria, with orders counted as parameters; None without residuals.
    task
        Runs and structure as given.
    coefficient_errors
        Standard errors of coefficients, and of searched orders, for methods without a joint covariance.
    """

    model: Model
    method: str
    comparison: Comparison
    searches: dict[str, SearchResult]
    settings: dict[str, Any]
    findings: tuple[Finding, ...] = field(default=())
    joint: JointFit | None = None
    residuals: Residuals | None = None
    information: InformationCriteria | None = None
    task: Task | None = field(default=None, repr=False)
    coefficient_errors: Mapping[str, float] = field(default_factory=dict)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings."""
        return texts(self.findings)

    @property
    def orders(self) -> dict[str, float]:
        """Free orders by name."""
        return dict(self.model.orders)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name.

        Available for output error and instrumental variables, robust to colored residuals; with all orders given, of
        the coefficients. Empty for the other equation-error methods.
        """
        if self.joint is None:
            return dict(self.coefficient_errors)
        return {**self.joint.standard_errors, **self.joint.derived_errors}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by name.

        Value ± 1.96 standard errors. Parameters of a joint fit with a nonquadratic cost have profile-likelihood
        intervals, which may be asymmetric or unbounded.
        """
        values, errors = self._values, self.standard_errors
        quadratic = {n: (values[n] - NORMAL_95 * e, values[n] + NORMAL_95 * e) for n, e in errors.items()}
        return {**quadratic, **{n: (p.low, p.high) for n, p in self.profiles.items()}}

    @property
    def profiles(self) -> dict[str, ProfileInterval]:
        """95 % profile-likelihood intervals in use; see :meth:`ftlm.Identification.profile`."""
        return {} if self.joint is None else dict(self.joint.profiles)

    @property
    def delays(self) -> dict[str, float]:
        """Delays of inputs [s] by input, estimated or fixed."""
        return dict(self.model.structure.delay)

    @property
    def limits(self) -> dict[str, float]:
        """Saturations (``sat_u``) and dead zones (``dead_u``) of inputs in their units, estimated or fixed."""
        limits = [(limit.name, limit.value) for limit in self.model.structure.limits]
        return {n: float(v) for n, v in limits if not isinstance(v, tuple)}

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Parameters by name: orders, coefficients, delays and limits, with standard errors, intervals and units."""
        model = self.model
        coefficients = model.coefficients if self.task is None else self.task.structure.coefficient_names
        free = {*model.orders, *coefficients, *self.standard_errors}
        values_by_name = {f"delay_{n}": v for n, v in self.delays.items()} | self.limits
        values = self._values | {n: v for n, v in values_by_name.items() if n not in self._values}
        return parameter_estimates(model, values, errors=self.standard_errors, intervals=self.intervals, free=free)

    @property
    def _values(self) -> dict[str, float]:
        """Orders, coefficients and estimated delays and limits by name."""
        fit = {} if self.joint is None else self.joint.values_by_name
        return {**self.orders, **fit, **self.coefficients}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows and columns of ``covariance``."""
        return () if self.joint is None else tuple(self.joint.names)

    @property
    def covariance(self) -> Floats:
        """Covariance matrix of the estimated parameters, robust to colored residuals; 0 by 0 for other methods.

        Variances are infinite for parameters that the data do not determine, and their covariances NaN.
        """
        return np.zeros((0, 0)) if self.joint is None else self.joint.covariance

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients by name."""
        return self.model.coefficients

    @property
    def equation_error(self) -> dict[str, Metrics]:
        """Metrics of the equation error by output."""
        return self.comparison.equation_error

    @property
    def output_error(self) -> dict[str, Metrics]:
        """Metrics of the simulation error by output."""
        return self.comparison.output_error

    @property
    def fit(self) -> dict[str, float]:
        """Fit of the simulation in percent, by output."""
        return self.comparison.fit

    #: The same, by the name that has the unit.
    fit_percent = fit

    def physical(self, **values: float) -> dict[str, PhysicalParameter]:
        """Return the physical parameters of a flexible link; see :func:`ftlm.physical_parameters`.

        Parameters
        ----------
        **values
            One parameter per stage by name, such as ``J_12=0.1704``.

        Returns
        -------
        dict
            Every parameter of the stage by name, with standard error, interval and unit.

        Raises
        ------
        ModelError
            A model without coefficient law or intervals, or a name that is not a parameter of it.
        """
        if self.joint is None:
            raise ModelError(
                f"method {self.method!r} gives no joint covariance; identify by {parameter('method', 'output-error')}"
            )
        return physical_parameters(self.joint, values)

    @check_arguments
    def profile(
        self,
        *names: str,
        level: float = 0.95,
        threads: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> dict[str, ProfileInterval]:
        """Compute profile-likelihood intervals: at each value of a parameter all others are refitted.

        If the cost is a parabola, they equal estimate ± standard errors. In a curved valley they may be asymmetric or
        unbounded, and standard errors mean little. The cost may rise by the square of the normal quantile times the
        noise variance, widened for colored residuals; a robust loss keeps the weights of the fit. Each bound is
        followed continuously from the optimum, so another optimum beyond a ridge is not found.

        A bound takes two to four refits if the cost is nearly quadratic, and up to forty in a long valley: ten to two
        hundred simulations per parameter, each as long as one evaluation on the fit's finest grid. The result does not
        depend on the number of threads. Ctrl-C ends the search within a refit.

        Parameters
        ----------
        *names
            Free orders, free coefficients, delays (``"delay_u"``); all of them where none is named. Not those that
            follow from a coefficient law.
        level
            Probability, between 0 and 1.
        threads
            By default all cores.
        progress
            Called with (ends found, ends in all).

        Returns
        -------
        dict of ProfileInterval
            By name.

        Raises
        ------
        ModelError
            A method without a likelihood, a fit with a reference, a name that is no free number, a level that is no
            probability.
        ConvergenceError
            The profile leads to an optimum below the fit's.
        """
        from ftlm.estimation.confidence_intervals import result_profiles

        return result_profiles(self, names, level, check_threads(threads), progress)

    @check_arguments
    def resid(self, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
        """Run residual tests on other runs; see :func:`ftlm.resid`."""
        return resid(self.model, runs, lags=lags)

    @check_arguments
    def validate(self, runs: Run | Sequence[Run]) -> Validation:
        """Compute both errors on runs that the model was not identified from, with a verdict.

        Parameters
        ----------
        runs
            One run or several with the same names and units.

        Returns
        -------
        Validation
            A :class:`ftlm.Comparison` with a ``.verdict``. Its findings name a fit that falls, and runs from which the
            model was identified.

        Raises
        ------
        DataError
            Runs that do not fit the model.
        """
        from ftlm.estimation.model_checks import validate
        from ftlm.estimation.verdict import validation_with_verdict

        return validation_with_verdict(self, validate(self, runs))

    @check_arguments
    def report(
        self, path: str | os.PathLike[str], *, validation: Run | Sequence[Run] | None = None, force: bool = False
    ) -> Path:
        """Write everything about this result to one HTML file that opens offline.

        Parameters
        ----------
        path
            File to write.
        validation
            Validation runs; without them the page says that the model was not validated.
        force
            Overwrite an existing file.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        DataError
            A validation run that does not fit the model; the file exists and ``force`` is not set, or cannot be
            written.
        """
        from ftlm.report.html_report import identification_page

        return identification_page(self, path, validation=validation, force=force)

    def to_frame(self) -> Any:
        """Return the parameters as a pandas frame: value, standard error, 95 % interval, unit, nominal value."""
        return parameter_frame(self.parameters.values(), self.model.structure.reference)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        limits = ["limits"] if self.limits else []
        return {
            **attributes(self, ("method", "settings")),
            "equations": {e.output: self.model.structure.equation_text(e) for e in self.model.equations},
            **attributes(self, ("orders", "coefficients", "delays", *limits, "standard_errors", "intervals")),
            "profiled": list(self.profiles),
            **self.comparison.to_dict(),
            **attributes(self, ("residuals", "information", "searches")),
            "choice": None if self.joint is None else self.joint.origin_text,
            **attributes(self, ("findings", "warnings")),
        }

    @property
    def verdict(self) -> Verdict:
        """Verdict ``"trust"``, ``"with care"`` or ``"do not use"``, with one reason.

        It prints as one sentence; ``.reasons`` has all that speaks against the model, most serious first. Without a
        validation no model is trusted, because it is not known how well it predicts other data: ``validate(runs)``
        returns the verdict that includes other runs.

        Notes
        -----
        The first of these rules that applies gives the reason.

        *Do not use*: the simulation overflows or has an unstable pole; a parameter is not identifiable (infinite
        standard error); NR exceeds 0.5 for an output, on estimation or validation runs, together or on one of them; the
        own orders of an equation make it an identity.

        *With care*: on validation the fit falls by 20 points, or the residual (100 - fit) exceeds 10 % and three times
        that of estimation, or 5 % and five times; stability is undecided, or the damping of an oscillation is not
        significantly positive (an integrator is no fault); residuals are correlated with an input, are not white, or
        are colored in a closed loop (each only above a thousandth of the output); the fit did not converge; a
        parameter has no effect, a coefficient has a relative standard error above 0.5, an order one above 0.25, a delay
        or a limit an unbounded interval; an offset is hidden by the initial conditions; another finding of this level;
        no standard errors; no validation.

        A saved model keeps the findings against it, and has the same verdict.
        """
        from ftlm.estimation.verdict import verdict

        return verdict(self)

    @check_arguments
    def summary(self, validation: Comparison | None = None) -> str:
        """Return the printed summary: verdict, equations, parameters, gain, modes, fit and three warnings.

        Parameters
        ----------
        validation
            Result of :meth:`validate`; None for the summary without a validation.

        Raises
        ------
        ModelError
            The validation does not come from :meth:`validate`.
        """
        from ftlm.report.text_summary import summary

        if not (validation is None or isinstance(validation, Comparison)):
            raise ModelError(f"validation is {type(validation).__name__}; give what validate(run) returns")
        return summary(self, validation)

    def details(self) -> str:
        """Return all results as text: settings, errors, criteria, searches, initial terms and warnings."""
        from ftlm.report.text_summary import settings_text

        lines = [f"{self.model.structure.name}: {self.method}, {settings_text(self.settings)}"]
        lines += [f"  {self.model.structure.equation_text(e)}" for e in self.model.equations]
        reference = self.model.structure.reference
        errors = self.standard_errors
        for name, value in self._values.items():
            spread = f" ± {format_bound(errors[name]):<10}" if name in errors else ""
            if name in self.profiles:
                spread += f"   {self.profiles[name]}"
            reference_text = f"   (stated {reference[name]:.6g})" if name in reference else ""
            lines.append(f"  {name:<12}{value:>14.6g}{spread}{reference_text}")
        if self.joint is not None:
            lines.append(f"  {self.joint.origin_text}")
        if errors:
            others = ", but those written out: by profile likelihood" if self.profiles else ""
            lines.append(f"  (value ± standard error; 95 % intervals are ± 1.96 of these{others})")
        lines.append(str(replace(self.comparison, findings=())))
        if self.residuals is not None:
            white = ", ".join(f"{o} {'yes' if w else 'no'}" for o, w in self.residuals.white.items())
            free = ", ".join(f"{o} {w}" for o, w in self.residuals.independence.items())
            around = [f"{u} around {o}" for o, r in self.residuals.outputs.items() for u in r.feedback]
            loop = f"; closed loop of {', '.join(around)}" if around else ""
            lines.append(f"residuals white: {white}; independent of the inputs: {free}{loop} (99 %)")
        if self.information is not None:
            lines.append(str(self.information))
        for name, search in self.searches.items():
            lines.append(
                f"order search ({name}): {search.candidates} candidates, {len(search.table)} "
                f"kept{search.excluded_summary}"
            )
        lines += _initial_in_words(self.comparison)
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        from ftlm.report.html_report import identification_html

        return identification_html(self)


def _initial_in_words(comparison: Comparison) -> list[str]:
    """Return one line for each output with initial terms, by run."""
    lines = []
    for (run, _, _), initial in zip(comparison.per_run, comparison.initial, strict=True):
        for output, terms in initial.items():
            if terms:
                listed = ", ".join(
                    f"{v:.4g} t^{e:g}" if e > -1 else f"{filter_state(e)} {v:.4g}" for e, v in terms.items()
                )
                lines.append(f"initial terms of {output} in {run} (of that run alone): {listed}")
    return lines
