"""Result of an identification: model, fit, residual tests, verdict, and physical parameters of a flexible arm."""

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
from ftlm.model.parameter_estimates import Parameter, offset_estimates, parameter_estimates, parameter_frame
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

#: Names of the physical parameters of stage j, and their units for integer orders.
PHYSICAL_UNITS = {
    "K_s{j}": "N m/rad",
    "J_{j}1": "kg m^2",
    "J_{j}2": "kg m^2",
    "B_{j}1": "N m s/rad",
    "B_{j}2": "N m s/rad",
    "K_tau{j}": "N m/A",
}
#: Relative step of the numerical gradient. The resulting error is far below the uncertainty of a standard error.
GRADIENT_STEP = 1e-6


@dataclass(frozen=True)
class PhysicalParameter:
    """Value of a physical parameter with its standard error and unit.

    Parameters
    ----------
    value, standard_error
        Value and standard error in ``unit``. A parameter that the user gave has standard error 0.
    unit
        Unit of the value for integer orders. With fractional orders, the value has this unit times a power of the
        second.
    """

    value: float
    standard_error: float
    unit: str

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval (low, high) in ``unit``."""
        return self.value - NORMAL_95 * self.standard_error, self.value + NORMAL_95 * self.standard_error

    def __str__(self) -> str:
        return f"{self.value:.6g} ± {format_bound(self.standard_error)} {self.unit}"


@check_arguments
def physical_parameters(joint: JointFit, known_values: Mapping[str, float]) -> dict[str, PhysicalParameter]:
    """Return the physical parameters of a flexible link from its coefficients and one known parameter per stage.

    The coefficients are a = K_s/J_1, b = -B_1/J_1, d = B_2/J_1, g = K_tau/J_1 and r = (J_1 + J_2)/J_2, eqs. (16)-(21)
    of the paper, or j = J_1/J_2 in place of r. They determine five ratios of six parameters. Standard errors follow
    from the joint covariance to first order. The known value is treated as exact.

    Parameters
    ----------
    joint
        Joint output-error fit of a :func:`flexible_link` with its coefficient law.
    known_values
        One parameter per stage by name: K_s1, J_11, J_12, B_11, B_12 or K_tau1 for stage 1; K_s2, J_21, … for stage 2.

    Returns
    -------
    dict
        All parameters by name, for each stage with a known parameter.

    Raises
    ------
    ModelError
        If no name is given, a name is unknown, two belong to one stage, a value is not positive, or the fit has no
        coefficient law.
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
        physical_value = real_number(name, value)
        if not 0 < physical_value < math.inf:
            raise ModelError(f"{name} = {value!r} is not positive; give a positive value")
        h = 2 * stage - 1
        ratio = f"j{stage}" if f"j{stage}" in joint.coefficients else f"r{stage}"
        coefficient_names = [f"a{h}", f"b{h}", f"d{h}", f"g{h}", ratio]
        missing_names = [n for n in coefficient_names if n not in joint.coefficients]
        if missing_names:
            raise ModelError(
                f"coefficient {missing_names[0]} is not in the fit; identify flexible_link(stage={stage}) with "
                "laws=('orders', 'coefficients') and all terms free"
            )
        indices = [joint.names.index(n) for n in coefficient_names]
        # The last coefficient is r = 1 + J_1/J_2, or j = J_1/J_2, to which 1 is added.
        estimate = joint.values[indices] + np.array([0.0, 0.0, 0.0, 0.0, float(ratio.startswith("j"))])
        covariance = joint.covariance[np.ix_(indices, indices)]
        values = _physical(estimate, name, physical_value, stage)
        slopes = []
        for i, c in enumerate(estimate):
            step = GRADIENT_STEP * (abs(c) if c else 1.0)
            shift = step * np.eye(estimate.size)[i]
            upper, lower = (_physical(estimate + change, name, physical_value, stage) for change in (shift, -shift))
            slopes.append((upper - lower) / (2 * step))
        gradient = np.array(slopes).T
        errors = propagated_errors(gradient, covariance)
        units = list(PHYSICAL_UNITS.items())
        for (pattern, unit), v, e in zip(units, values.tolist(), errors.tolist(), strict=True):
            out[pattern.format(j=stage)] = PhysicalParameter(v, e, unit)
    return out


