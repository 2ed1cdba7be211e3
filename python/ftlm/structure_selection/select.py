"""Selection of a structure by its prediction of validation data."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.errors import ConvergenceError, ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.identify import identify, identify_pieces
from ftlm.estimation.result import Identification
from ftlm.estimation.unstable_plants import least_squares_piece_test
from ftlm.estimation.verdict import MIN_FIT_GAIN, improves_prediction, is_degenerate
from ftlm.findings import Finding, make_finding, mark_validation
from ftlm.simulation.discretization import prepare
from ftlm.simulation.initial_conditions import has_memory
from ftlm.structure.parser import as_structure
from ftlm.structure.structure import Structure
from ftlm.structure_selection.automatic import MAX_ORDER, AutomaticSelection, Delays, IntegerOrderForm, OutputProblem
from ftlm.structure_selection.candidates import NestedStructures, describe_structure, name_candidates, signature
from ftlm.structure_selection.checkpoint import Request, Store
from ftlm.structure_selection.cross_validation import Folds, Trial, fit_criterion, residual_variance_inflation
from ftlm.structure_selection.result import Selection, format_fit
from ftlm.structure_selection.stepwise import (
    MAX_SCORE_TOLERANCE,
    SCORE_TOLERANCE,
    CandidateEvaluator,
    StepwiseSelection,
    evaluate_list,
)
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import NORMAL_99
from ftlm.utils.validation import check_threads, nearest

#: Mean fit [%] of validation data below which a candidate does not describe the machine.
MIN_VALIDATION_FIT = 50.0
#: Difference from an integer below which an order counts as an integer.
INTEGER_TOLERANCE = 1e-9


def automatic_problems(
    runs: Sequence[Run], delays: Delays | None = None, driven_by: Mapping[str, Sequence[str]] | None = None
) -> list[OutputProblem]:
    """Return one selection problem for each output of the runs, with the signals that enter its equation.

    Raises
    ------
    ModelError
        If a signal in `driven_by` is not in the runs or is the output itself.
    """
    first_run, drivers_by_output = runs[0], dict(driven_by or {})
    for output, drivers in drivers_by_output.items():
        if output not in first_run.outputs:
            raise ModelError(
                f"{parameter('driven_by')}: {output!r} is not an output{nearest(output, first_run.outputs)}; the "
                "runs have "
                f"{', '.join(first_run.outputs)}"
            )
        for name in drivers:
            if name not in first_run or name == output:
                raise ModelError(
                    f"{parameter('driven_by')}: {name!r} cannot be an input of {output}; name an input or another "
                    f"output of the runs: {', '.join(n for n in first_run.signals if n != output)}"
                )
    problems = []
    for output in first_run.outputs:
        drivers = tuple(dict.fromkeys(drivers_by_output.get(output, first_run.inputs)))
        suffix = f"_{output}" if len(first_run.outputs) > 1 else ""
        problems.append(OutputProblem(runs, output, drivers, dict(delays or {}), suffix))
    return problems


#: Difference of Schwarz criteria that is not significant; doi:10.1080/01621459.1995.10476572.
BIC_TOLERANCE = 2.0
#: Difference of Schwarz criteria that is very strong evidence; doi:10.1080/01621459.1995.10476572.
BIC_STRONG_EVIDENCE = 10.0
#: Minimum number of folds for a t-test of scores, and one-sided 95 % quantiles of Student's t from this number on.
MIN_T_TEST_FOLDS, STUDENT_QUANTILES_95 = 3, (2.92, 2.35, 2.13, 2.02, 1.94, 1.89, 1.86, 1.83, 1.81)
#: A candidate fails on a part of the validation data if its score there exceeds the first value and is higher than the
#: best score by more than the second value. A score is ln(1 - fit / 100).
FAILURE_SCORE, FAILURE_SCORE_GAP = math.log(0.5), math.log(2.0)
#: t statistic of a difference of scores over the folds beyond which a prediction is better: the two-sided 95 % quantile
#: of Student's t for four blocks.
MIN_BETTER_T_STATISTIC = 3.2
#: Maximum number of candidates in a list of structures.
MAX_CANDIDATES = 10_000


@check_arguments
def select(
    runs: Run | Sequence[Run],
    candidates: str | Structure | Sequence[Structure | str] | Mapping[str, Structure | str],
    *,
    validation: str | Run | Sequence[Run] | None = None,
    delay: Delays | None = None,
    driven_by: Mapping[str, Sequence[str]] | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    store: str | os.PathLike[str] | None = None,
) -> Selection:
    """Choose the terms and orders that improve the prediction of validation data significantly.

    A single given structure is an upper bound. Forward selection starts from the simplest nested structure (integer
    orders, terms of the output, one input term) and adds one term, free order, delay, friction or offset at a time.
    Each candidate is fitted by output error from the previous optimum. The best two by Schwarz's criterion are
    simulated on the validation data; the second is skipped if its residual on all runs is too large. After two steps
    without improvement, backward elimination removes one element at a time. If a list of structures is given, all of
    them are fitted from automatic initial guesses and validated.

    A candidate fails on a run or a block if its residual there exceeds half of the output and twice the residual of
    another candidate. Candidates with the fewest failures are eligible. Of those that predict as well as the best, the
    one with the lowest Schwarz criterion is chosen. The criterion uses a number of samples that is corrected for the
    autocorrelation of the residuals. A candidate predicts as well as the best if its residual is at most 1 % larger.
    With three or more folds, a difference that is not significant at 95 % is tolerated up to 5 %, and without limit if
    the criterion is lower by 10. With fewer folds, up to 5 % are tolerated if the criterion is lower by 10. Ties are
    decided by fewer parameters, then lower order, then
    better prediction.

    Parameters
    ----------
    runs
        One run or several with the same names and units.
    candidates
        A structure, whose nested structures are searched; several structures, by name or by their equations; or
        ``"auto"``. This option tries equations of integer orders 1 to 4 in all inputs (none for a free decay), with
        zeros, delays, direct feedthrough, an integrator, friction, an output level and a drift, and then fractional
        orders. Fractional orders are chosen if they predict
        better, or as well with a Schwarz criterion lower by 10. Feedthrough is not tried if an input depends on the
        output (a closed loop), because feedback without delay resembles feedthrough. Each output has its own
        selection, and the chosen equations are identified together.
    validation
        ``"runs"``: each run is predicted by a fit to the others; the default for several runs. ``"blocks"``: each
        quarter of a run is predicted by a fit to the rest; the default for one run. Separate validation runs may be
        given instead.
    delay
        With ``"auto"``: delay of each input by name [s], a number, or bounds (lower, upper) for an estimate. By
        default, structures without delays and with delays of up to 60 samples are compared. An input has a single
        delay. If its estimates in the equations of several outputs differ, equations without free delays are chosen.
    driven_by
        With ``"auto"``: names of the signals that enter the equation of each output; by default all inputs. Other
        outputs enter with their measured values.
    threads
        Number of candidates fitted concurrently, by default all cores; the result does not depend on it.
    progress
        Callback with (number of fitted candidates, number of candidates known so far).
    store
        Checkpoint file with every finished fit. The same call with the same file resumes an interrupted selection and
        gives the same result bit for bit.

    Returns
    -------
    Selection
        Result that prints its summary. ``.best`` is the identification of the chosen structure on all runs, and
        ``.report`` writes an HTML page.

    Raises
    ------
    DataError
        If runs differ in names or units, lack a signal of the structure, are too short to be divided, or have no
        excitation; or if the checkpoint file belongs to another selection, is in use, is damaged or cannot be written.
    ModelError
        If there are no candidates or more than 10 000, two candidates differ only in parameter names, an option is
        unknown, there is no validation run, there is one run where several are required, or a validation run is also an
        estimation run.
    ConvergenceError
        If no candidate can be fitted.

    Notes
    -----
    Initial terms are Caputo's (none from rest, otherwise initial values such as position and velocity) unless the
    structure states otherwise. A history (powers of t for past inputs) would have more terms if more orders are free,
    so candidates could not be compared.

    Each step of forward selection takes one fit for each possible addition. For records of more than about 1800
    samples, the candidates are prescreened on subsampled records, and only survivors are fitted. With three or more
    input terms in one equation and validation on whole runs, selection starts from the best subset of these terms. For
    this purpose, every subset at integer orders is scored in closed form, with the coefficients of output terms on a
    grid. For a list of more than 200 candidates, a ``UserWarning`` states the estimated remaining time after the first
    fits.
    """
    workers = check_threads(threads)
    run_list = as_runs(runs)
    folds = Folds.of(run_list, validation if validation is not None else "runs" if len(run_list) > 1 else "blocks")
    if not isinstance(candidates, (str, Structure, Sequence, Mapping)):
        raise ModelError(
            f"candidates is {type(candidates).__name__}; use ftlm.equation(…), a list or a dictionary of structures, "
            "or 'auto'"
        )
    if isinstance(candidates, str) and "=" in candidates:
        candidates = as_structure("candidates", candidates)
    if not isinstance(candidates, (str, Structure)) and len(candidates) > MAX_CANDIDATES:
        raise ModelError(
            f"{len(candidates)} candidates are more than {MAX_CANDIDATES}; give one structure instead, from which "
            "terms are selected stepwise"
        )
    listed = name_candidates(candidates) if not isinstance(candidates, (str, Structure)) else {}
    if isinstance(candidates, str) and candidates != "auto":
        raise ModelError(f"candidates = {candidates!r}; use 'auto', ftlm.equation(…), or a list of structures")
    problems_by_output = automatic_problems(folds.runs, delay, driven_by) if isinstance(candidates, str) else []
    searched = [candidates] if isinstance(candidates, Structure) else []
    without_parameters = [describe_structure(s) for s in (*searched, *listed.values()) if not FreeProblem.of(s).names]
    if without_parameters:
        raise ModelError(
            f"{without_parameters[0]} has no free parameter; name a coefficient or an order, or use model.compare(runs)"
        )
    if delay and not problems_by_output:
        raise ModelError(f"{parameter('delay')} is used with 'auto'; give the delays to ftlm.equation instead")
    if driven_by and not problems_by_output:
        raise ModelError(f"{parameter('driven_by')} is used with 'auto'; give the terms to ftlm.equation instead")
    if delay and (unknown := [n for n in delay if n not in folds.runs[0].inputs]):
        raise ModelError(
            f"{parameter('delay')}: {unknown[0]!r} is not an input{nearest(unknown[0], folds.runs[0].inputs)}; the "
            f"runs have {', '.join(folds.runs[0].inputs)}"
        )
    automatic = [IntegerOrderForm(2, 1, bool(delay)).structure(problem) for problem in problems_by_output]
    for structure in (*searched, *listed.values(), *automatic):
        # Raise here once, instead of a failure of every candidate.
        prepare(
            folds.runs,
            replace(structure.without_free_input_parameters(), offset="none"),
            None,
            power_of_two=False,
            gaps=True,
        )
    work = CandidateEvaluator(folds, workers, progress)
    if store is None:
        return _run_selection(work, searched, listed, problems_by_output)
    request = Request.of(folds.runs, [searched, listed, *automatic], folds.unseen_runs, folds.description)
    with Store(store, request) as open_store:
        return _run_selection(replace(work, store=open_store), searched, listed, problems_by_output)


def _run_selection(
    work: CandidateEvaluator,
    searched: Sequence[Structure],
    listed: Mapping[str, Structure],
    problems_by_output: Sequence[OutputProblem],
) -> Selection:
    """Return the selection among automatic structures, or among given ones and those nested in them.

    Automatic structures are used if there are `problems_by_output`. Otherwise, the structures in `listed` and those
    nested in the structures in `searched` are used.
    """
    if problems_by_output:
        selection = _select_automatically(work, problems_by_output)
        winner = selection.trials[selection.chosen_index]
        poor = winner.unstable or winner.validation_fit < MIN_VALIDATION_FIT
        duration = _piece_duration(problems_by_output) if poor and not work.folds.unseen_runs else None
        if duration is None:
            return selection
        folds = Folds.of_pieces(work.folds.runs, duration)
        problems = [replace(p, runs=folds.runs, initial="caputo") for p in problems_by_output]
        split = _select_automatically(replace(work, folds=folds, trials=[]), problems)
        return split if split.trials[split.chosen_index].validation_fit > winner.validation_fit else selection
    for structure in searched:
        StepwiseSelection(NestedStructures(structure), work).run()
    if listed:
        evaluate_list(listed, work)
    return _identify_choice(work, _choose(work, prefers_integer_orders=False))


def _select_automatically(work: CandidateEvaluator, problems_by_output: Sequence[OutputProblem]) -> Selection:
    """Choose an automatic structure for each output, and identify the chosen equations together."""
    choices = []
    for problem in problems_by_output:
        work.trials = []
        AutomaticSelection(problem, work).run()
        choices.append(_choose(work, prefers_integer_orders=True))
    return _identify_choice(work, choices[0] if len(choices) == 1 else _combine_choices(work, choices))


def _piece_duration(problems_by_output: Sequence[OutputProblem]) -> float | None:
    """Return the duration [s] of the pieces into which runs of an unstable plant are divided; None for other plants."""
    forms = [IntegerOrderForm(n, n - 1) for n in range(1, MAX_ORDER + 1)]
    tests = [
        least_squares_piece_test(p.runs, f.structure(p), p.runs[0].units) for p in problems_by_output for f in forms
    ]
    return min((t for t in tests if t is not None), key=lambda t: t.residual).seconds if any(tests) else None


@dataclass(frozen=True)
class Choice:
    """Trials ranked from best to worst, the chosen one, and the reason as text.

    `parts` are the choices for single outputs, if their equations are combined.
    """

    ranked: tuple[Trial, ...]
    winner: Trial
    reason: str
    parts: tuple[Choice, ...] = ()


def _choose(work: CandidateEvaluator, *, prefers_integer_orders: bool) -> Choice:
    """Rank the trials and choose one of them; raise ConvergenceError if no candidate could be fitted.

    With `prefers_integer_orders`, the rule of :func:`_eligible_indices` decides on fractional orders.
    """
    fits = [t for t in work.trials if t.joint is not None]
    if not fits:
        reason = next((f"; {t.name}: {t.failure}" for t in work.trials), "")
        raise ConvergenceError(
            f"no candidate can be fitted to {work.folds.description}; give simpler candidates or longer runs{reason}"
        )
    best_trials: dict[str, Trial] = {}
    for trial in work.trials:
        key = signature(trial.structure)
        if key not in best_trials or trial.score < best_trials[key].score:
            best_trials[key] = trial
    ranked = _rank_trials(list(best_trials.values()))
    ranked = _with_criteria(ranked)
    best = ranked[0]
    close = [k for k in _peer_indices(ranked) if _predicts_equally(ranked[k], best)]
    # Refine the best candidates: over thousands of samples the criterion depends on the step of the grid.
    for k, trial in zip(close, work.map_items(work.refine_trial, [ranked[k] for k in close]), strict=True):
        ranked[k] = trial
    ranked = _with_criteria(ranked)
    eligible, text = _eligible_indices(ranked, close) if prefers_integer_orders else (close, "")
    best, winner = ranked[0], _winner([ranked[k] for k in eligible])
    return Choice(tuple(ranked), winner, _reason(winner, best, ranked) + text)


def _combine_choices(work: CandidateEvaluator, choices: Sequence[Choice]) -> Choice:
    """Return the choice of one structure that has the chosen equations of several outputs.

    An input has a single delay in a structure. If the chosen equations have different delays of an input, the best
    candidates without free delays are combined instead. Raise ConvergenceError if the combination cannot be fitted.
    """
    has_common_delays = _have_common_delays([c.winner for c in choices])
    if not has_common_delays:
        choices = [_without_free_delays(choice) for choice in choices]
    winners = [c.winner for c in choices]
    structures = [w.structure for w in winners]
    combination = replace(
        structures[0],
        equations=tuple(e for s in structures for e in s.equations),
        order_values={n: v for s in structures for n, v in s.order_values.items()},
        delay={n: v for s in structures for n, v in s.delay.items()},
        free_delays={n: v for s in structures for n, v in s.free_delays.items()},
        offset=max((s.offset for s in structures), key=("none", "level", "constant", "ramp").index),
    )
    if any(w.joint is not None and w.joint.initial != "rest" for w in winners):
        combination = replace(combination, initial="caputo")
    start = {n: v for w in winners for n, v in w.values.items()}
    trial = work.validate(
        describe_structure(combination), combination, work.fit_candidate(combination, [start]), is_final=True
    )
    reason = " ".join(c.reason for c in choices)
    if not has_common_delays:
        reason += (
            " The outputs do not have the same delay, and an input has one: the equations have no free delay. Select "
            "each output on its own for its delay."
        )
    if trial.failure is not None:
        raise ConvergenceError(f"{trial.name} cannot be fitted to {work.folds.description}; {trial.failure}")
    return Choice((trial, *(t for c in choices for t in c.ranked)), trial, reason, tuple(choices))


def _have_common_delays(winners: Sequence[Trial]) -> bool:
    """Whether the delay estimates of each input agree within their errors in all equations."""
    for name in {i.name for w in winners for i in w.structure.free_input_parameters}:
        signal = next(i.signal for w in winners for i in w.structure.free_input_parameters if i.name == name)
        concerned = [w for w in winners if signal in w.structure.signals]
        if any(name not in w.values for w in concerned):
            return False
        values, errors = np.array([(w.values[name], w.standard_errors[name]) for w in concerned]).T
        if np.any(np.abs(values[:, None] - values) > NORMAL_99 * np.hypot(errors[:, None], errors)):
            return False
    return True


def _without_free_delays(choice: Choice) -> Choice:
    """Return the choice among candidates without free delays, or the same choice if there are none."""
    ranked = [t for t in choice.ranked if t.failure is None and not t.structure.free_input_parameters]
    if not choice.winner.structure.free_input_parameters or not ranked:
        return choice
    close = [k for k in _peer_indices(ranked) if _predicts_equally(ranked[k], ranked[0])]
    winner = _winner([ranked[k] for k in close])
    return replace(choice, winner=winner, reason=_reason(winner, ranked[0], ranked))


def _identify_choice(work: CandidateEvaluator, choice: Choice) -> Selection:
    """Return the selection whose chosen structure is identified on all runs, with findings on the choice."""
    folds, winner = work.folds, choice.winner
    structure = _with_validated_initial_conditions(winner)
    if folds.split is None:
        result = identify(list(folds.runs), structure, threads=work.threads)
    else:
        runs, duration = folds.split
        result = identify_pieces(runs, structure, duration, threads=work.threads)
    findings: list[Finding] = []
    if winner.joint is not None and result.joint is not None and result.joint.noise:
        lower = [o for o, v in result.joint.noise.items() if v < 0.99 * winner.joint.noise.get(o, v)]
        if lower:
            findings.append(make_finding("other_optimum", output=", ".join(lower)))
    if winner.validation_fit < MIN_VALIDATION_FIT:
        findings.append(make_finding("no_candidate_fits", fit=format_fit(winner.validation_fit)))
    poor_parts = [f"{name} ({format_fit(fit)} %)" for name, fit in winner.fits_by_part.items() if not fit > 0.0]
    if poor_parts:
        findings.append(make_finding("worse_than_mean", parts=", ".join(poor_parts)))
    for single_choice in choice.parts or (choice,):
        findings += _fractional_order_findings(single_choice.winner, single_choice.ranked, result)
    validated = result.validate(folds.unseen_runs) if folds.unseen_runs else None
    if validated is not None:
        findings += mark_validation(validated.findings, ", ".join(run.name for run in folds.unseen_runs))
    return Selection(
        choice.ranked,
        choice.ranked.index(winner),
        result,
        folds.description,
        choice.reason,
        work.done_count,
        tuple(findings),
        validated,
    )


def _with_criteria(ranked: Sequence[Trial]) -> list[Trial]:
    """Return ranked trials with their Schwarz criteria (BIC), for all samples and for the effective ones.

    The effective number of samples follows from the autocorrelation of the residuals of the best trial. The trial with
    the whitest residuals is not suitable for this purpose, because a model of high order can fit drifts and
    disturbances and still predict worse.
    """
    inflation = 1.0 if ranked[0].joint is None else residual_variance_inflation(ranked[0].joint)
    return [
        t
        if t.joint is None
        else replace(t, bic=fit_criterion(t.joint), effective_bic=fit_criterion(t.joint, inflation))
        for t in ranked
    ]


def _fractional_order_findings(winner: Trial, ranked: Sequence[Trial], result: Identification) -> list[Finding]:
    """Return a finding on whether the fractional orders of the chosen candidate improve the prediction.

    The chosen candidate is compared with the best one of integer orders by the rule of ``ftlm orders``.
    """
    orders = {n: v for n, v in winner.values.items() if n in winner.structure.order_names and n in result.orders}
    if not any(abs(v - round(v)) > INTEGER_TOLERANCE for v in orders.values()):
        return []
    orders_text = ", ".join(f"{n} = {result.orders[n]:.3g}" for n in orders)
    integer_trial = next((t for t in ranked if t.failure is None and not has_memory(t.structure)), None)
    if integer_trial is None or set(integer_trial.fits_by_part) != set(winner.fits_by_part):
        reason = "no candidate with integer orders was fitted"
        return [make_finding("fractional_orders_inconclusive", parameter=orders_text, reason=reason)]
    gains = [fit - integer_trial.fits_by_part[name] for name, fit in winner.fits_by_part.items()]
    parts = f"{len(gains)} part{'s' if len(gains) > 1 else ''}"
    details = {"parameter": orders_text, "other": integer_trial.name, "parts": parts, "gain": median(gains)}
    if is_degenerate(result) or integer_trial.unstable or not integer_trial.validation_fit >= MIN_VALIDATION_FIT:
        reason = f"the fit of {integer_trial.name}, or of the chosen candidate, must not be used"
        return [make_finding("fractional_orders_inconclusive", reason=reason, **details)]
    intervals = {n: {"all": result.intervals[n]} for n in orders if n in result.intervals}
    integer_orders = {n: float(round(orders[n])) for n in intervals}
    is_improvement = improves_prediction(gains, intervals, integer_orders) if intervals else None
    if is_improvement is None:
        is_worse = min(gains) <= -MIN_FIT_GAIN
        comparison_text = "lower" if is_worse else "not higher"
        reason = (
            f"compared with {integer_trial.name}, the fit is higher on some parts and {comparison_text} on other parts"
        )
        return [make_finding("fractional_orders_inconclusive", reason=reason, **details)]
    return [make_finding("fractional_orders_gain" if is_improvement else "fractional_orders_gain_nothing", **details)]


def _failed_parts(trials: Sequence[Trial]) -> list[list[str]]:
    """Return, for each trial, the names of the parts of the validation data on which it fails.

    A trial fails on a part if its prediction is poor while a stable trial predicts this part far better.
    """
    scores_by_part = [dict(zip(t.fits_by_part, t.scores, strict=False)) for t in trials]
    lowest_scores: dict[str, float] = {}
    for scores in (part for part, t in zip(scores_by_part, trials, strict=True) if not t.unstable):
        for name, score in scores.items():
            lowest_scores[name] = min(score, lowest_scores.get(name, math.inf))
    return [
        [n for n, v in s.items() if v > FAILURE_SCORE and v > lowest_scores.get(n, math.inf) + FAILURE_SCORE_GAP]
        for s in scores_by_part
    ]


def _rank_trials(trials: Sequence[Trial]) -> list[Trial]:
    """Return trials sorted by stability, number of failures and mean score, best first; failed fits are last.

    By the mean score alone, good fits on other blocks would compensate for a failure on one block.
    """
    failures = dict(zip(map(id, trials), map(len, _failed_parts(trials)), strict=True))
    return sorted(
        trials, key=lambda t: (t.failure is not None, t.unstable, failures[id(t)], t.score, t.parameter_count, t.name)
    )


def _peer_indices(ranked: Sequence[Trial]) -> list[int]:
    """Return the indices of valid trials that are as stable as the best one and fail on no more parts than it does."""
    best, failures = ranked[0], [len(f) for f in _failed_parts(ranked)]
    return [
        k
        for k, t in enumerate(ranked)
        if t.failure is None and t.unstable == best.unstable and failures[k] <= failures[0]
    ]


def _predicts_equally(trial: Trial, best: Trial) -> bool:
    """Whether a trial predicts as well as the best one.

    Its residual is at most 1 % larger, or up to 5 % if the difference over folds is not significant.

    The best trial is the best of many, so a limit of one standard error would reject a true structure in one case of
    ten. If one block contains information that the others lack, the residual of the true structure on this block is
    more than 5 % larger. The true structure is then eligible if the evidence for it on all samples is very strong. With
    too few folds for a t-test, its residual must also be at most 5 % larger.
    """
    differences = np.array(trial.scores) - np.array(best.scores)
    score_gap, likely = trial.score - best.score, _bic(trial) <= _bic(best) - BIC_STRONG_EVIDENCE
    if differences.size < MIN_T_TEST_FOLDS:
        return score_gap <= SCORE_TOLERANCE or (score_gap <= MAX_SCORE_TOLERANCE and likely)
    error = float(np.std(differences, ddof=1)) / math.sqrt(differences.size)
    quantile = STUDENT_QUANTILES_95[min(differences.size - MIN_T_TEST_FOLDS, len(STUDENT_QUANTILES_95) - 1)]
    return (score_gap <= quantile * error and likely) or score_gap <= max(
        SCORE_TOLERANCE, min(quantile * error, MAX_SCORE_TOLERANCE)
    )


def _eligible_indices(ranked: Sequence[Trial], close: Sequence[int]) -> tuple[list[int], str]:
    """Return the indices of eligible trials under a preference for integer orders, and text on fractional orders.

    `close` are the indices of the trials that predict as well as the best one.

    Fractional orders are eligible if their residuals are significantly smaller over the folds, by at least 1 %, than
    those of the best integer orders. They are also eligible if they predict as well and their Schwarz criterion is much
    lower.
    """
    integer_order_indices = [k for k in _peer_indices(ranked) if not has_memory(ranked[k].structure)]
    fractional_indices = [k for k in close if has_memory(ranked[k].structure)]
    if not integer_order_indices or not fractional_indices:
        return list(close), ""
    best_integer = ranked[min(integer_order_indices, key=lambda k: ranked[k].score)]
    peers = [k for k in integer_order_indices if _predicts_equally(ranked[k], best_integer)]
    limit = min(_bic(ranked[k]) for k in peers) - BIC_STRONG_EVIDENCE
    better = [k for k in fractional_indices if _predicts_better(ranked[k], best_integer)]
    if better:
        return better, ""
    equivalent = [
        k for k in fractional_indices if _predicts_equally(ranked[k], best_integer) and _bic(ranked[k]) < limit
    ]
    if equivalent:
        return equivalent, " Integer orders with a delay and zeros predict as well, with a higher Schwarz criterion."
    return peers, ""


def _predicts_better(trial: Trial, reference: Trial) -> bool:
    """Whether the residuals of a trial are smaller than another's by at least 1 %, and significantly over the folds."""
    differences = np.array(trial.scores) - np.array(reference.scores)
    if differences.size < MIN_T_TEST_FOLDS or trial.score > reference.score - SCORE_TOLERANCE:
        return False
    error = float(np.std(differences, ddof=1)) / math.sqrt(differences.size)
    return float(np.mean(differences)) < -MIN_BETTER_T_STATISTIC * error


