"""Automatic selection of the structure of one output: integer-order forms and variants, then fractional orders.

The variants have zeros, delays, friction or an offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.data.sampling import longest_delay
from ftlm.errors import FtlmError
from ftlm.estimation.closed_loop import run_with_inputs
from ftlm.estimation.estimators import fitted_model
from ftlm.estimation.nuisance_parameters import has_white_residuals
from ftlm.estimation.output_error import JointFit
from ftlm.simulation.discretization import values_at_residuals
from ftlm.structure.expression import derivative_text
from ftlm.structure.parser import equation
from ftlm.structure.structure import Structure, check_offset, unused_names
from ftlm.structure_selection.candidates import describe_structure
from ftlm.structure_selection.cross_validation import Trial, fit, fit_criterion, residual_variance_inflation
from ftlm.structure_selection.stepwise import CandidateEvaluator
from ftlm.validation.comparison import simulate_runs
from ftlm.validation.feedback import feedback_test
from ftlm.validation.residual_tests import friction_term, sign_tanh_slope

#: Highest integer order.
MAX_ORDER = 4
#: Number of best candidates whose neighbors are fitted first, and maximum numbers of validated candidates with integer
#: orders and with fractional orders.
EXTENDED_CANDIDATES, VALIDATED_CANDIDATES, VALIDATED_FRACTIONAL = 3, 6, 2
#: Maximum difference from the lowest Schwarz criterion for a validated candidate: with integer orders (the best of each
#: order is always validated), and with fractional orders.
MAX_BIC_GAP, MAX_FRACTIONAL_BIC_GAP = 60.0, 10.0
#: Minimum decrease of the Schwarz criterion by a delay or an offset in a first test, for which it is tried in all
#: candidates. Also the maximum difference from the lowest criterion for forms whose neighbors are fitted.
MIN_BIC_DECREASE = 6.0
#: Order of the best integer-order form at which the form D^2 y = a1 D^mu y + a0 y + … is tried as well.
FRACTIONAL_DAMPING_ORDER = 2
#: Offsets that are tried for free responses (runs without an input).
FREE_OFFSETS = ("none", "level")
#: Initial guesses of the order alpha of fractional forms.
INITIAL_FRACTIONAL_ORDERS = (0.5, 0.8, 1.2, 1.7)

#: Delays of inputs by name [s]: a number, or bounds (lower, upper) of an estimated delay.
Delays: TypeAlias = Mapping[str, float | tuple[float, float]]


@dataclass(frozen=True)
class IntegerOrderForm:
    """Form of an integer-order transfer function from the inputs to one output, with dry friction and an offset.

    Parameters
    ----------
    order
        Degree of the denominator.
    zeros
        Degree of the numerator of each input.
    delayed
        Whether every input has a free delay.
    integrator
        Whether there is a pole at s = 0, so that the equation has no term in the output itself.
    offset
        Kind of offset of each run: ``"none"``; ``"level"``, a constant added to the output, or with an integrator to
        the input; or ``"ramp"``, a linear trend.
    friction
        Coulomb friction: ``"none"``; ``"derivative"``, which opposes the derivative of the output (a position); or
        ``"output"``, which opposes the output itself (a speed).
    """

    order: int
    zeros: int
    delayed: bool = False
    integrator: bool = False
    offset: str = "none"
    friction: Literal["none", "derivative", "output"] = "none"

    @property
    def has_feedthrough(self) -> bool:
        """Whether the form has direct feedthrough from an input."""
        return self.zeros >= self.order

    def structure(self, problem: OutputProblem) -> Structure:
        """Return the structure that has this form, for one output."""
        output, suffix = problem.output, problem.suffix
        powers = range(self.order - 1, int(self.integrator) - 1, -1)
        output_terms = [f"a{k}{suffix} {derivative_text(k, output)}" for k in powers]
        input_terms = [
            f"b{index}{k}{suffix} {derivative_text(k, name)}"
            for index, name in problem.numbered_drivers
            for k in range(self.zeros, -1, -1)
        ]
        text = f"{derivative_text(self.order, output)} = {' + '.join([*output_terms, *input_terms])}"
        if self.friction != "none":
            slope = problem.tanh_slope if self.friction == "output" else math.inf
            text += " " + friction_term(output, f"fc{suffix}", slope)
        delay = problem.input_delays(delayed=self.delayed)
        return _with_offset(equation(text, delay=delay, initial=problem.initial), self.offset)


def _with_offset(structure: Structure, offset: str) -> Structure:
    """Return a structure with an offset; for an integrating plant ``"level"`` becomes ``"constant"``.

    The offset of an input sensor makes the output of an integrating plant ramp, which a constant level of the output
    cannot describe.
    """
    level = "constant" if structure.integrates else "level"
    return replace(structure, offset=check_offset(level if offset == "level" else offset))


@dataclass(frozen=True)
class OutputProblem:
    """Selection problem of one output: runs, the output, and the signals that enter its equation.

    Parameters
    ----------
    runs
        Estimation runs.
    output
        Name of the output.
    drivers
        Names of the signals that enter its equation: inputs, and measured other outputs.
    delays
        Delays [s] that the user gave, by input: a number, or (lower, upper).
    suffix
        Suffix of the names of coefficients and orders, which distinguishes several outputs.
    initial
        Initial conditions of the runs.
    """

    runs: Sequence[Run]
    output: str
    drivers: tuple[str, ...]
    delays: Delays = field(default_factory=dict)
    suffix: str = ""
    initial: Literal["auto", "caputo"] = "auto"

    @property
    def numbered_drivers(self) -> list[tuple[str, str]]:
        """Pairs of a number for coefficient names and an input signal; the number is empty for a single signal."""
        return [(f"{k}_" if len(self.drivers) > 1 else "", name) for k, name in enumerate(self.drivers, 1)]

    @property
    def has_free_delays(self) -> bool:
        """Whether an input has no delay given as a number, so that its delay can be estimated."""
        return self.input_delays(delayed=False) != self.input_delays(delayed=True)

    @property
    def tanh_slope(self) -> float:
        """Slope s of tanh(s y), which replaces sign(y) in friction; infinite if the output never changes sign."""
        return sign_tanh_slope([run[self.output] for run in self.runs])

    def input_delays(self, *, delayed: bool) -> dict[str, float | tuple[float, float]]:
        """Return the delays [s] by input: a number, or an interval (lower, upper) in which the delay is estimated.

        With `delayed`, the result has every input, with a free delay where the user gave none. Otherwise it has only
        the given delays that are above 0, or whose lower bound is above 0.
        """
        inputs = [n for n in self.drivers if n in self.runs[0].inputs]
        delays = {n: d for n, d in self.delays.items() if n in inputs}
        if not delayed:
            return {n: d for n, d in delays.items() if (d[0] if isinstance(d, tuple) else d) > 0.0}
        return {**dict.fromkeys(inputs, (0.0, min(longest_delay(r.length, r.step) for r in self.runs))), **delays}


@dataclass(frozen=True)
class FittedForm:
    """Fit of a structure with its form (None for fractional orders), variance inflation of residuals, and BIC."""

    structure: Structure
    joint: JointFit
    form: IntegerOrderForm | None
    variance_inflation: float
    bic: float = math.inf


def _rank(fits: Sequence[FittedForm]) -> list[FittedForm]:
    """Return fits sorted by BIC, best first; BIC uses the smallest variance inflation among them."""
    inflation = min((f.variance_inflation for f in fits), default=1.0)
    return sorted((replace(f, bic=fit_criterion(f.joint, inflation)) for f in fits), key=lambda f: f.bic)


def _fit_form(problem: OutputProblem, form: IntegerOrderForm) -> FittedForm | None:
    """Return the fit of a form to the runs of a problem; None if it fails."""
    structure = form.structure(problem)
    try:
        joint = fit(problem.runs, structure, [], refine=False)
    except FtlmError:
        return None
    return FittedForm(structure, joint, form, residual_variance_inflation(joint))


@dataclass
class AutomaticSelection:
    """Automatic selection of the structure of one output.

    Parameters
    ----------
    problem
        Output, runs and input signals.
    evaluator
        Object that fits and validates candidates.
    """

    problem: OutputProblem
    evaluator: CandidateEvaluator
    #: Inputs that depend on the output. Forms with feedthrough are then not tried, because feedback within one sample
    #: resembles feedthrough.
    feedback: tuple[str, ...] = field(default=(), init=False)

    def run(self) -> list[Trial]:
        """Fit the candidates, validate the best ones, and return all trials of the `evaluator`."""
        fits = self._fit_integer_orders()
        if fits:
            # High orders overfit under colored noise, so the best form of each order is validated, whatever its BIC.
            best_by_order = _best_of_each_order(fits)
            close_fits = [f for f in fits if f.bic < fits[0].bic + MAX_BIC_GAP and f.form not in best_by_order]
            best_fits = [f for f in fits if f.form in best_by_order]
            best = self._validate([*best_fits, *close_fits[: VALIDATED_CANDIDATES - len(best_fits)]])
            all_fits = _rank([*fits, *self._fit_fractional_forms(fits, best)])
            lowest_bic = min(f.bic for f in all_fits if f.form is not None)
            fractional = [f for f in all_fits if f.form is None and f.bic < lowest_bic + MAX_FRACTIONAL_BIC_GAP]
            self._validate(fractional[:VALIDATED_FRACTIONAL])
        return self.evaluator.trials

    def _fit(self, forms: Sequence[IntegerOrderForm]) -> list[FittedForm]:
        """Return the fits of forms, sorted by BIC; a form whose fit fails becomes a failed trial."""
        return self._fit_structures([(f.structure(self.problem), f, []) for f in dict.fromkeys(forms)])

    def _fit_structures(
        self, items: Sequence[tuple[Structure, IntegerOrderForm | None, list[dict[str, float]]]]
    ) -> list[FittedForm]:
        joints = self.evaluator.map_candidates(lambda i: self.evaluator.fit_candidate(i[0], i[2], refine=False), items)
        fits_of_form = []
        for (structure, form, _), joint in zip(items, joints, strict=True):
            if isinstance(joint, JointFit):
                fits_of_form.append(FittedForm(structure, joint, form, residual_variance_inflation(joint)))
            else:
                self.evaluator.trials.append(self.evaluator.validate(describe_structure(structure), structure, joint))
        return _rank(fits_of_form)

    def _fit_integer_orders(self) -> list[FittedForm]:
        """Return the fits of integer-order forms and of variants of the best ones, sorted by BIC."""
        if not self.problem.drivers:
            # Free responses have neither zeros nor delays.
            return self._fit([IntegerOrderForm(n, 0, offset=o) for n in range(1, MAX_ORDER + 1) for o in FREE_OFFSETS])
        probes = self._fit_probes(IntegerOrderForm(2, 1))
        offset = "level" if _bic_decrease(probes, lambda f: f.offset == "level") > MIN_BIC_DECREASE else "none"
        forms = [IntegerOrderForm(n, n - 1, offset=offset) for n in range(1, MAX_ORDER + 1)]
        fits = self._fit_delayed(self._fit_zeros(forms, probes), offset)
        self.feedback = self._inputs_in_loop(fits)
        fits = self._fit_neighbors(self._fit_friction(fits, offset))
        # Fewer zeros may be better within an order even if a higher order fits the noise.
        while reduced := [
            form
            for form in (replace(f, zeros=f.zeros - 1) for f in _best_of_each_order(fits) if f.zeros > 0)
            if form not in {f.form for f in fits}
        ]:
            integer_fits = self._fit(reduced)
            if not integer_fits:
                break
            fits = _rank([*fits, *integer_fits])
        return fits

    def _fit_probes(self, form: IntegerOrderForm) -> list[FittedForm]:
        """Return the fits of a form without and with an output level, and decide whether all forms start in motion.

        A sensor that is set to zero in motion also starts at 0. If initial values lower the criterion clearly, the
        `problem` is changed so that all forms have them.
        """
        forms = [form, replace(form, offset="level")]
        probes = self._fit(forms)
        if self.problem.initial == "auto" and any(f.joint.initial == "rest" for f in probes):
            problem = replace(self.problem, initial="caputo")
            all_fits = _rank([*probes, *self._fit_structures([(f.structure(problem), f, []) for f in forms])])
            fits_in_motion = [f for f in all_fits if f.joint.initial != "rest"]
            lowest_at_rest = min(f.bic for f in all_fits if f.joint.initial == "rest")
            if fits_in_motion and fits_in_motion[0].bic < lowest_at_rest - MIN_BIC_DECREASE:
                self.problem = problem
                return fits_in_motion
        return probes

    def _inputs_in_loop(self, fits: Sequence[FittedForm]) -> tuple[str, ...]:
        """Return the inputs that depend on the output through feedback, as tested on residuals of the best form.

        The `fits`, best first, must be of forms without direct feedthrough.

        Feedback and direct feedthrough both correlate an input with the output in the same sample. With negative
        feedback the correlation and the static gain have opposite signs.
        """
        if not fits:
            return ()
        best = fits[0]
        problem, suffix = self.problem, self.problem.suffix
        residuals = [run_residuals[problem.output] for run_residuals in best.joint.residuals]
        signals = {n: [values_at_residuals(r, best.structure, n) for r in problem.runs] for n in problem.drivers}
        coefficients = best.joint.coefficients
        names = []
        for index, name in problem.numbered_drivers:
            values = signals[name]
            test = feedback_test(residuals, values, [v for n, v in signals.items() if n != name])
            gain = -coefficients.get(f"a0{suffix}", -1.0) * coefficients[f"b{index}0{suffix}"]
            if test.has_feedback or test.is_feedback_within_row(gain):
                names.append(name)
        return tuple(names)

    def _fit_neighbors(self, fits: list[FittedForm]) -> list[FittedForm]:
        """Return the given fits and further fits of neighbors of the best forms, sorted by BIC.

        A form of high order can approximate a missing property, such as a level or direct feedthrough. The search
        therefore moves to neighbors that have the property at a lower order, while BIC decreases.
        """
        forms_before = {f.form for f in fits}
        newest = [f.form for f in fits[:EXTENDED_CANDIDATES]]
        extended_forms: set[IntegerOrderForm | None] = {None}
        while newest:
            extended_forms.update(newest)
            neighbors = [n for form in newest if form for n in _neighbors(form) if self._is_admissible(n)]
            untried = [n for n in dict.fromkeys(neighbors) if n not in forms_before]
            forms_before.update(untried)
            fits = _rank([*fits, *self._fit(untried)])
            newest = [f.form for f in fits if f.bic < fits[0].bic + MIN_BIC_DECREASE and f.form not in extended_forms]
        return fits

    def _is_admissible(self, form: IntegerOrderForm) -> bool:
        """Whether a form is compatible with the detected feedback and the given delays."""
        free = not form.delayed or self.problem.has_free_delays
        return free and not (self.feedback and form.has_feedthrough)

    def _fit_zeros(self, forms: Sequence[IntegerOrderForm], fits: Sequence[FittedForm]) -> list[FittedForm]:
        """Return the fits extended by `forms`, and by variants of them with fewer zeros, sorted by BIC.

        Fewer zeros cannot reduce the residuals, so they lower BIC by at most the penalty of the removed zeros. Only
        variants that can still have the lowest BIC are fitted.
        """
        forms_before = {f.form for f in fits}
        ranked = _rank([*fits, *self._fit([f for f in forms if f not in forms_before])])
        lowest_bic = min((f.bic for f in ranked), default=math.inf)
        reduced = [
            replace(form, zeros=m)
            for form, fit in ((f.form, f) for f in ranked)
            if form is not None and form in forms
            for m in range(form.order - 1)
            if fit.bic - (form.order - 1 - m) * self._penalty(fit) < lowest_bic
        ]
        return _rank([*ranked, *self._fit(reduced)])

    def _penalty(self, fit: FittedForm) -> float:
        """Return the penalty in BIC for one more zero of every input signal."""
        return len(self.problem.drivers) * math.log(fit.joint.samples)

    def _fit_delayed(self, fits: list[FittedForm], offset: str) -> list[FittedForm]:
        """Return the fits extended by forms with delays, sorted by BIC.

        Forms above order 2 are tried only if a delay lowers BIC at order 1 or 2.
        """
        if not self.problem.has_free_delays:
            return fits
        delayed = [IntegerOrderForm(n, n - 1, delayed=True, offset=offset) for n in range(1, MAX_ORDER)]
        fits = _rank([*fits, *self._fit(delayed[:2])])
        criteria = {f.form: f.bic for f in fits if f.form is not None}
        if not any(
            bic < criteria.get(replace(form, delayed=False), math.inf) - MIN_BIC_DECREASE
            for form, bic in criteria.items()
            if form.delayed
        ):
            return fits
        return self._fit_zeros(delayed, fits)

    def _fit_friction(self, fits: list[FittedForm], offset: str) -> list[FittedForm]:
        """Return the fits extended by forms of order 1 and 2 with friction, if residuals are colored.

        The forms are added only if friction clearly lowers BIC.
        """
        delayed = bool(fits and fits[0].form and fits[0].form.delayed)
        speed = IntegerOrderForm(1, 0, delayed=delayed, offset=offset, friction="output")
        # Without friction, further poles and zeros may have replaced a delay.
        speeds = [speed] if delayed else [speed, replace(speed, delayed=True)]
        changes_sign = math.isfinite(self.problem.tanh_slope)
        position = replace(speed, order=2, friction="derivative")
        for form in (speeds if changes_sign else []) + [position, replace(position, integrator=True)]:
            if fits and not has_white_residuals(fits[0].joint) and self._is_friction_likely(form):
                # Negative friction would add energy, so it is not physical.
                friction_fits = [f for f in self._fit([form]) if f.joint.coefficients[f"fc{self.problem.suffix}"] > 0.0]
                ranked = _rank([*fits, *friction_fits])
                lowest_bic = min(f.bic for f in ranked if f.form != form)
                fits = ranked if ranked[0].bic < lowest_bic - MIN_BIC_DECREASE else fits
        return fits

    def _is_friction_likely(self, form: IntegerOrderForm) -> bool:
        """Whether friction, computed from the simulation without friction, is significant as an additional input.

        The input is significant if it lowers BIC and its coefficient has the sign of friction. Both fits, with and
        without this input, are linear, so they are faster than a fit with friction. The result is True if a fit fails.
        """
        # A computed force has one sample per row, so nonuniform samples are replaced by those on the grid of the run.
        problem = replace(self.problem, runs=[run_with_inputs(run, {}) for run in self.problem.runs])
        linear = replace(form, friction="none")
        without = _fit_form(problem, linear)
        if without is None:
            return True
        model, runs = fitted_model(without.joint, without.structure), as_runs(problem.runs)
        try:
            simulations = simulate_runs(model, runs)
        except FtlmError:
            return True
        row = model.outputs.index(problem.output)
        velocity_signs = [
            np.tanh(problem.tanh_slope * samples.outputs[row])
            if form.friction == "output"
            else np.sign(np.gradient(samples.outputs[row]))
            for samples in simulations
        ]
        (name,) = unused_names("friction_force", 1, without.structure, runs[0].signals)
        with_force = _fit_form(
            replace(
                problem,
                runs=[run_with_inputs(run, {name: -sign}) for run, sign in zip(runs, velocity_signs, strict=True)],
                drivers=(*problem.drivers, name),
                delays={**problem.delays, name: 0.0},
            ),
            linear,
        )
        if with_force is None:
            return True
        is_better = _rank([without, with_force])[0].structure is with_force.structure
        coefficient = with_force.joint.coefficients[f"b{len(problem.drivers) + 1}_0{problem.suffix}"]
        return is_better and coefficient > 0.0

    def _validate(self, candidates: Sequence[FittedForm]) -> FittedForm | None:
        """Validate fitted forms, and return the one with the best prediction; None if no validation succeeds."""
        validations = self.evaluator.map_candidates(
            lambda f: self.evaluator.validate(describe_structure(f.structure), f.structure, f.joint), candidates
        )
        self.evaluator.trials += validations
        ranked = sorted(zip(validations, candidates, strict=True), key=lambda pair: (pair[0].unstable, pair[0].score))
        return ranked[0][1] if ranked else None

    def _fit_fractional_forms(self, fits: Sequence[FittedForm], best: FittedForm | None) -> list[FittedForm]:
        """Return the fits of fractional-order forms, sorted by BIC; they start from the integer-order optima.

        They have the offset of the best integer-order form. If that form has a delay, the best fractional form is also
        fitted with a delay.
        """
        form = best.form if best is not None and best.form is not None else IntegerOrderForm(1, 0)
        y, suffix = self.problem.output, self.problem.suffix
        frequency = _natural_frequency(fits, form.offset, suffix)
        drivers = self.problem.numbered_drivers
        highest, output_term = f"D^alpha{suffix} {y}", f"a0{suffix} {y}"
        damping = f"a1{suffix} D^mu{suffix} {y}"
        input_terms = [f"b{index}0{suffix} {name}" for index, name in drivers]
        direct = [f"b{index}1{suffix} D^alpha{suffix} {name}" for index, name in drivers]
        equation_parts = {
            (highest, output_term, *input_terms): INITIAL_FRACTIONAL_ORDERS,
            (highest, damping, output_term, *input_terms): INITIAL_FRACTIONAL_ORDERS[1:],
        }
        if input_terms:
            equation_parts[highest, *input_terms] = INITIAL_FRACTIONAL_ORDERS[:2]
        if input_terms and not self.feedback:
            equation_parts[highest, *direct, *input_terms] = INITIAL_FRACTIONAL_ORDERS[:2]
        if form.order == FRACTIONAL_DAMPING_ORDER:
            equation_parts[f"D^2 {y}", damping, output_term, *input_terms] = (2.0,)
        texts = {f"{lhs} = {' + '.join(right_terms)}": orders for (lhs, *right_terms), orders in equation_parts.items()}

        def structure(text: str, *, delayed: bool = False) -> Structure:
            delay = self.problem.input_delays(delayed=delayed)
            return _with_offset(equation(text, delay=delay, initial=self.problem.initial), form.offset)

        delay_values = (
            {} if best is None else {n: v for n, v in best.joint.values_by_name.items() if n.startswith("delay_")}
        )

        def start(structure: Structure, alpha: float) -> dict[str, float]:
            values_of_form = {
                "a0": -(frequency**alpha),
                "a1": -0.3 * frequency ** (alpha - 0.5),
                "alpha": alpha,
                "mu": 0.5,
            }
            # The coefficients of the inputs are eliminated at every iterate.
            gains = dict.fromkeys(structure.coefficient_names, frequency**alpha)
            delays = {i.name: delay_values.get(i.name, i.bounds[0]) for i in structure.free_input_parameters}
            names = (*structure.order_names, *structure.coefficient_names)
            values = {**gains, **{n + suffix: v for n, v in values_of_form.items()}}
            return {n: v for n, v in values.items() if n in names} | delays

        items = [(structure(t), orders) for t, orders in texts.items()]
        candidates = self._fit_structures([(s, None, [start(s, a) for a in orders]) for s, orders in items])
        if form.delayed and candidates:
            text = next(t for t in texts if structure(t) == candidates[0].structure)
            delayed = structure(text, delayed=True)
            guesses = [
                {**delay_values, **candidates[0].joint.values_by_name},
                *(start(delayed, a) for a in texts[text]),
            ]
            candidates += self._fit_structures([(delayed, None, guesses)])
        return _rank(candidates)


def _best_of_each_order(fits: Sequence[FittedForm]) -> list[IntegerOrderForm]:
    """Return the form with the lowest BIC for each order.

    The BIC of an order uses the smallest variance inflation among the fits of this order.
    """
    forms = [f for f in fits if f.form is not None]
    orders = sorted({f.form.order for f in forms if f.form})
    return [g.form for n in orders if (g := _rank([f for f in forms if f.form and f.form.order == n])[0]).form]


def _neighbors(form: IntegerOrderForm) -> list[IntegerOrderForm]:
    """Return forms that differ in one property.

    The property is an integrator, direct feedthrough, an offset, or a canceled pole and zero.
    """
    forms = [
        replace(form, integrator=not form.integrator),
        replace(form, zeros=form.order if form.zeros < form.order else form.order - 1),
        replace(form, offset="level" if form.offset == "none" else "none"),
    ]
    if form.friction != "none":
        # The simulation of friction needs inputs of lower order than the equation.
        forms[1:2] = [replace(form, zeros=form.order - 1), replace(form, delayed=not form.delayed)]
    elif form.zeros > 0:
        lower = replace(form, order=form.order - 1, zeros=form.zeros - 1, integrator=False)
        # A canceled pole and zero at s = 0 are equivalent to a level, or with the initial terms to a drift.
        forms += [lower, *(replace(lower, offset=o) for o in ("level", "ramp"))]
        forms.append(replace(lower, integrator=form.integrator))
    return [f for f in dict.fromkeys(forms) if f.zeros >= 0 and f.order > 0]


def _bic_decrease(fits: Sequence[FittedForm], has_property: Callable[[IntegerOrderForm], bool]) -> float:
    """Return by how much a property lowers the lowest BIC of all forms; 0 if no form has the property."""
    with_property = [f.bic for f in fits if f.form is not None and has_property(f.form)]
    without_property = [f.bic for f in fits if f.form is not None and not has_property(f.form)]
    return min(without_property, default=math.inf) - min(with_property) if with_property else 0.0


def _natural_frequency(fits: Sequence[FittedForm], offset: str, suffix: str) -> float:
    """Return the natural frequency [rad/s] of an underdamped form of order 2.

    Without such a form, return the pole frequency of a form of order 1, or else 1.
    """
    for order in (2, 1):
        for item in fits:
            form = item.form
            if form is not None and (form.order, form.offset, form.integrator) == (order, offset, False):
                stiffness = abs(item.joint.coefficients.get(f"a0{suffix}", 0.0))
                damping = abs(item.joint.coefficients.get(f"a1{suffix}", 0.0))
                if order == 1 and stiffness > 0.0:
                    return stiffness
                if stiffness > 0.0 and damping < 2.0 * math.sqrt(stiffness):
                    return math.sqrt(stiffness)
    return 1.0
