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
from ftlm.estimation.result import Judged
from ftlm.model.model import Against, Estimate, Model
from ftlm.utils.formatting import unbounded
from ftlm.utils.statistics import NORMAL_95
from ftlm.validation.comparison import LOST, USELESS, Comparison, Metrics
from ftlm.validation.findings import BAD, CARE, KINDS, Kind, concerns, kind_of
from ftlm.validation.residual_tests import NEGLIGIBLE

TRUST = "trust"
NOT_TRIED = "no run that it was not fitted to has been tried"
#: Largest relative standard error of a well-determined coefficient, and largest standard error of an order. Half the 95
#: % interval then equals the coefficient, or the increment of 0.5 between common mechanisms.
VAGUE_SHARE, VAGUE_ORDER = 0.5, 0.25
#: Limits of the validation loss: ratio to the estimation loss, and percentage below which the ratio does not matter.
FAR_MORE = ((3.0, 10.0), (5.0, 5.0))
_KINDS = {kind.name: kind for kind in KINDS}


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
        return self.level == TRUST

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
    output_error, equation_error, per_run, simulated, measured, step, m, initial, warnings, times, output_samples,
    offsets
        See :class:`ftlm.Comparison`.
    without_equation_error
        See there.
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


def validated(result: Judged, comparison: Comparison) -> Validation:
    """Return a comparison on other runs with the verdict of estimation and validation."""
    own = {f.name: getattr(comparison, f.name) for f in fields(Comparison)}
    return Validation(**own, verdict=verdict(result, comparison))


def _against(level: str, reason: str, remedy: str) -> Against:
    return Against(cast(Literal["do not use", "with care"], level), reason, remedy)


def verdict(result: Judged, validation: Comparison | None = None) -> Verdict:
    """Return the verdict on a result, by the rules of :meth:`ftlm.Identification.verdict`.

    Warnings of weight that no rule names count in the order of :data:`ftlm.validation.findings.KINDS`.
    """
    runs = () if validation is None else (validation,)
    tried = validation is not None and _is_other(validation)
    against = _most_serious(against_result(result), result.fit_percent, runs, tried)
    if against is not None:
        return against
    fits = ", ".join(f"{o} {f.fit:.3g} %" for o, f in (validation or result.comparison).output_error.items())
    return Verdict(TRUST, f"it predicts runs it was not fitted to ({fits}), residuals are noise, every number is known")


def _most_serious(
    own: Sequence[Against], before: Mapping[str, float], runs: Sequence[Comparison], tried: bool
) -> Verdict | None:
    """Return the verdict from all findings, by itself and on other runs; None without findings."""
    found = [a for a in own if a.level == BAD]
    for comparison in runs:
        found += _useless("the validation run of ", comparison)
    for comparison in runs:
        found += _lost(before, comparison)
    found += [a for a in own if a.level == CARE]
    if not tried:
        found.append(_against(CARE, NOT_TRIED, "validate(run), or --validation FILE"))
    bad = [a for a in found if a.level == BAD] + [a for a in found if a.level == CARE]
    if not bad:
        return None
    return Verdict(bad[0].level, bad[0].reason, bad[0].remedy, tuple(dict.fromkeys(a.reason for a in bad)))


def saved_verdict(model: Model, validation: Sequence[Comparison]) -> Verdict:
    """Return the verdict on a saved model, from its file and from comparisons with runs."""
    known, own = model.estimate, [*_growing(model)]
    if known is None:
        own.append(_against(CARE, "its file says nothing of how it was identified", "compare it with measured runs"))
        judged = _most_serious(own, {}, validation, True)
    else:
        own += against_saved(known) if known.against is UNSET else known.against
        before = {n: f for n, f in known.fit.items() if f is not None}
        seen = any(name in known.runs for c in validation for name, _, _ in c.per_run)
        judged = _most_serious(own, before, validation, bool(validation) and not seen)
    if judged is not None:
        return judged
    fits = ", ".join(f"{o} {f.fit:.3g} %" for c in validation for o, f in c.output_error.items())
    return Verdict(TRUST, f"it predicts runs it was not fitted to ({fits}), and nothing spoke against its fit")


def against_saved(known: Estimate) -> list[Against]:
    """Return the findings about a model whose file stores only warnings and standard errors."""
    found = []
    unseen = [n for n, e in known.standard_errors.items() if e is None]
    if unseen:
        found.append(_against(BAD, f"the runs do not tell {_listed(unseen)} apart", _KINDS["unseen"].remedy))
    before = {n: f for n, f in known.fit.items() if f is not None}
    for concern in concerns([w for w in known.warnings if not _of_noise(w, before)]):
        if concern.kind.level in (BAD, CARE) and concern.kind.name not in ("unstable", "unseen"):
            reason = f"{concern.kind.what}: {_first(concern.warnings[0])}"
            found.append(_against(concern.kind.level, reason, concern.kind.remedy))
    if not known.standard_errors:
        found.append(_against(CARE, f"{known.method} gives no standard errors", "use method='output-error'"))
    return found