def _winner(close: Sequence[Trial]) -> Trial:
    """Return the trial with the lowest Schwarz criterion; ties go to fewer parameters, then to the lower order.

    From rest, an equation and its derivative are equivalent, so the lower order is preferred.
    """
    lowest_bic = min(_bic(t) for t in close)
    equivalent = [t for t in close if _bic(t) <= lowest_bic + BIC_TOLERANCE]
    return min(
        equivalent, key=lambda t: (t.parameter_count, _total_integer_order(t), t.score, t.mean_log_relative_error)
    )


def _total_integer_order(trial: Trial) -> int:
    """Return the sum of the orders of the equations, rounded to an integer."""
    return sum(round(e.order.substitute(trial.values).constant) for e in trial.structure.equations)


def _bic(trial: Trial) -> float:
    return math.inf if trial.effective_bic is None else trial.effective_bic


def _with_validated_initial_conditions(trial: Trial) -> Structure:
    """Return the structure of a trial with the initial conditions of its validation.

    If the runs started from rest, the structure still allows initial terms, because a later run may have nonzero
    initial conditions.
    """
    if trial.joint is None or (trial.structure.initial == "auto" and trial.joint.initial == "rest"):
        return trial.structure
    return replace(trial.structure, initial=trial.joint.initial)


def _reason(winner: Trial, best: Trial, ranked: Sequence[Trial]) -> str:
    """Return the reason for the choice of the winner as text."""
    validation_fit = format_fit(winner.validation_fit)
    text = f"Chosen: {winner.name} ({winner.parameter_count} parameters, validation fit {validation_fit} %)."
    if winner is best:
        text += " It predicts best."
    else:
        text += " Of the candidates that predict as well as the best, it has the lowest Schwarz criterion."
    peers = [ranked[k] for k in _peer_indices(ranked)]
    smaller_models = [t for t in peers if t.parameter_count < winner.parameter_count]
    larger_models = [t for t in peers if t.parameter_count > winner.parameter_count]
    for compared in filter(None, (smaller_models, larger_models)):
        closest = min(compared, key=lambda t: t.score)
        change = 100 * (math.exp(closest.score - winner.score) - 1)
        comparison = "larger" if change >= 0 else "smaller"
        text += (
            f" With {closest.parameter_count} parameters, validation residuals are {float(f'{abs(change):.2g}'):g} % "
            f"{comparison}."
        )
    return text + _failure_text(winner, ranked)


