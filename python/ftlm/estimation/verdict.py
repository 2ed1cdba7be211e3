"""Verdict on an identified model, by explicit rules, with one reason."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, cast

from markupsafe import Markup
from msgspec import UNSET

from ftlm.analysis.poles import modes
from ftlm.errors import FtlmError
from ftlm.estimation.result import Identification
from ftlm.model.model import Estimate, Model, ModelFinding
from ftlm.utils.formatting import format_bound
from ftlm.utils.parameters import choose_text, parameter
from ftlm.utils.statistics import NORMAL_95
from ftlm.validation.comparison import MAX_FIT_DROP_POINTS, MAX_NORMALIZED_RESIDUAL, Comparison, Metrics
from ftlm.validation.findings import (
    LEVEL_DO_NOT_USE,
    LEVEL_WITH_CARE,
    WARNING_KINDS,
    WarningKind,
    group_warnings,
    warning_kind,
)
from ftlm.validation.residual_tests import NEGLIGIBLE_RESIDUAL_RATIO

TRUST_LEVEL = "trust"
NOT_TRIED = "no run that it was not fitted to has been tried"
#: Largest relative standard error of a well-determined coefficient, and largest standard error of an order. Half the 95
#: % interval then equals the coefficient, or the increment of 0.5 between common mechanisms.
MAX_COEFFICIENT_ERROR_RATIO, MAX_ORDER_ERROR = 0.5, 0.25
#: Limits of the validation loss: ratio to the estimation loss, and percentage below which the ratio does not matter.
VALIDATION_LOSS_LIMITS = ((3.0, 10.0), (5.0, 5.0))
_KINDS_BY_NAME = {kind.name: kind for kind in WARNING_KINDS}


@dataclass(frozen=True)
class Verdict:
    """Verdict on a model.

    Parameters
    ----------
    level
        ``"trust"``, ``"with care"`` or ``"do not use"``.
    reason
        Most serious reason, as a sentence.
    remedy
        Suggested remedy.
    reasons
        All reasons, most serious first; the first is ``reason``.
    """

    level: str
    reason: str
    remedy: str = ""
    reasons: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether the level is ``"trust"``."""
        return self.level == TRUST_LEVEL

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as a dictionary for JSON."""
        return asdict(self) | {"reasons": list(self.reasons)}

    @property
    def sentence(self) -> str:
        """Reason and remedy."""
        return self.reason + (f"; {self.remedy}" if self.remedy else "")

    def __str__(self) -> str:
        return f"{self.level.upper()}: {self.sentence}"


@dataclass(frozen=True)
class Validation(Comparison):
    """Comparison with runs that the model was not identified from, and the resulting verdict.

    Parameters
    ----------
    output_error, equation_error, per_run, simulated, measured, step, m, initial, warnings, times
        See :class:`ftlm.Comparison`.
    output_samples, offsets, without_equation_error
        See :class:`ftlm.Comparison`.
    verdict
        Verdict on the model after this validation.
    """

    verdict: Verdict | None = None

    def __str__(self) -> str:
        return f"{self.verdict}\n{super().__str__()}" if self.verdict is not None else super().__str__()

    def _repr_html_(self) -> str:
        lead = "" if self.verdict is None else str(verdict_html(self.verdict))
        return lead + super()._repr_html_()


def verdict_html(judged: Verdict) -> Markup:
    """Return a verdict as an HTML paragraph."""
    return Markup("<p><strong>{}</strong>: {}.</p>").format(judged.level.capitalize(), judged.sentence)


def validation_with_verdict(result: Identification, comparison: Comparison) -> Validation:
    """Return a comparison on other runs with the verdict of estimation and validation."""
    own = {f.name: getattr(comparison, f.name) for f in fields(Comparison)}
    return Validation(**own, verdict=verdict(result, comparison))


def _make_finding(level: str, reason: str, remedy: str) -> ModelFinding:
    return ModelFinding(cast(Literal["do not use", "with care"], level), reason, remedy)


def verdict(result: Identification, validation: Comparison | None = None) -> Verdict:
    """Return the verdict on a result, by the rules of :meth:`ftlm.Identification.verdict`.

    Warnings of weight that no rule names count in the order of :data:`ftlm.validation.findings.KINDS`.
    """
    runs = () if validation is None else (validation,)
    tried = validation is not None and _is_other(validation)
    against = _combined_verdict([*result_findings(result)], result.fit_percent, runs, tried)
    if against is not None:
        return against
    fits = ", ".join(f"{o} {f.fit:.3g} %" for o, f in (validation or result.comparison).output_error.items())
    return Verdict(
        TRUST_LEVEL, f"it predicts runs it was not fitted to ({fits}), residuals are noise, every number is known"
    )


def _combined_verdict(
    own: Sequence[ModelFinding], before: Mapping[str, float], runs: Sequence[Comparison], tried: bool
) -> Verdict | None:
    """Return the verdict from all findings, by itself and on other runs; None without findings."""
    found = [a for a in own if a.level == LEVEL_DO_NOT_USE]
    for comparison in runs:
        found += _poor_fits("the validation run of ", comparison)
    for comparison in runs:
        found += _validation_losses(before, comparison)
    found += [a for a in own if a.level == LEVEL_WITH_CARE]
    if not tried:
        found.append(_make_finding(LEVEL_WITH_CARE, NOT_TRIED, choose_text("validate(run)", "--validation FILE")))
    bad = [a for a in found if a.level == LEVEL_DO_NOT_USE] + [a for a in found if a.level == LEVEL_WITH_CARE]
    if not bad:
        return None
    return Verdict(bad[0].level, bad[0].reason, bad[0].remedy, tuple(dict.fromkeys(a.reason for a in bad)))


def saved_verdict(model: Model, validation: Sequence[Comparison]) -> Verdict:
    """Return the verdict on a saved model, from its file and from comparisons with runs."""
    known, own = model.estimate, [*_unstable_poles(model)]
    if known is None:
        own.append(
            _make_finding(
                LEVEL_WITH_CARE, "its file says nothing of how it was identified", "compare it with measured runs"
            )
        )
        judged = _combined_verdict(own, {}, validation, True)
    else:
        own += saved_findings(known) if known.against is UNSET else known.against
        before = {n: f for n, f in known.fit.items() if f is not None}
        seen = any(name in known.runs for c in validation for name, _, _ in c.per_run)
        judged = _combined_verdict(own, before, validation, bool(validation) and not seen)
    if judged is not None:
        return judged
    fits = ", ".join(f"{o} {f.fit:.3g} %" for c in validation for o, f in c.output_error.items())
    return Verdict(TRUST_LEVEL, f"it predicts runs it was not fitted to ({fits}), and nothing spoke against its fit")


def saved_findings(known: Estimate) -> list[ModelFinding]:
    """Return the findings about a model whose file stores only warnings and standard errors."""
    found = []
    unseen = [n for n, e in known.standard_errors.items() if e is None]
    if unseen:
        found.append(
            _make_finding(
                LEVEL_DO_NOT_USE,
                f"the runs do not tell {_join_names(unseen)} apart",
                _KINDS_BY_NAME["unseen"].format_remedy(),
            )
        )
    before = {n: f for n, f in known.fit.items() if f is not None}
    for concern in group_warnings([w for w in known.warnings if not _of_noise(w, before)]):
        if concern.kind.level in (LEVEL_DO_NOT_USE, LEVEL_WITH_CARE) and concern.kind.name not in (
            "unstable",
            "unseen",
        ):
            reason = f"{concern.kind.what}: {_first_clause(concern.warnings[0])}"
            found.append(_make_finding(concern.kind.level, reason, concern.kind.format_remedy()))
    if not known.standard_errors:
        found.append(
            _make_finding(
                LEVEL_WITH_CARE,
                f"{known.method} gives no standard errors",
                f"use {parameter('method', 'output-error')}",
            )
        )
    return found


def result_findings(result: Identification) -> Iterator[ModelFinding]:
    """Yield the findings about a result by itself, most serious first within a level."""
    kinds = {c.kind.name: c for c in group_warnings(result.warnings)}

    def of(kind: WarningKind, reason: str = "", remedy: str = "") -> ModelFinding:
        return _make_finding(kind.level, reason or kind.what, remedy or kind.format_remedy())

    yield from _free_runs(result)
    errors, joint = result.standard_errors, result.fit
    unseen = [n for n, e in errors.items() if not math.isfinite(e)]
    if unseen:
        yield of(_KINDS_BY_NAME["unseen"], f"the runs do not tell {_join_names(unseen)} apart")
    if "identity" in kinds:
        yield of(_KINDS_BY_NAME["identity"])
    yield from _residuals(result)
    if joint is not None and not joint.converged:
        kinds.pop("provisional", None)
        yield of(_KINDS_BY_NAME["provisional"], "the fit ended before it stood still")
    vague = [_format_uncertain(result, n) for n in errors if n not in unseen and _is_uncertain(result, n)]
    if vague:
        yield of(_KINDS_BY_NAME["vague"], f"the runs hardly tell {_join_names(vague)}")
    endless = [n for n, p in result.profiles.items() if _is_of_input(result, n) and math.isinf(p.high)]
    if endless:
        yield of(_KINDS_BY_NAME["vague"], f"the runs do not bound {_join_names(endless)}")
    runs = zip(result.comparison.offsets, result.comparison.initial, strict=False)
    hidden = dict.fromkeys(o for offsets, initial in runs for o in offsets if not offsets[o] and initial[o])
    if hidden:
        words = f"the offset of {_join_names(list(hidden))} is not told apart from what a run did before its start"
        yield of(_KINDS_BY_NAME["history"], words)
    # A test of whiteness that fails by rounding alone, or numbers that are vague and not very, are no reasons.
    judged = ("residuals", "loop", "vague", "unseen", "identity", "useless", "lost", "unstable", "range")
    for name, concern in kinds.items():
        if name not in judged and concern.kind.level in (LEVEL_DO_NOT_USE, LEVEL_WITH_CARE):
            yield of(concern.kind, f"{concern.kind.what}: {_first_clause(concern.warnings[0])}")
    if not errors:
        yield _make_finding(
            LEVEL_WITH_CARE,
            f"{result.method} gives no standard errors, so nothing says how sure its numbers are",
            f"use {parameter('method', 'output-error')}",
        )


def _free_runs(result: Identification) -> Iterator[ModelFinding]:
    """Yield findings about simulations: overflow, instability and poor fit."""
    if not all(math.isfinite(f.nr) for f in result.output_error.values()):
        yield _make_finding(LEVEL_DO_NOT_USE, _KINDS_BY_NAME["range"].what, _KINDS_BY_NAME["range"].format_remedy())
    yield from _unstable_poles(result.model)
    yield from _poor_fits("", result.comparison)


def _unstable_poles(model: Model) -> Iterator[ModelFinding]:
    """Yield findings about unstable poles and undamped modes; none with friction.

    A pole at the origin is an integrator, which is common in machines and no fault.
    """
    if model.structure.has_friction:
        return
    stable = model.stability(coupling=model.structure.coupling)
    if math.isnan(stable.unstable_poles):
        yield _make_finding(
            LEVEL_WITH_CARE, "whether its free run grows cannot be told", _KINDS_BY_NAME["unstable"].format_remedy()
        )
    elif stable.unstable_poles > 0:
        count = int(stable.unstable_poles)
        poles = f"{count} pole{'s' if count > 1 else ''} with a positive real part"
        yield _make_finding(
            LEVEL_DO_NOT_USE, f"{_KINDS_BY_NAME['unstable'].what} ({poles})", _KINDS_BY_NAME["unstable"].format_remedy()
        )
    else:
        with contextlib.suppress(FtlmError):
            yield from _undamped_modes(model)


def _undamped_modes(model: Model) -> Iterator[ModelFinding]:
    """Yield findings about oscillatory modes whose damping is not significantly positive."""
    for mode in modes(model, coupling=model.structure.coupling):
        if mode.oscillatory and mode.damping - NORMAL_95 * (mode.damping_error or 0.0) <= 0.0:
            spread = "" if mode.damping_error is None else f" ± {mode.damping_error:.2g}"
            words = f"a swing of {mode.frequency:.4g} rad/s may never die away (damping {mode.damping:.2g}{spread})"
            remedy = "add the term that damps it, or record until it has died away"
            yield _make_finding(LEVEL_WITH_CARE, words, remedy)
            return


def _poor_fits(where: str, comparison: Comparison) -> Iterator[ModelFinding]:
    """Yield outputs that the simulation explains by less than half, over all runs or on one.

    Each run is tested too, because a large run hides a small one.
    """
    for run, errors in _each(comparison):
        useless = [o for o, f in errors.items() if not f.nr <= MAX_NORMALIZED_RESIDUAL]
        if useless:
            shown = ", ".join(f"{o} (fit {errors[o].fit:.3g} %{run})" for o in useless)
            yield _make_finding(
                LEVEL_DO_NOT_USE,
                f"the free run explains little of {where}{shown}",
                _KINDS_BY_NAME["useless"].format_remedy(),
            )
            return


def _each(comparison: Comparison) -> Iterator[tuple[str, Mapping[str, Metrics]]]:
    """Yield the metrics of the simulation error over all runs, and of each run if there are several."""
    yield "", comparison.output_error
    if len(comparison.per_run) > 1:
        for name, _, errors in comparison.per_run:
            yield f" on {name}", errors


def _validation_losses(before: Mapping[str, float], validation: Comparison) -> Iterator[ModelFinding]:
    """Yield outputs whose validation fit is far below the estimation fit."""
    for run, errors in _each(validation):
        for output, figures in errors.items():
            if output not in before:
                continue
            left, own = 100.0 - figures.fit, 100.0 - before[output]
            if not (
                left <= own + MAX_FIT_DROP_POINTS
                and all(left <= times * own or left <= little for times, little in VALIDATION_LOSS_LIMITS)
            ):
                words = f"the fit of {output} falls from {before[output]:.3g} to {figures.fit:.3g} % on validation{run}"
                yield _make_finding(LEVEL_WITH_CARE, words, _KINDS_BY_NAME["lost"].format_remedy())
                return


def _of_noise(warning: str, fits: Mapping[str, float]) -> bool:
    """Whether a warning concerns residuals of negligible size."""
    if warning_kind(warning).name not in ("residuals", "loop"):
        return False
    named = [o for o in fits if re.search(rf"(?<!\w){re.escape(o)}(?!\w)", warning)]
    return bool(named) and all(100.0 - fits[o] <= 100.0 * NEGLIGIBLE_RESIDUAL_RATIO for o in named)


def _residuals(result: Identification) -> Iterator[ModelFinding]:
    """Yield findings of residual tests: feedback, dependence on an input, color."""
    if result.residuals is None:
        yield _make_finding(LEVEL_WITH_CARE, "the runs are too short for residual tests", "record a longer run")
        return
    looped = "reference" in result.settings
    judged = {o: r for o, r in result.residuals.outputs.items() if not r.nr <= NEGLIGIBLE_RESIDUAL_RATIO}
    # A model that is wrong leaves what a periodic input repeats, which looks like a loop: first what it lacks.
    following = {o: [s for s, t in r.informative_tests.items() if t.failed] for o, r in judged.items()}
    if any(following.values()):
        words = ", ".join(f"{o} still follow {_join_names(signals)}" for o, signals in following.items() if signals)
        yield _make_finding(
            LEVEL_WITH_CARE,
            f"residuals of {words}: it leaves something out",
            _KINDS_BY_NAME["residuals"].format_remedy(),
        )
    for output, tests in judged.items():
        if tests.feedback and not tests.whiteness.passed and not looped:
            words = (
                f"{_join_names(tests.feedback)} answers {output}, a closed loop, and what comes back biases the numbers"
            )
            yield _make_finding(LEVEL_WITH_CARE, words, _KINDS_BY_NAME["loop"].format_remedy())
    # With a reference the loop is known: its noise is no part of what the model was estimated from, nor what it lacks.
    coloured = [] if looped else [o for o, r in judged.items() if not r.whiteness.passed]
    if coloured:
        words = f"residuals of {_join_names(coloured)} are not white: it leaves something out"
        yield _make_finding(LEVEL_WITH_CARE, words, _KINDS_BY_NAME["residuals"].format_remedy())


def _is_uncertain(result: Identification, name: str) -> bool:
    """Whether a parameter is poorly determined, by its profile if available."""
    error = result.standard_errors[name]
    numbers = {**result.coefficients, **({} if result.fit is None else result.fit.coefficients)}
    if name in result.orders:
        return error > MAX_ORDER_ERROR or (name in result.profiles and math.isinf(result.profiles[name].high))
    if name not in numbers:
        # A delay or a limit may well be 0.
        return False
    if name in result.profiles:
        known = result.profiles[name]
        return known.is_open or 0.0 in known
    return error > MAX_COEFFICIENT_ERROR_RATIO * abs(numbers[name])


def _is_of_input(result: Identification, name: str) -> bool:
    """Whether a parameter is a delay, a saturation or a dead zone, which may be 0 but must be bounded."""
    structure = result.model.structure
    return name in {f"delay_{s}" for s in structure.delay} | {limit.name for limit in structure.limits}


def _format_uncertain(result: Identification, name: str) -> str:
    values = {**result.orders, **result.coefficients, **result.parameter_values}
    return f"{name} = {values[name]:.3g} ± {format_bound(result.standard_errors[name], '.2g')}"


def _is_other(validation: Comparison) -> bool:
    """Whether no validation run was used for estimation."""
    return not any(c.kind.name == "same" for c in group_warnings(validation.warnings))


def _first_clause(warning: str) -> str:
    """Return the first clause of a warning."""
    return warning.partition(";")[0].partition(" (")[0]


def _join_names(names: object) -> str:
    words = list(names) if isinstance(names, (list, tuple)) else [str(names)]
    shown = words if len(words) <= 3 else [*words[:3], f"{len(words) - 3} more"]
    return " and ".join([", ".join(shown[:-1]), shown[-1]]) if len(shown) > 1 else shown[0]