def against_result(result: Judged) -> list[Against]:
    """Return the findings about a result by itself, most serious first within a level."""
    return [*_rules(result)]


def _rules(result: Judged) -> Iterator[Against]:
    kinds = {c.kind.name: c for c in concerns(result.warnings)}

    def of(kind: Kind, reason: str = "", remedy: str = "") -> Against:
        return _against(kind.level, reason or kind.what, remedy or kind.remedy)

    yield from _free_runs(result)
    errors, joint = result.standard_errors, result.joint
    unseen = [n for n, e in errors.items() if not math.isfinite(e)]
    if unseen:
        yield of(_KINDS["unseen"], f"the runs do not tell {_listed(unseen)} apart")
    if "identity" in kinds:
        yield of(_KINDS["identity"])
    yield from _residuals(result)
    if joint is not None and not joint.converged:
        kinds.pop("provisional", None)
        yield of(_KINDS["provisional"], "the fit ended before it stood still")
    vague = [_vague(result, n) for n in errors if n not in unseen and _is_vague(result, n)]
    if vague:
        yield of(_KINDS["vague"], f"the runs hardly tell {_listed(vague)}")
    endless = [n for n, p in result.profiles.items() if _is_of_input(result, n) and math.isinf(p.high)]
    if endless:
        yield of(_KINDS["vague"], f"the runs do not bound {_listed(endless)}")
    hidden = dict.fromkeys(o for run in result.comparison.offsets for o, values in run.items() if not values)
    if hidden:
        words = f"the offset of {_listed(list(hidden))} is not told apart from what a run did before its start"
        yield of(_KINDS["history"], words)
    # A test of whiteness that fails by rounding alone, or numbers that are vague and not very, are no reasons.
    judged = ("residuals", "loop", "vague", "unseen", "identity", "useless", "lost", "unstable", "range")
    for name, concern in kinds.items():
        if name not in judged and concern.kind.level in (BAD, CARE):
            yield of(concern.kind, f"{concern.kind.what}: {_first(concern.warnings[0])}")
    if not errors:
        yield _against(
            CARE,
            f"{result.method} gives no standard errors, so nothing says how sure its numbers are",
            "use method='output-error'",
        )


def _free_runs(result: Judged) -> Iterator[Against]:
    """Yield findings about simulations: overflow, instability and poor fit."""
    if not all(math.isfinite(f.nr) for f in result.output_error.values()):
        yield _against(BAD, _KINDS["range"].what, _KINDS["range"].remedy)
    yield from _growing(result.model)
    yield from _useless("", result.comparison)


def _growing(model: Model) -> Iterator[Against]:
    """Yield findings about unstable poles and undamped modes; none with friction.

    A pole at the origin is an integrator, which is common in machines and no fault.
    """
    if model.structure.has_friction:
        return
    stable = model.stability(coupling=model.structure.coupling)
    if math.isnan(stable.unstable_poles):
        yield _against(CARE, "whether its free run grows cannot be told", _KINDS["unstable"].remedy)
    elif stable.unstable_poles > 0:
        count = int(stable.unstable_poles)
        poles = f"{count} pole{'s' if count > 1 else ''} with a positive real part"
        yield _against(BAD, f"{_KINDS['unstable'].what} ({poles})", _KINDS["unstable"].remedy)
    else:
        with contextlib.suppress(FtlmError):
            yield from _undamped(model)


def _undamped(model: Model) -> Iterator[Against]:
    """Yield findings about oscillatory modes whose damping is not significantly positive."""
    for mode in modes(model, coupling=model.structure.coupling):
        if mode.swings and mode.damping - NORMAL_95 * (mode.damping_error or 0.0) <= 0.0:
            spread = "" if mode.damping_error is None else f" ± {mode.damping_error:.2g}"
            words = f"a swing of {mode.frequency:.4g} rad/s may never die away (damping {mode.damping:.2g}{spread})"
            remedy = "add the term that damps it, or record until it has died away"
            yield _against(CARE, words, remedy)
            return


def _useless(where: str, comparison: Comparison) -> Iterator[Against]:
    """Yield outputs that the simulation explains by less than half, over all runs or on one.

    Each run is tested too, because a large run hides a small one.
    """
    for run, errors in _each(comparison):
        useless = [o for o, f in errors.items() if not f.nr <= USELESS]
        if useless:
            shown = ", ".join(f"{o} (fit {errors[o].fit:.3g} %{run})" for o in useless)
            yield _against(BAD, f"the free run explains little of {where}{shown}", _KINDS["useless"].remedy)
            return