def _failure_text(winner: Trial, ranked: Sequence[Trial]) -> str:
    """Return text on candidates with better scores that fail on a part, and on parts on which the winner fails."""
    failures = dict(zip(map(id, ranked), _failed_parts(ranked), strict=True))
    text = ""
    better = [t for t in ranked if failures[id(t)] and t.score < winner.score and t.unstable == winner.unstable]
    if better:
        alternative = min(better, key=lambda t: t.score)
        name, excess_percent = failures[id(alternative)][0], 100 * (1 - math.exp(alternative.score - winner.score))
        text += (
            f" {alternative.name} has {excess_percent:.2g} % smaller residuals on average and is not chosen: it "
            f"fails on {name}, with "
            f"a fit of {format_fit(alternative.fits_by_part[name])} % where the chosen one has "
            f"{format_fit(winner.fits_by_part[name])} %."
        )
    for name in failures[id(winner)]:
        alternative = max(
            (t for t in ranked if name in t.fits_by_part and not t.unstable), key=lambda t: t.fits_by_part[name]
        )
        text += (
            f" It fails on {name}, with a fit of {format_fit(winner.fits_by_part[name])} %; {alternative.name} has "
            f"{format_fit(alternative.fits_by_part[name])} % there, but fails elsewhere."
        )
    return text