def _physical(coefficients: NDArray[np.float64], name: str, value: float, stage: int) -> NDArray[np.float64]:
    """Return K_s, J_1, J_2, B_1, B_2 and K_tau of a stage from a, b, d, g, r and one known parameter."""
    a, b, d, g, r = coefficients
    # All parameters are relative to J_1.
    robust_weights = np.array([a, 1.0, 1.0 / (r - 1.0), -b, d, g])
    index = [pattern.format(j=stage) for pattern in PHYSICAL_UNITS].index(name)
    out: NDArray[np.float64] = value / robust_weights[index] * robust_weights
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
        Grid of the order search; None for the default grid.
    """

    runs: tuple[Run, ...]
    structure: Structure
    order_grid: OrderGrid | None = None

    def part_order_grid(self, group: Structure) -> OrderGrid:
        """Return the order grid restricted to the free orders of `group`, a structure with some of the equations."""
        return restrict_order_grid(self.order_grid, group)


@dataclass(frozen=True)
class Identification:
    """Result of an identification: model, fit, residuals, settings and verdict.

    Parameters
    ----------
    model
        Identified model.
    method
        Name of the estimation method.
    comparison
        Simulation error and equation error on the estimation runs.
    searches
        Order searches that determined the orders, by output, or by ``"stage"`` for a search under an order law. Empty
        without an order search.
    settings
        Options and decisions of the estimator by name.
    findings
        Findings about data, fit and model.
    joint
        Joint output-error fit with its covariance; None for methods that fit the equation error.
    residuals
        Residual tests on the estimation runs; None if the runs are too short.
    information
        Information criteria, with orders counted as parameters; None without residuals.
    task
        Estimation runs and structure.
    coefficient_errors
        Standard errors of coefficients, and of searched orders, for methods without a joint covariance.
    offset_errors
        Standard errors of ``comparison.offsets``, in the same form; empty for methods without a joint covariance.
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
    offset_errors: tuple[dict[str, dict[str, float]], ...] = field(default=())

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences."""
        return texts(self.findings)

    @property
    def orders(self) -> dict[str, float]:
        """Values of the free orders by name."""
        return dict(self.model.orders)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the parameters by name; {} for methods that give none.

        Standard errors of output error are robust to colored residuals. Instrumental variables give standard errors of
        the coefficients and, after an order search, of the orders.
        """
        if self.joint is None:
            return dict(self.coefficient_errors)
        return {**self.joint.standard_errors, **self.joint.derived_errors}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % confidence intervals (low, high) of the parameters by name.

        They are estimate ± 1.96 standard errors. Parameters of a joint fit with a nonquadratic cost have
        profile-likelihood intervals instead, which may be asymmetric or unbounded.
        """
        values, errors = self.values, self.standard_errors
        quadratic = {n: (values[n] - NORMAL_95 * e, values[n] + NORMAL_95 * e) for n, e in errors.items()}
        return {**quadratic, **{n: (p.low, p.high) for n, p in self.profiles.items()}}

    @property
    def profiles(self) -> dict[str, ProfileInterval]:
        """95 % profile-likelihood intervals by name, for the parameters that have one; see :meth:`profile`."""
        return {} if self.joint is None else dict(self.joint.profiles)

    @property
    def delays(self) -> dict[str, float]:
        """Delays of inputs [s] by input name, estimated or fixed."""
        return dict(self.model.structure.delay)

    @property
    def limits(self) -> dict[str, float]:
        """Saturations (``sat_u``) and dead zones (``dead_u``) by name in the unit of the input, estimated or fixed."""
        limits = [(limit.name, limit.value) for limit in self.model.structure.limits]
        return {n: float(v) for n, v in limits if not isinstance(v, tuple)}

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Orders, coefficients, delays, limits and offsets by name, with standard errors, intervals and units."""
        model = self.model
        coefficients = model.coefficients if self.task is None else self.task.structure.coefficient_names
        free = {*model.orders, *coefficients, *self.standard_errors}
        values_by_name = {f"delay_{n}": v for n, v in self.delays.items()} | self.limits
        values = self.values | {n: v for n, v in values_by_name.items() if n not in self.values}
        estimates = parameter_estimates(model, values, errors=self.standard_errors, intervals=self.intervals, free=free)
        return {**estimates, **self.offsets}

    @property
    def offsets(self) -> dict[str, Parameter]:
        """Offsets (constants, ramps and levels) by name; each is estimated for one estimation run."""
        names = [name for name, _, _ in self.comparison.per_run]
        return offset_estimates(self.model, names, self.comparison.offsets, self.offset_errors)

    @property
    def values(self) -> dict[str, float]:
        """Values of orders, coefficients, and estimated delays, saturations and dead zones by name."""
        fit = {} if self.joint is None else self.joint.values_by_name
        return {**self.orders, **fit, **self.coefficients}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows and columns of ``covariance``."""
        if self.joint is not None:
            return tuple(self.joint.names)
        return tuple(n for n, p in self.parameters.items() if not p.fixed and n in self.values)

    @property
    def covariance(self) -> Floats:
        """Covariance matrix of the parameters in ``names``, robust to colored residuals.

        Parameters that are not identifiable have infinite variances, and NaN covariances. Methods other than output
        error give no covariances: these are NaN, and the variances are the squares of the standard errors, if any.
        """
        if self.joint is not None:
            return self.joint.covariance
        matrix = np.full((len(self.names), len(self.names)), math.nan)
        np.fill_diagonal(matrix, [self.standard_errors.get(n, math.nan) ** 2 for n in self.names])
        return matrix

    @property
    def coefficients(self) -> dict[str, float]:
        """Values of the coefficients by name."""
        return self.model.coefficients

    @property
    def equation_error(self) -> dict[str, Metrics]:
        """Metrics (fit, RMSE, …) of the equation error by output."""
        return self.comparison.equation_error

    @property
    def output_error(self) -> dict[str, Metrics]:
        """Metrics (fit, RMSE, …) of the simulation error by output."""
        return self.comparison.output_error

    @property
    def fit(self) -> dict[str, float]:
        """Fit of the simulation to the measured output in percent, by output."""
        return self.comparison.fit

    #: Same as `fit`, under a name that states the unit.
    fit_percent = fit

    def physical_parameters(self, **values: float) -> dict[str, PhysicalParameter]:
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
            If the model has no coefficient law or no intervals, or a name is not one of its physical parameters.
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
        """Compute profile-likelihood intervals of parameters.

        A profile refits all other parameters at each value of one parameter.

        The interval of a parameter contains the values at which the rise of the sum of squares is below a limit. The
        limit is the squared normal quantile times the noise variance, enlarged for colored residuals. For a quadratic
        cost, the interval equals the Wald interval. If the cost has a curved valley, the interval may be asymmetric or
        unbounded, and standard errors are misleading. With a robust loss, the weights of the fit are kept. Each bound
        is followed continuously from the optimum, so another optimum behind a ridge is not found.

        A bound takes two to four refits if the cost is nearly quadratic, and up to forty in a long valley. This amounts
        to 10 to 200 simulations per parameter with the time step of the fit. The result does not depend on the number
        of threads. Ctrl-C stops the search after at most one refit.

        Parameters
        ----------
        *names
            Names of free orders, free coefficients and delays (``"delay_u"``); by default all of them. Coefficients
            that follow from a coefficient law have no profile.
        level
            Confidence level, between 0 and 1.
        threads
            Number of threads, by default all cores.
        progress
            Callback with (bounds found, total bounds).

        Returns
        -------
        dict of ProfileInterval
            Intervals by parameter name.

        Raises
        ------
        ModelError
            If the method has no likelihood, the fit used a reference signal, a name is not a free parameter, or the
            level is not between 0 and 1.
        ConvergenceError
            If the profile leads to an optimum with a lower cost than the fit.
        """
        from ftlm.estimation.confidence_intervals import result_profiles

        return result_profiles(self, names, level, check_threads(threads), progress)

    @check_arguments
    def resid(self, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
        """Return residual tests of the model on other runs; see :func:`ftlm.resid`."""
        return resid(self.model, runs, lags=lags)

    @check_arguments
    def validate(self, runs: Run | Sequence[Run]) -> Validation:
        """Compare the model with runs that it was not identified from, and return errors and verdict.

        Parameters
        ----------
        runs
            One run or several with the same names and units.

        Returns
        -------
        Validation
            :class:`ftlm.Comparison` with simulation error, equation error and a ``.verdict``. Findings report a fit
            that is lower than on the estimation runs, residuals that depend on an input, and validation runs that were
            also used for estimation.

        Raises
        ------
        DataError
            If a run lacks a signal of the model or has other units.
        """
        from ftlm.estimation.model_validation import validate
        from ftlm.estimation.verdict import validation_with_verdict

        return validation_with_verdict(self, validate(self, runs))

    @check_arguments
    def report(
        self, path: str | os.PathLike[str], *, validation: Run | Sequence[Run] | None = None, force: bool = False
    ) -> Path:
        """Write all results, with charts, to one HTML file that opens offline.

        Parameters
        ----------
        path
            File to write.
        validation
            Validation runs. Without them, the page states that the model was not validated.
        force
            Overwrite an existing file.

        Returns
        -------
        pathlib.Path
            Path of the written file.

        Raises
        ------
        DataError
            If a validation run lacks a signal of the model, the file exists and ``force`` is False, or the file cannot
            be written.
        """
        return self._write_page(path, validation=validation, force=force)

    def _write_page(self, path: str | os.PathLike[str], **content: Any) -> Path:
        """Write a report with further content; see :func:`ftlm.report.identification_page`."""
        from ftlm.report.html_report import identification_page

        return identification_page(self, path, **content)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of the parameters: value, standard error, 95 % interval, unit, nominal value."""
        return parameter_frame(self.parameters.values(), self.model.structure.nominal_values)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        limits = ["limits"] if self.limits else []
        return {
            **attributes(self, ("method", "settings")),
            "equations": {e.output: self.model.structure.equation_text(e) for e in self.model.equations},
            **attributes(self, ("orders", "coefficients", "delays", *limits, "standard_errors", "intervals")),
            "profiled": list(self.profiles),
            **self.comparison.to_dict(),
            **attributes(self, ["offset_errors"] if self.offset_errors else []),
            **attributes(self, ("residuals", "information", "searches")),
            "choice": None if self.joint is None else self.joint.origin_text,
            **attributes(self, ("findings", "warnings")),
        }

    @property
    def verdict(self) -> Verdict:
        """Verdict ``"trust"``, ``"with care"`` or ``"do not use"``, with its reason.

        It prints as one sentence; ``.reasons`` has all findings against the model, most serious first. Without a
        validation the verdict is at best "with care", because it is unknown how well the model predicts other data.
        ``validate(runs).verdict`` takes other runs into account.

        Notes
        -----
        The first of these rules that applies gives the reason. NR is the normalized residual, the RMS of the simulation
        error relative to the standard deviation of the output.

        *Do not use*:

        - The simulation overflows, or the model has a significantly unstable pole.
        - The motion is chaotic, or a parameter is not identifiable (infinite standard error).
        - NR of an output exceeds 0.5, over all estimation or validation runs or on one of them. If noise or an outlier
          at an end of the run explains this, the level is "with care".
        - The orders of an equation make it nearly an identity.

        *With care*:

        - The fit to validation runs is lower by 20 percentage points than that to estimation runs. Or the validation
          residual, 100 minus the fit, exceeds 10 % and three times the estimation residual, or 5 % and five times it.
        - Stability is not decided, or the damping of an oscillatory mode is not significantly positive. An integrator
          is permitted.
        - Equations that take other outputs as measured are significantly unstable if they are simulated together. Or
          the highest power of s in the characteristic function of coupled equations significantly exceeds the sum of
          their orders, so that they have an unstable pole.
        - Residuals are correlated with an input or depend on the direction of motion. Or they are not white, and no
          test shows that they are independent of the inputs. Or a closed loop biases the estimates. Residuals below a
          thousandth of the output do not count.
        - The fit did not converge.
        - The relative standard error of a coefficient exceeds 0.5, or its profile-likelihood interval is unbounded or
          contains 0. The standard error of an order exceeds 0.25. The interval of an order, delay, saturation or dead
          zone has no upper bound.
        - Initial conditions may hide an offset.
        - Another finding has this level, the method gives no standard errors, or there is no validation.

        A saved model stores its findings, so its verdict is the same.
        """
        from ftlm.estimation.verdict import verdict

        return verdict(self)

    @check_arguments
    def summary(self, validation: Comparison | None = None) -> str:
        """Return the summary as text: verdict, equations, parameters, gain, modes, fit and up to three warnings.

        Parameters
        ----------
        validation
            Result of :meth:`validate`; None for the summary without a validation.

        Raises
        ------
        ModelError
            If `validation` is not a result of :meth:`validate`.
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
        reference = self.model.structure.nominal_values
        errors = self.standard_errors
        for name, value in self.values.items():
            error_text = f" ± {format_bound(errors[name]):<10}" if name in errors else ""
            if name in self.profiles:
                error_text += f"   {self.profiles[name]}"
            reference_text = f"   (nominal {reference[name]:.6g})" if name in reference else ""
            lines.append(f"  {name:<12}{value:>14.6g}{error_text}{reference_text}")
        if self.joint is not None:
            lines.append(f"  {self.joint.origin_text}")
        if errors:
            interval_text = ", but those written out: by profile likelihood" if self.profiles else ""
            lines.append(f"  (value ± standard error; 95 % intervals are ± 1.96 of these{interval_text})")
        lines.append(str(replace(self.comparison, findings=())))
        if self.residuals is not None:
            white_text = ", ".join(f"{o} {'yes' if w else 'no'}" for o, w in self.residuals.white.items())
            free = ", ".join(f"{o} {w}" for o, w in self.residuals.independence.items())
            feedback_loops = [f"{u} around {o}" for o, r in self.residuals.outputs.items() for u in r.feedback]
            loop = f"; closed loop of {', '.join(feedback_loops)}" if feedback_loops else ""
            lines.append(f"residuals white: {white_text}; independent of the inputs: {free}{loop} (99 %)")
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
    """Return text lines that describe the initial terms of each output, by run."""
    lines = []
    for (run, _, _), initial in zip(comparison.per_run, comparison.initial, strict=True):
        for output, terms in initial.items():
            if terms:
                values_text = ", ".join(
                    f"{v:.4g} t^{e:g}" if e > -1 else f"{filter_state(e)} {v:.4g}" for e, v in terms.items()
                )
                lines.append(f"initial terms of {output} in {run} (of that run alone): {values_text}")
    return lines