def _each(comparison: Comparison) -> Iterator[tuple[str, Mapping[str, Metrics]]]:
    """Yield the metrics of the simulation error over all runs, and of each run if there are several."""
    yield "", comparison.output_error
    if len(comparison.per_run) > 1:
        for name, _, errors in comparison.per_run:
            yield f" on {name}", errors


def _lost(before: Mapping[str, float], validation: Comparison) -> Iterator[Against]:
    """Yield outputs whose validation fit is far below the estimation fit."""
    for run, errors in _each(validation):
        for output, figures in errors.items():
            if output not in before:
                continue
            left, own = 100.0 - figures.fit, 100.0 - before[output]
            if not (left <= own + LOST and all(left <= times * own or left <= little for times, little in FAR_MORE)):
                words = f"the fit of {output} falls from {before[output]:.3g} to {figures.fit:.3g} % on validation{run}"
                yield _against(CARE, words, _KINDS["lost"].remedy)
                return


def _of_noise(warning: str, fits: Mapping[str, float]) -> bool:
    """Whether a warning concerns residuals of negligible size."""
    if kind_of(warning).name not in ("residuals", "loop"):
        return False
    named = [o for o in fits if re.search(rf"(?<!\w){re.escape(o)}(?!\w)", warning)]
    return bool(named) and all(100.0 - fits[o] <= 100.0 * NEGLIGIBLE for o in named)


def _residuals(result: Judged) -> Iterator[Against]:
    """Yield findings of residual tests: feedback, dependence on an input, color."""
    if result.residuals is None:
        yield _against(CARE, "the runs are too short for residual tests", "record a longer run")
        return
    looped = "reference" in result.settings
    judged = {o: r for o, r in result.residuals.outputs.items() if not r.nr <= NEGLIGIBLE}
    # A model that is wrong leaves what a periodic input repeats, which looks like a loop: first what it lacks.
    following = {o: [s for s, t in r.judged.items() if t.failed] for o, r in judged.items()}
    if any(following.values()):
        words = ", ".join(f"{o} still follow {_listed(signals)}" for o, signals in following.items() if signals)
        yield _against(CARE, f"residuals of {words}: it leaves something out", _KINDS["residuals"].remedy)
    for output, tests in judged.items():
        if tests.feedback and not tests.whiteness.passed and not looped:
            words = f"{_listed(tests.feedback)} answers {output}, a closed loop, and what comes back biases the numbers"
            yield _against(CARE, words, _KINDS["loop"].remedy)
    # With a reference the loop is known: its noise is no part of what the model was estimated from, nor what it lacks.
    coloured = [] if looped else [o for o, r in judged.items() if not r.whiteness.passed]
    if coloured:
        words = f"residuals of {_listed(coloured)} are not white: it leaves something out"
        yield _against(CARE, words, _KINDS["residuals"].remedy)


def _is_vague(result: Judged, name: str) -> bool:
    """Whether a parameter is poorly determined, by its profile if available."""
    error = result.standard_errors[name]
    numbers = {**result.coefficients, **({} if result.joint is None else result.joint.coefficients)}
    if name in result.orders:
        return error > VAGUE_ORDER or (name in result.profiles and math.isinf(result.profiles[name].high))
    if name not in numbers:
        # A delay or a limit may well be 0.
        return False
    if name in result.profiles:
        known = result.profiles[name]
        return known.is_open or 0.0 in known
    return error > VAGUE_SHARE * abs(numbers[name])


def _is_of_input(result: Judged, name: str) -> bool:
    """Whether a parameter is a delay, a saturation or a dead zone, which may be 0 but must be bounded."""
    structure = result.model.structure
    return name in {f"delay_{s}" for s in structure.delay} | {limit.name for limit in structure.limits}


def _vague(result: Judged, name: str) -> str:
    values = {**result.orders, **result.coefficients, **result.joint_values}
    return f"{name} = {values[name]:.3g} ± {unbounded(result.standard_errors[name], '.2g')}"


def _is_other(validation: Comparison) -> bool:
    """Whether no validation run was used for estimation."""
    return not any(c.kind.name == "same" for c in concerns(validation.warnings))


def _first(warning: str) -> str:
    """Return the first clause of a warning."""
    return warning.partition(";")[0].partition(" (")[0]


def _listed(names: object) -> str:
    words = list(names) if isinstance(names, (list, tuple)) else [str(names)]
    shown = words if len(words) <= 3 else [*words[:3], f"{len(words) - 3} more"]
    return " and ".join([", ".join(shown[:-1]), shown[-1]]) if len(shown) > 1 else shown[0]
