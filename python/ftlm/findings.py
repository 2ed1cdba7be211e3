"""Findings about data, fits and models: their records, and the catalogue of their sentences."""

from __future__ import annotations

import math
import string
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from ftlm.utils.parameters import choose_text, parameter

#: Severity levels: the model must not be used, must be used with care, has a property worth knowing, or its data have a
#: note on how they were read.
LEVEL_DO_NOT_USE, LEVEL_WITH_CARE, LEVEL_FACT, LEVEL_NOTE = "do not use", "with care", "fact", "note"
FINDING_LEVELS = (LEVEL_DO_NOT_USE, LEVEL_WITH_CARE, LEVEL_FACT, LEVEL_NOTE)
#: Maximum number of groups of findings in a summary.
MAX_SUMMARY_FINDINGS = 3
#: Codes of residuals that are not white.
NOT_WHITE_CODES = ("residuals_not_white", "output_not_white", "noise_coloured", "response_not_white")
#: Codes of residuals that show what a model leaves out.
LEFT_OUT_CODES = (
    "residuals_follow_input",
    "coupling_missing",
    "residuals_follow_direction",
    "residuals_not_white",
    "output_not_white",
)
#: Fields of the subject of a finding.
SUBJECT_FIELDS = ("run", "output", "input", "parameter", "method")
#: Role of findings on runs that a model was not identified from.
VALIDATION_ROLE = "validation"


@dataclass(frozen=True)
class Topic:
    """Topic of findings that share a remedy and stand together in a summary.

    Parameters
    ----------
    what
        Summary of such findings.
    remedy
        Template of the recommended action.
    alternative, method
        Template of an action that uses another method, and the method that it recommends. Left out of the remedy of a
        finding on that method.
    """

    what: str
    remedy: str = ""
    alternative: str = ""
    method: str = ""


#: Topics by name, most serious first within a level.
FINDING_TOPICS: dict[str, Topic] = {
    "unstable": Topic(
        "the simulation grows without bound",
        "leave out the term that makes it unstable, bound its coefficient, or, in a closed loop, name the "
        "reference signal with {ask[reference]}",
    ),
    "chaos": Topic(
        "the motion is chaotic",
        "fit parts of the run that are shorter than that, or use {ask[method is least-squares]}",
    ),
    "overflow": Topic("the simulation overflows", "choose other orders, or fewer terms"),
    "not_separable": Topic(
        "some parameters are not separately identifiable from the runs",
        "leave a term out, fix one of them, or record a richer input",
    ),
    "near_identity": Topic(
        "its equation nearly says that an output equals itself", "keep own orders well below the highest one"
    ),
    "poor_fit": Topic(
        "the simulation explains little of an output",
        "add a missing input, a delay or a term",
        "or use {ask[method is output-error]}",
        "output-error",
    ),
    "validation_loss": Topic(
        "the model predicts other runs worse than its own", "use fewer free parameters, or more runs in one fit"
    ),
    "offset": Topic("a constant is missing, or not identifiable", "{ask[offset is constant]} or {ask[offset is auto]}"),
    "closed_loop": Topic(
        "the runs were recorded in a closed loop", "name the reference signal with {ask[reference]}, or open the loop"
    ),
    "weak_instrument": Topic("the reference explains little of the input", "record a stronger reference"),
    "not_identifiable": Topic(
        "a parameter is not identifiable from the runs", "fix it, leave it out, or record a richer input"
    ),
    "residuals": Topic("the model is incomplete", "add a term, a delay or a free order; ftlm select compares them"),
    "provisional": Topic("the fit is provisional", "give {ask[start]} another result, or free fewer parameters"),
    "imprecise": Topic(
        "some parameters are poorly determined", "fix a parameter, leave a term out, or record a richer input"
    ),
    "approximate_intervals": Topic("some intervals are approximate", "{ask[intervals is profile]} computes them"),
    "sampling": Topic("the sampling is coarse for this model", "sample faster, raise m, or trust its fast poles less"),
    "prior": Topic(
        "the prior shifts the coefficients",
        "raise {ask[prior_covariance]}, or use {ask[method is least-squares]}",
    ),
    "coefficient_law": Topic(
        "the coefficient law is violated", "", "use {ask[method is output-error]}", "output-error"
    ),
    "bound": Topic("an order or another parameter is on its bound", "widen the bound"),
    "order_table": Topic("the table of orders", "record a longer run, or fix an order"),
    "initial_conditions": Topic("the result depends on initial conditions", "begin the run at rest"),
    "data": Topic("some samples are unreliable", "see the warning"),
    "repeated_run": Topic("a validation run is an estimation run", "give another run"),
    "no_standard_errors": Topic(
        "the parameters have no standard errors", "", "use {ask[method is output-error]}", "output-error"
    ),
    "validation": Topic("the prediction of other data is not known"),
    "noise": Topic("the noise is colored"),
    "other": Topic("note"),
}
#: Texts of Python and of the command line by name, for templates.
INTERFACE_TEXTS = {
    "validate": ("validate(run)", "--validation FILE"),
    "validate response": ("validate(load_frequency(file))", "--validation FILE"),
}
#: Remedies that say no more than the finding itself.
_PLAIN_REMEDY = "see the warning"


@dataclass(frozen=True)
class FindingKind:
    """Entry of the catalogue: topic, level and templates of one code.

    Parameters
    ----------
    topic
        Name of its topic.
    level
        ``"do not use"``, ``"with care"``, ``"fact"`` or ``"note"``.
    template
        Template of the sentence after the prefix. A bar marks the end of its first clause. ``{remedy}`` is replaced
        by the remedy.
    reason
        Template of the reason in a verdict; empty for the topic and the first clause of the text.
    remedy
        Template of the remedy; empty for that of the topic.
    prefix
        Template of the beginning that names the run; a page about that run omits it.
    """

    topic: str
    level: str
    template: str
    reason: str = ""
    remedy: str = ""
    prefix: str = ""

    @property
    def states_remedy(self) -> bool:
        """Whether the sentence itself states the remedy."""
        return "remedy" in {name for _, name, _, _ in string.Formatter().parse(self.template)}


def _rule(topic: str, level: str, text: str, remedy: str = "") -> FindingKind:
    """Return an entry whose sentence is the reason of a verdict."""
    return FindingKind(topic, level, text, text, remedy)


#: The catalogue by code.
FINDING_CATALOGUE: dict[str, FindingKind] = {
    # Simulation
    "free_run_grows": FindingKind(
        "unstable",
        LEVEL_DO_NOT_USE,
        "the model is {stability}: its simulation grows without bound, however well it fits a run of this length",
        "the simulation grows without bound ({poles})",
    ),
    "plant_unstable": FindingKind(
        "unstable",
        LEVEL_FACT,
        "the model is unstable, and so is the plant: simulations restarted every {seconds:.2g} s explain "
        "{fit:.3g} % of the outputs, and the outputs stay bounded, so a controller was acting",
        remedy="record the reference signal of the controller, and give it as {ask[reference]}",
    ),
    "runs_split": FindingKind(
        "other",
        LEVEL_FACT,
        "no simulation of a whole run follows this unstable plant, which a controller stabilizes: the runs were split "
        "into {pieces} pieces of at least {seconds:.2g} s, each with its own initial values; {ask[initial is rest]} or "
        "another start simulates whole runs",
    ),
    "plant_unstable_in_pieces": FindingKind(
        "closed_loop",
        LEVEL_WITH_CARE,
        "the model is unstable, and so is the plant, which a controller stabilizes: simulations restarted "
        "every {seconds:.2g} s explain {fit:.3g} % of the outputs, while a simulation of the whole run grows; noise "
        "in the feedback biases this method",
        "the plant is unstable, as the model is: simulations restarted every {seconds:.2g} s explain {fit:.3g} % of "
        "the outputs",
        "identify run.split({seconds:.2g}) by output error with {ask[initial is caputo]}, which white "
        "noise does not bias",
    ),
    "plant_needs_pieces": FindingKind(
        "unstable",
        LEVEL_DO_NOT_USE,
        "the plant is unstable and stabilized by a controller, so no simulation of a whole run fits the outputs: "
        "least squares at these orders gives an unstable model whose simulations, restarted every "
        "{seconds:.2g} s, explain {fit:.3g} %",
        "the plant is unstable and stabilized by a controller, so no simulation of a whole run fits the outputs",
        "identify run.split({seconds:.2g}) with {ask[initial is caputo]}, or use "
        "{ask[method is least-squares]}, which noise in the loop biases",
    ),
    "growth_not_told": FindingKind(
        "unstable",
        LEVEL_FACT,
        "the model is {stability}, but not significantly: within its standard errors it may be stable",
        remedy="leave the unstable term out, or record a longer run",
    ),
    "growth_untold": _rule("unstable", LEVEL_WITH_CARE, "whether the model is stable is unknown"),
    "unstable_optimum_kept": FindingKind(
        "unstable",
        LEVEL_WITH_CARE,
        "this optimum is unstable; the best stable one found has residuals {excess:.2g} % larger, which is "
        "significant at 99 %: the machine is unstable in a closed loop, or a term is missing",
    ),
    "no_stable_optimum": FindingKind(
        "unstable",
        LEVEL_DO_NOT_USE,
        "this optimum is unstable, and no stable one was found",
    ),
    "unstable_optimum_discarded": FindingKind(
        "other",
        LEVEL_FACT,
        "an optimum that is not stable has residuals {smaller:.2g} % smaller, which is not significant: the "
        "free initial conditions cancel its growing mode until the end of the run; the stable optimum was kept",
    ),
    "damping_not_told": FindingKind(
        "not_identifiable",
        LEVEL_WITH_CARE,
        "an optimum that is not stable has residuals {smaller:.2g} % smaller, which is not significant: the "
        "free initial conditions cancel its growing mode until the end of the run|; the stable optimum was kept, "
        "which is at the stability limit: its damping is not identifiable from the runs",
    ),
    "instruments_unstable": FindingKind(
        "unstable",
        LEVEL_DO_NOT_USE,
        "{output}: the simulation with these coefficients is unstable|; do not use them",
    ),
    "swing_may_not_decay": _rule(
        "not_identifiable",
        LEVEL_WITH_CARE,
        "an oscillation at {frequency:.4g} rad/s may not decay (damping {damping:.2g}{spread})",
        "add the term that damps it, or record until it has decayed",
    ),
    "out_of_range": FindingKind(
        "overflow",
        LEVEL_DO_NOT_USE,
        "{output}: the simulation overflows, so its residuals cannot be tested",
        "the simulation overflows",
    ),
    "equation_says_identity": FindingKind(
        "near_identity",
        LEVEL_DO_NOT_USE,
        "{output}: {orders} close to alpha = {alpha:g}, so the equation nearly says that {output} equals "
        "itself|; its simulation has NR {nr:.3g} against {equation_nr:.3g} for the equation error. Do not "
        "use these orders",
        "its equation nearly says that an output equals itself",
    ),
    "flattered_by_equation_error": FindingKind(
        "poor_fit",
        LEVEL_DO_NOT_USE,
        "{output}: the simulation| (NR {nr:.3g}) is far worse than the equation error ({equation_nr:.3g}), "
        "which does not measure the quality of this model",
    ),
    "explains_little": FindingKind(
        "poor_fit", LEVEL_DO_NOT_USE, "{output}: the simulation explains little of the output| (NR {nr:.3g})"
    ),
    "buried_in_noise": FindingKind(
        "poor_fit",
        LEVEL_WITH_CARE,
        "{output}: the noise exceeds the response to the input (NR {nr:.3g}), and the residuals are not "
        "correlated with the input: this run gives no evidence that the model is incomplete",
        "{output} is buried in noise (NR {nr:.3g}), and its residuals are not correlated with the input",
        "excite the input more, record longer, or average repeated runs",
    ),
    "end_row_far_off": FindingKind(
        "poor_fit",
        LEVEL_WITH_CARE,
        "{output}: its first or last row is an outlier: with it the simulation explains little of the output "
        "(NR {nr:.3g}), without it {inner:.3g} %",
        "the first or last row of {output} is an outlier (NR {nr:.3g} with it; {inner:.3g} % of the other "
        "rows is explained)",
        "cut that row away, or mark it as missing",
    ),
    "poor_fit": _rule("poor_fit", LEVEL_DO_NOT_USE, "the simulation explains little of {where}{shown}"),
    "fit_falls": FindingKind(
        "validation_loss",
        LEVEL_WITH_CARE,
        "the fit of {output} falls from {before:.3g} % on the estimation data to {after:.3g} %|: the model "
        "is overfitted to the estimation data",
        "the fit of {output} falls from {before:.3g} to {after:.3g} % on validation{where}",
        prefix="{run}: ",
    ),
    "sampling_coarse": FindingKind(
        "sampling",
        LEVEL_WITH_CARE,
        "the simulation on {run} still depends on the step at the finest grid: the model is too stiff for "
        "this sampling interval, and its output error is provisional",
    ),
    "mode_sampled_coarsely": FindingKind(
        "sampling",
        LEVEL_FACT,
        "a mode of {frequency:.4g} rad/s has {samples:.2g} samples per period|: its parameters depend on the "
        "inputs between samples; zero- and first-order hold differ there by half a sample ({phase:.0f} "
        "degrees) and by {loss:.1g} % in gain",
        remedy="take at least eight samples per period, or state the behavior between samples with {ask[intersample]}",
    ),
    "other_intersample_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{input} was assumed {taken} between samples, but {other} fits better|: the sum of squared residuals is "
        "{ratio:.3g} times as large, and {parameter} is {other_value:.4g}, not {value:.4g} ± {error:.2g}",
        "{input} was assumed {taken} between samples, but {other} fits better: {parameter} is {other_value:.4g}, not "
        "{value:.4g}",
        "state {input}={kind} in {ask[intersample]} if that is true",
        prefix="{run}: ",
    ),
    "scheme_unstable": FindingKind(
        "sampling",
        LEVEL_WITH_CARE,
        "{output}: with {m} pulses the discretization itself is unstable| (margin {margin:.2g}), whether or "
        "not the model is; raise m",
    ),
    # Parameters
    "not_told_apart": FindingKind(
        "not_separable",
        LEVEL_DO_NOT_USE,
        "not separately identifiable from these runs: {parameter}; changed together they leave the outputs unchanged, "
        "so their intervals are infinite; {remedy}",
        "not separately identifiable from the runs: {shown}",
    ),
    "errors_undefined": FindingKind(
        "not_separable",
        LEVEL_DO_NOT_USE,
        "the standard errors of {parameter} are not defined: the covariance of the fit is not finite",
    ),
    "numbers_correlated": FindingKind(
        "imprecise", LEVEL_FACT, "barely separately identifiable from these runs: {parameter}| ({why})"
    ),
    "order_not_told": FindingKind(
        "not_identifiable",
        LEVEL_WITH_CARE,
        "order {parameter} is not identifiable from these runs: its standard error exceeds its bounds",
    ),
    "input_number_not_told": FindingKind(
        "not_identifiable",
        LEVEL_WITH_CARE,
        "the {words} is not identifiable from these runs: its standard error exceeds its bounds",
    ),
    "on_bound": FindingKind("bound", LEVEL_WITH_CARE, "{what} = {value} is on its bound|; widen it"),
    "coefficient_on_bound": FindingKind(
        "bound",
        LEVEL_WITH_CARE,
        "{parameter} = {value:.4g} is on its bound; without the bound the estimate is {outside:.4g}|. {parameter} has "
        "no interval, and the intervals of the other parameters hold for this value",
        "{parameter} = {value:.4g} is on its bound; without the bound the estimate is {outside:.4g}",
    ),
    "genetic_on_bound": FindingKind(
        "bound", LEVEL_WITH_CARE, "{parameter} = {value:.4g} is on its bound for the genetic algorithm|; widen it"
    ),
    "nonlinear_range": FindingKind(
        "other",
        LEVEL_FACT,
        "{term} is {share:.3g} % of {whole} (rms) in the equation of {output}|, which is fitted only for {ranges}",
    ),
    "run_forgets": FindingKind(
        "chaos",
        LEVEL_DO_NOT_USE,
        "a small change of a parameter changes the second half of the simulation {growth:.2g} times as much as its "
        "first half|: the motion is chaotic or nearly so. After {seconds:.3g} s the simulation depends on the "
        "parameters too strongly for a fit, and a fit to the whole run has no intervals; {remedy}",
    ),
    "free_runs_of_some": FindingKind(
        "order_table",
        LEVEL_FACT,
        "the best {count} of {candidates} candidates by equation error were ranked by simulation: with non-linear "
        "terms no bound excludes the other candidates, so one of them may be better|; narrow the intervals of the "
        "orders, or identify by output error from here",
    ),
    "rows_repeat": FindingKind(
        "order_table",
        LEVEL_FACT,
        "{rows} rows contain {models} distinct model{plural}: adding a constant to all free orders does not "
        "change an equation from rest; give one order as a number, such as the lowest as 0",
        remedy="give one order as a number, such as the lowest as 0",
    ),
    "ranks_alike": FindingKind(
        "order_table",
        LEVEL_FACT,
        "ranks 1 to {last}{every} are equal within noise at 99 % ({shown})",
    ),
    "noise_decides": FindingKind(
        "order_table",
        LEVEL_WITH_CARE,
        "noise decides the ranking: ranks 1 to {last}{every} are equal within noise at 99 % ({shown}), so "
        "these orders are not identifiable from the run",
        "noise decides the ranking: ranks 1 to {last} are equal within noise ({shown})",
    ),
    "certified_run_grows": FindingKind(
        "unstable",
        LEVEL_DO_NOT_USE,
        "the simulation with these orders grows without bound ({poles} poles with a positive real part, NR "
        "{nr:.3g}): the certificate bounds the equation error, not the error of a simulation",
        remedy="use {ask[method is output-error]}",
    ),
    "certified_run_fails": FindingKind(
        "poor_fit",
        LEVEL_DO_NOT_USE,
        "the simulation with these orders explains little of the output (NR {nr:.3g}): the certificate "
        "bounds the equation error, not the error of a simulation",
        remedy="use {ask[method is output-error]}",
    ),
    "rank_not_judged": FindingKind(
        "order_table",
        LEVEL_WITH_CARE,
        "rank 1 could not be validated: {text}",
        "rank 1 could not be validated: {text}",
        "identify at these orders",
    ),
    "on_edge": FindingKind(
        "bound", LEVEL_WITH_CARE, "order {parameter} = {value:g} is on the edge of its interval|; widen it"
    ),
    "not_different_from_0": FindingKind(
        "imprecise",
        LEVEL_FACT,
        "coefficient {parameter} = {value:.4g} does not differ significantly from 0| (standard error {error:.3g})",
    ),
    "interval_open": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "unbounded intervals ({sides}): with all other parameters refitted the cost never rises significantly; "
        "{remedy}",
        "unbounded intervals: {parameter}",
    ),
    "number_vague": _rule("imprecise", LEVEL_WITH_CARE, "poorly identifiable from the runs: {shown}"),
    "coefficient_law_broken": FindingKind(
        "coefficient_law",
        LEVEL_WITH_CARE,
        "coefficient law: {parameter} = {value:.4g}, but the other equation gives {wanted:.4g}|; the equation-error "
        "estimators do not impose the law",
    ),
    "inertia_ratio_broken": FindingKind(
        "coefficient_law",
        LEVEL_WITH_CARE,
        "coefficient law: the inertia ratio {parameter} must exceed 1, but is {listed}",
    ),
    "prior_pulls": FindingKind(
        "prior",
        LEVEL_WITH_CARE,
        "{output}: the prior| (K0 = {prior:g}, coefficients near 0) shifts a coefficient by {share:.0f} % "
        "from the estimate without it; p = {length} only sets the weight of the data relative to the prior. Raise "
        "{ask[prior_covariance]}, or use {ask[method is least-squares]}",
    ),
    "prior_ranks": FindingKind(
        "prior",
        LEVEL_WITH_CARE,
        "{output}: the prior dominates the ranking of orders|: with K0 = {prior:g} the error of the best candidate is "
        "{share:.2g} of that of a zero output. Raise {ask[prior_covariance]}, or leave it out",
    ),
    "no_standard_errors": _rule(
        "no_standard_errors",
        LEVEL_WITH_CARE,
        "{method} gives no standard errors, so the uncertainty of the parameters is unknown",
    ),
    "intervals_rough": FindingKind(
        "approximate_intervals",
        LEVEL_FACT,
        "the cost is not quadratic along {parameter}, and a profile likelihood would take long: these intervals "
        "are approximate|; {remedy}",
    ),
    # Fit
    "not_converged": FindingKind(
        "provisional",
        LEVEL_WITH_CARE,
        "the fit has not converged|; its results are provisional",
        "the fit has not converged",
    ),
    "instruments_not_converged": FindingKind(
        "provisional",
        LEVEL_WITH_CARE,
        "{output}: instrumental variables did not converge in {iterations} iterations|; the coefficients are "
        "those of the smallest output error found. The noise is too large for these terms: {remedy}",
        remedy="use {ask[method is output-error]}",
    ),
    "lower_optimum_found": FindingKind(
        "provisional",
        LEVEL_WITH_CARE,
        "none of the {starts} initial guesses led to this optimum, but the search for intervals did| "
        "(residuals {before} before, {after} now): there may be others",
    ),
    "second_optimum": FindingKind(
        "provisional",
        LEVEL_WITH_CARE,
        "a second optimum explains the data as well (log likelihood smaller by {difference:.2g}): {shown}",
        "a second optimum explains the data as well: {shown}",
        "fix or bound one of these, or record data that distinguish the two",
    ),
    "seeds_disagree": FindingKind(
        "provisional",
        LEVEL_WITH_CARE,
        "{output}: the genetic algorithm ends at errors from {low:.4g} to {high:.4g}, depending on its seed|; not "
        "every seed has found the optimum",
    ),
    "step_moves_estimate": FindingKind(
        "sampling",
        LEVEL_WITH_CARE,
        "at {pulses} pulses per sample the discretization still changes estimates by over a tenth of their "
        "standard errors: the model is too stiff for this sampling interval|; sample faster, or trust its fast poles "
        "less",
    ),
    "step_bias": FindingKind(
        "sampling",
        LEVEL_WITH_CARE,
        "with {m} pulses the discretization alone changes coefficient {parameter} by {amount} standard errors, "
        "which do not include it|; {finer}use {ask[method is output-error]}, which refines the discretization",
    ),
    # Residuals
    "residuals_not_white": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "residuals of {output} are not white: the model is incomplete|; standard errors include the color of "
        "the residuals, not the bias of missing terms",
        "residuals of {output} are not white: the model is incomplete",
    ),
    "noise_coloured": FindingKind(
        "noise",
        LEVEL_FACT,
        "residuals of {output} are not white but independent of the inputs: the noise is colored, and "
        "standard errors include that",
    ),
    "output_not_white": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output}: residuals are not white| (statistic {statistic:.3g} over {lags} lags, 99 % limit "
        "{limit:.3g}): the model is incomplete",
    ),
    "residuals_follow_input": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output}: residuals are correlated with {input}| (correlation {value:.2g} at lag {lag}, 99 % limit "
        "{limit:.2g}): part of the effect of {input} is not modeled",
        "residuals are correlated with inputs ({shown}): the model is incomplete",
    ),
    "delay_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output} follows {input} with a delay of {value:.4g} ± {error:.2g} s that the model lacks|: with it the "
        "residuals are independent of the inputs",
        "{output} follows {input} with a delay of {value:.4g} s that the model lacks",
        "write {input}(t - 0:{longest:.2g}) in the equation, a delay between 0 and {longest:.2g} s that is estimated",
        prefix="{run}: ",
    ),
    "lag_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output} responds to {input} with one order more than the model has|: with it the residuals are independent "
        "of the inputs",
        "{output} responds to {input} with one order more than the model has",
        "raise the order of the equation by 1, and keep a term of its former order: {term}",
        prefix="{run}: ",
    ),
    "dynamics_missing": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "residuals of {output} contain a response to {input}|: a larger structure lowers their one-step prediction "
        "error, which colored noise alone does not allow, but none of those tried leaves residuals that are "
        "independent of the inputs",
        "residuals of {output} contain a response to {input} that the model lacks",
        prefix="{run}: ",
    ),
    "zero_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output} also responds to the derivative of {input}|: with it the residuals are independent of the inputs",
        "{output} also responds to the derivative of {input}, which the model lacks",
        "add the term {term} to the equation",
        prefix="{run}: ",
    ),
    "mode_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output} responds to {input} with one more pole and zero than the model has|: with them the residuals are "
        "independent of the inputs",
        "{output} responds to {input} with one more pole and zero than the model has",
        "raise the order of the equation by 1, keep a term of its former order, and add the derivative of the input: "
        "{term}",
        prefix="{run}: ",
    ),
    "saturation_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{input} saturates at ±{value:.3g} (standard error {error:.2g}), which the model lacks|: with it the residuals "
        "of {output} are independent of the inputs",
        "{input} saturates at ±{value:.3g}, which the model lacks",
        "write sat({input}, {low:.2g}:{high:.2g}) in the equation, a limit that is estimated",
        prefix="{run}: ",
    ),
    "dead_zone_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{input} has a dead zone of ±{value:.3g} (standard error {error:.2g}), which the model lacks|: with it the "
        "residuals of {output} are independent of the inputs",
        "{input} has a dead zone of ±{value:.3g}, which the model lacks",
        "write dead({input}, {low:.2g}:{high:.2g}) in the equation, a limit that is estimated",
        prefix="{run}: ",
    ),
    "square_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "the gain of {output} from {input} varies with {input}|: with a term in its square the residuals are "
        "independent of the inputs",
        "the gain of {output} from {input} varies with {input}",
        "add the term {term} to the equation",
        prefix="{run}: ",
    ),
    "load_step_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "a constant load acts on {output} from {time:.4g} s on|: a constant {value:.3g} ± {error:.2g} on the "
        "right-hand side of the equation from there on leaves residuals that are independent of the inputs",
        "a constant load acts on {output} from {time:.4g} s on",
        "record the load as an input, or use only the rows before it: {ask[window]}",
        prefix="{run}: ",
    ),
    "lead_fits": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output} moves {value:.4g} ± {error:.2g} s (about {rows:.2g} rows) before {input} does in the log|: with "
        "{input} shifted earlier by that much the residuals are independent of the inputs",
        "{output} moves before its input {input}, by about {rows:.2g} rows",
        "log the input before it acts, shift its rows, or allow a {ask[delay]} down to minus one sampling interval",
        prefix="{run}: ",
    ),
    "residuals_follow_direction": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output}: residuals depend on the direction of motion| (correlation {value:.2g}, 99 % limit {limit:.2g}): dry "
        "friction, backlash or another non-linearity is not modeled",
        "residuals of {output} depend on the direction of motion: friction is missing",
        "add the term {term}",
    ),
    "coupling_missing": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output}: residuals are correlated with {input} (correlation {value:.2g} at lag {lag}, 99 % limit "
        "{limit:.2g}), which is in no equation but acts on {output}",
        "{output} depends on {input}, which is in no equation",
        "add a term of {input}; for the flexible link {ask[cross_stage is torques]} adds the other link, and "
        "{ask[friction]} the dry friction of the hubs",
    ),
    "arm_leaves_out": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "residual tests show dynamics that are not modeled, and the equations of the flexible link omit {parts}",
        "the equations of the flexible link omit {parts}",
        "{ask[coupling is simulated]} with {ask[friction]} adds the dry friction of the hubs, and "
        "{ask[cross_stage is inertial]} the other link",
    ),
    "follow_undecided": FindingKind(
        "other",
        LEVEL_FACT,
        "{output}: whether residuals are correlated with {input} is undecided: the limit is {limit:.3g}, "
        "because the samples are too few for residuals of this color; give a longer run",
    ),
    "follow_undecided_still": FindingKind(
        "other",
        LEVEL_FACT,
        "{output}: whether residuals are correlated with {input} is undecided: {input} is constant; give a "
        "run in which it changes",
    ),
    "loop_found": FindingKind(
        "closed_loop",
        LEVEL_WITH_CARE,
        "{output}: {input} depends on past values of {output} (statistic {ratio:.3g} times its limit) as in a closed "
        "loop, or was measured with noise: the noise in {input} biases estimates{effect}, which their intervals do "
        "not include; record the reference signal and name it with {ask[reference]}, or open the loop",
        "{input} depends on past values of {output}: a closed loop, which biases the estimates",
    ),
    "loop_harmless": FindingKind(
        "closed_loop",
        LEVEL_FACT,
        "{output}: {input} depends on past values of {output} (statistic {ratio:.3g} times its limit) as in a closed "
        "loop, or was measured with noise: output-error estimates are biased{effect}, and equation-error estimates "
        "may be biased more",
    ),
    "moves_within_row": FindingKind(
        "closed_loop",
        LEVEL_FACT,
        "{output}: residuals are correlated with {input} of the same row only (correlation {value:.2g}): "
        "{input} depends on {output} within a row, or has direct feedthrough to it; then add that term",
    ),
    "too_short_for_tests": _rule(
        "residuals", LEVEL_WITH_CARE, "the runs are too short for residual tests", "record a longer run"
    ),
    "reference_weak": FindingKind(
        "weak_instrument",
        LEVEL_WITH_CARE,
        "{reference} explains little of {input} compared with the noise in it| (F = {f:.2g}, at least {needed:g} is "
        "needed): a weak instrument, with which estimates are biased and their intervals too narrow; excite "
        "the reference more, or longer",
    ),
    # Offset and start
    "offset_missing": FindingKind(
        "offset",
        LEVEL_WITH_CARE,
        "an unknown constant in the equation of {output} explains {share:.2g} % of the residuals| ({test}): "
        "a sensor offset, a load, a voltage at rest; use {ask[offset is constant]} or {ask[offset is auto]}",
    ),
    "drift_fits": FindingKind(
        "offset",
        LEVEL_WITH_CARE,
        "the level of {output} drifts: with a linear trend the sum of squared residuals is {ratio:.3g} times as "
        "large, and {parameter} is {other_value:.4g}, not {value:.4g} ± {error:.2g}",
        "the level of {output} drifts: with a linear trend {parameter} is {other_value:.4g}, not {value:.4g}",
        "let the sensor settle, or estimate the trend with the model: {ask[offset is ramp]}",
        prefix="{run}: ",
    ),
    "constant_instead_of_past": FindingKind(
        "offset",
        LEVEL_FACT,
        "the initial conditions of {output} are estimated with {terms} powers of time|; an unknown constant "
        "in the equation explains as much with {fewer} parameters fewer: if there may be a sensor offset, a load or "
        "a mean, {ask[offset is auto]} estimates it",
    ),
    "offset_hidden": _rule(
        "initial_conditions",
        LEVEL_WITH_CARE,
        "the offset of {shown} is not separately identifiable from the initial conditions",
    ),
    "rests_at_level": FindingKind(
        "other",
        LEVEL_FACT,
        "{shown} ({rows} quiet rows before an input moves)|; the simulation starts from rest there, and the level is "
        "estimated with the model: {ask[initial]} overrides this",
        prefix="{run}: ",
    ),
    "level_estimated": FindingKind(
        "other",
        LEVEL_FACT,
        "{output} does not start at zero, and a level of the output explains the runs better than initial "
        "terms alone|: the plant {was} about a level other than zero before the start; {ask[offset]} and "
        "{ask[initial]} override this",
        prefix="{run}: ",
    ),
    "rest_assumed": FindingKind(
        "initial_conditions",
        LEVEL_WITH_CARE,
        "{input} is constant from row {row} on, so the state of the plant before the run is unknown|: the "
        "gain assumes that it rested at {shown}; if it was moving, the gain is not determined",
        "{input} is constant from row {row} on: the gain assumes that the plant rested at {shown} before",
        "record some rows before the step, or a second step",
        prefix="{run}: ",
    ),
    "start_not_told": FindingKind(
        "initial_conditions",
        LEVEL_WITH_CARE,
        "the initial state is not identifiable|: if the run begins {taken}, the gain of {output} from "
        "{input} is {gain:.4g} ± {error:.2g}; if it begins {other}, it is {other_gain:.4g} ± "
        "{other_error:.2g}, with {ratio:.3g} times the sum of squared residuals",
        "the initial state is not identifiable: the gain of {output} from {input} is {gain:.4g} if the run "
        "begins {taken}, and {other_gain:.4g} if it begins {other}",
        "record some rows before an input changes, or give {ask[initial]} and {ask[offset]}",
        prefix="{run}: ",
    ),
    "moves_before_input": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "{output} moves before its input: in row {row}, in which {input} first changes, it is already {size:.3g} "
        "standard deviations from its value at rest, about {rows:.2g} rows early|; the input was logged after it "
        "acted, "
        "or one of the two signals is late",
        "{output} moves before its input {input}, by about {rows:.2g} rows",
        "log the input before it acts, shift its rows, or allow a {ask[delay]} down to minus one sampling interval",
        prefix="{run}: ",
    ),
    "looked_like_rest": FindingKind(
        "initial_conditions",
        LEVEL_FACT,
        "{run}: the first values look like rest, but the residuals of a fit from rest show nonzero initial "
        "conditions|, which are estimated with the model",
    ),
    "simulated_from_rest": FindingKind(
        "initial_conditions",
        LEVEL_WITH_CARE,
        "{run} starts at zero and is simulated from rest, but the residuals decay like the response to inputs before "
        "the start|; give the structure of the model {ask[initial is history]} to estimate it",
    ),
    # Data
    "outliers": FindingKind(
        "data",
        LEVEL_FACT,
        "{count} of {total} residuals of {output} {verb} beyond {deviations:g} times the usual deviation, {first}: "
        "{noun}, or events that are not modeled|; they make least squares less precise: {ask[loss is huber]} "
        "reduces their weight",
    ),
    "outliers_dominate": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "{count} of {total} residuals of {output} {verb} beyond {deviations:g} times the usual deviation and "
        "{holds} {power:.0f} % of the sum of squares, {first}: {noun}, or events that are not modeled|; they make "
        "least squares less precise: {ask[loss is huber]} reduces their weight",
    ),
    "quantised": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "{output} is quantized in steps of {step:.3g} in {run}, and its residuals are {noise:.3g}: rounding "
        "errors, which repeat with the signal and are not noise|; intervals do not include them; use a finer "
        "converter or scale",
    ),
    "times_not_honoured": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "{run}: outputs have sample times of their own, but a free delay, or signals behind a sensor filter, "
        "require a regular grid: outputs were interpolated linearly, and the intervals do not include that "
        "error",
    ),
    "friction_unsigned": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "the velocity of {output} never changes its sign in a run: while it slides, friction is a constant "
        "like the offset, and only phases at rest distinguish them|; add a run that moves both ways, or use "
        "{ask[offset is none]}",
    ),
    "stribeck_slow_untold": FindingKind(
        "not_identifiable",
        LEVEL_WITH_CARE,
        "{output} moves at less than {ratio:g} vs = {speed:.3g} per s in {slow} of {total} intervals: fs and "
        "vs are not identifiable, only fc|; add a run that creeps, or leave the Stribeck term out",
    ),
    "stribeck_fast_untold": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "{output} never moves faster than vs = {speed:.3g} per s: fc and fs are not separately "
        "identifiable|; add a run that slides faster, or leave the Stribeck term out",
    ),
    "rig_stopped": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "the rig stopped the run before its end|: {cause}",
        remedy="record it again without the fault",
        prefix="run {run}: ",
    ),
    "data_note": FindingKind("other", LEVEL_NOTE, "{text}", prefix="run {run}: "),
    # Advice on a run
    "twin": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "{other} and {signal} have equal values in every row: one of them is the wrong column",
    ),
    "constant_input": FindingKind(
        "data",
        LEVEL_FACT,
        "input {input} is {level} in all {rows} rows: it excites only one transient at the start; record its "
        "command, or a run in which it changes",
    ),
    "constant_output": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "output {output} is {level} in all {rows} rows: a dead channel, or the wrong column; check the sensor",
    ),
    "channel_off": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "output {output} is exactly {level} from {begin:.4g} s to {end:.4g} s ({rows} rows) and changes from row to "
        "row elsewhere: a channel that was off or was being zeroed|; {after}",
        prefix="run {run}: ",
    ),
    "saturation": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "output {output} stays at its {extreme} value {level} for {rows} rows ({share:.2g} %), cut off while moving: "
        "saturated; the true value is not known there: lower the amplitude or widen the range",
    ),
    "saturation_input": FindingKind(
        "data",
        LEVEL_FACT,
        "input {input} stays at its {extreme} value {level} for {rows} rows ({share:.2g} %), cut off while moving: "
        "saturated; harmless if this is what the machine received, else record the measured input",
    ),
    "spikes": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "output {output} has {count} spike{plural}, first at row {first} ({time:.4g} s), the largest of {height} at "
        "row {worst}: single wrong samples; replace them by the mean of their neighbors",
    ),
    "wrap": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "output {output} jumps by {size}{turn} {times} while moving the other way, first at row {first}: an encoder "
        "that wraps; unwrap it (numpy.unwrap) before loading",
    ),
    "one_sine": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "input {input} is one sine at {omega:.3g} rad/s: persistently exciting of order 2, so it determines "
        "two parameters of an equation; add frequencies (square, PRBS, multisine, chirp), or use this run "
        "for validation",
    ),
    "inputs_collinear": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "inputs {other} and {input} are collinear (correlation {correlation:.4f}): their effects are not "
        "separately identifiable; excite them one after the other, or by different signals",
    ),
    "excitation_short": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "the equation of {output} has {free} free parameters, but {listed} determines {known} in steady "
        "state: the others depend on its transient at the start|; add frequencies to the input, or fix "
        "orders or coefficients",
    ),
    "few_rows": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "the run has {rows} rows: too few for orders and coefficients; record at least {needed}, better thousands",
    ),
    "short": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "output {output} crosses its mean {times} in {duration:.4g} s and is still moving at the end: the run "
        "is shorter than the dominant period; record several times its slowest period",
    ),
    "loop_in_data": FindingKind(
        "closed_loop",
        LEVEL_FACT,
        "input {input} depends on past values of {output} (statistic {ratio:.3g} times its limit) as in a closed "
        "loop, or was measured with noise: equation-error estimates are biased; use the output error, and if "
        "possible a reference that excites the machine well",
    ),
    "loop_not_told": FindingKind(
        "closed_loop",
        LEVEL_FACT,
        "whether input {input} depends on past values of output {output} is undecided: {reason}; if a "
        "controller generated it, name the reference signal with {ask[reference]}",
    ),
    "drift": FindingKind(
        "data",
        LEVEL_WITH_CARE,
        "output {output} drifts by about {slope} over the run ({share:.0f} % of its deviation), which the "
        "inputs do not explain; let the sensor settle, or estimate the trend with the model: {ask[offset is "
        "ramp]}",
        remedy="{ask[offset is ramp]} estimates a linear trend with the model",
    ),
    "starts_off_zero": FindingKind(
        "initial_conditions",
        LEVEL_FACT,
        "output {output} starts at {level}, not at 0: its level or its initial terms will be estimated; some rows at "
        "rest before an input moves show which",
    ),
    "signal_constant": FindingKind(
        "data", LEVEL_FACT, "{signal} is constant ({level:g}): a dead channel, or nothing happened"
    ),
    # Validation
    "validates_itself": FindingKind(
        "repeated_run",
        LEVEL_FACT,
        "its outputs are those of {other}, from which the model was identified, so it does not validate the model",
        prefix="{run}: ",
    ),
    "validates_partly_itself": FindingKind(
        "repeated_run",
        LEVEL_WITH_CARE,
        "{count} of its {rows} rows are those of {other}, from which the model was identified: they do not validate it",
        prefix="{run}: ",
        remedy="validate on rows that were not fitted",
    ),
    "run_of_its_own": FindingKind(
        "repeated_run",
        LEVEL_FACT,
        "it has the name of a run from which the model was identified",
        prefix="{run}: ",
    ),
    "not_validated": _rule(
        "validation",
        LEVEL_WITH_CARE,
        "the model was not validated on another run",
        "{choose[validate]}",
    ),
    "origin_unknown": _rule(
        "validation",
        LEVEL_WITH_CARE,
        "the model file does not say how it was identified",
        "compare it with measured runs",
    ),
    "sentences_alone": _rule(
        "validation",
        LEVEL_WITH_CARE,
        "the model file was written by an earlier version, whose warnings have no levels",
        "identify it again",
    ),
    "earlier_sentence": FindingKind("other", LEVEL_NOTE, "{text}"),
    # Frequency responses
    "response_missed": _rule(
        "poor_fit",
        LEVEL_DO_NOT_USE,
        "the residuals are {rms:.3g} % of {output} from {input} ({run})",
        "add a term, a delay or a free order",
    ),
    "response_grows": _rule(
        "unstable",
        LEVEL_DO_NOT_USE,
        "the simulation grows without bound ({poles})",
        "measure a wider band, bound the coefficient that makes it unstable, or use fewer terms",
    ),
    "response_lost": _rule(
        "validation_loss",
        LEVEL_WITH_CARE,
        "the residuals are {own:.3g} % of the estimation data and {rms:.3g} % of {run}",
        "use fewer free parameters, or both records in one fit",
    ),
    "response_not_validated": _rule(
        "validation",
        LEVEL_WITH_CARE,
        "the model was not validated on another response",
        "{choose[validate response]}",
    ),
    "deviations_exceeded": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "residuals are {ratio:.3g} times the standard deviations of the data (99 %): the model is "
        "incomplete, or the standard deviations are too small|; intervals are widened accordingly",
        "residuals are {ratio:.3g} times the standard deviations of the data (99 %): the model is "
        "incomplete, or the standard deviations are too small",
    ),
    "response_not_white": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "residuals at neighboring frequencies are correlated: the model is incomplete; {remedy}",
        "residuals at neighboring frequencies are correlated: the model is incomplete",
        "add an element or a term, and compare the errors",
    ),
    "response_not_converged": _rule("provisional", LEVEL_WITH_CARE, "the fit has not converged"),
    "response_on_bound": _rule("bound", LEVEL_WITH_CARE, "a parameter is on its bound: {bound}"),
    "response_not_told_apart": FindingKind(
        "not_separable",
        LEVEL_DO_NOT_USE,
        "not separately identifiable from the data: {parameter}; leave a term out, or fix one of them",
        "not separately identifiable from the data: {parameter}",
    ),
    "response_number_vague": FindingKind(
        "imprecise",
        LEVEL_WITH_CARE,
        "poorly identifiable from the data: {parameter} = {value:.4g} ± {error:.2g}; fix it, or leave it out",
        "poorly identifiable from the data: {parameter} = {value:.4g} ± {error:.2g}",
    ),
    # Selection, consistency, design
    "other_optimum": FindingKind(
        "provisional",
        LEVEL_WITH_CARE,
        "automatic initial guesses lead the chosen structure to an optimum that fits {output} better than in the "
        "cross-validation; .best is that optimum",
    ),
    "none_is_the_machine": FindingKind(
        "poor_fit",
        LEVEL_DO_NOT_USE,
        "the best candidate predicts validation data with {fit} %: no candidate describes the machine",
    ),
    "worse_than_mean": FindingKind(
        "validation_loss",
        LEVEL_WITH_CARE,
        "the chosen structure predicts worse than the mean of the validation data on {parts}",
    ),
    "fractional_orders_gain": FindingKind(
        "other",
        LEVEL_FACT,
        "fractional orders improve the prediction significantly ({parameter}): on {parts} of validation data "
        "they gain {gain:.2g} percentage points of fit over {other}, and no part loses",
    ),
    "fractional_orders_gain_nothing": FindingKind(
        "other",
        LEVEL_FACT,
        "fractional orders do not improve the prediction significantly ({parameter}): {gain:.2g} percentage points "
        "of fit over {other}, on {parts} of validation data",
    ),
    "fractional_orders_not_told": FindingKind(
        "other",
        LEVEL_FACT,
        "whether fractional orders improve the prediction ({parameter}) is undecided: {reason}",
    ),
    "not_told_by_part": FindingKind(
        "not_identifiable",
        LEVEL_FACT,
        "{parameter}: not identifiable from some part, so it agrees with every value of the others",
    ),
    "parts_differ_by_delay": _rule(
        "residuals",
        LEVEL_WITH_CARE,
        "{run} differs by a delay: with its inputs {shown} the residuals of the model of {other} are "
        "{after:.3g} % of {output} instead of {before:.3g} %",
        "shift the rows of that run, or give its input a delay",
    ),
    "part_not_converged": FindingKind("provisional", LEVEL_WITH_CARE, "the fit has not converged", prefix="{run}: "),
    "parts_not_white": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "residuals are not white: the structure is incomplete, so parts with different excitation may give "
        "different parameters although the machine has not changed",
    ),
    "prediction_in_doubt": FindingKind(
        "residuals",
        LEVEL_WITH_CARE,
        "the predicted standard errors assume a complete model, but a finding on this one says: {text}",
        "the predicted standard errors assume a complete model, and this one is incomplete",
        "add the missing terms, identify again, and design the input on that model",
    ),
    "designed_for_white_noise": FindingKind(
        "residuals", LEVEL_FACT, "the predictions assume white noise, but a finding on the model says: {text}"
    ),
}


class _Reference:
    """References to parameters in templates: ``{ask[offset]}``, ``{ask[offset is none]}``."""

    def __getitem__(self, key: str) -> str:
        name, _, value = key.partition(" is ")
        return parameter(name, value or None)


class _Choice:
    """Texts in templates that differ between Python and the command line: ``{choose[validate]}``."""

    def __getitem__(self, key: str) -> str:
        return choose_text(*INTERFACE_TEXTS[key])


class _Sentence(string.Formatter):
    """Formatter of templates. A number that was stored as text, such as inf, is inserted unchanged."""

    def format_field(self, value: Any, format_spec: str) -> str:
        return value if isinstance(value, str) else str(format(value, format_spec))


class Finding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Record of one finding about data, a fit or a model.

    Parameters
    ----------
    code
        Code in the catalogue.
    run, output, input, parameter, method
        Subject of the finding, where it applies; several names are joined by commas.
    role
        ``"validation"`` for a run that the model was not identified from.
    numbers
        Numbers and texts that are inserted in its sentence, by name.
    written
        Sentence as stored in the file of a model, for versions that do not know the code.
    """

    code: str
    run: str = ""
    output: str = ""
    input: str = ""
    parameter: str = ""
    method: str = ""
    role: str = ""
    numbers: dict[str, float | int | str] = {}
    written: str = ""

    @property
    def kind(self) -> FindingKind:
        """Entry in the catalogue. A code that this version does not know has the level "with care"."""
        return FINDING_CATALOGUE.get(self.code) or FindingKind("other", LEVEL_WITH_CARE, "{written}", "{written}")

    @property
    def topic(self) -> Topic:
        """Group of the catalogue: findings that share a remedy and stand together in a summary."""
        return FINDING_TOPICS[self.kind.topic]

    @property
    def level(self) -> str:
        """``"do not use"``, ``"with care"``, ``"fact"`` or ``"note"``."""
        return self.kind.level

    @property
    def signal(self) -> str:
        """Output or input that it is about; empty if it concerns the whole run."""
        return self.output or self.input

    @property
    def sentence(self) -> str:
        """Sentence without the name of the run."""
        return self._render(self.kind.template.replace("|", ""))

    @property
    def text(self) -> str:
        """Sentence, with the name of the run if the finding concerns a single run."""
        prefix = "validation run {run}: " if self.role == VALIDATION_ROLE else self.kind.prefix if self.run else ""
        return self._render(prefix) + self.sentence

    @property
    def reason(self) -> str:
        """Sentence in a verdict."""
        kind = self.kind
        return self._render(kind.reason or f"{self.topic.what}: {kind.template.partition('|')[0]}")

    @property
    def remedy(self) -> str:
        """Remedy for the method that was used; empty if the catalogue has none."""
        if self.kind.remedy:
            return self._render(self.kind.remedy)
        topic = self.topic
        if not topic.alternative or self.method == topic.method:
            return self._render(topic.remedy)
        return self._render("; ".join(part for part in (topic.remedy, topic.alternative) if part))

    def _render(self, template: str) -> str:
        words: dict[str, Any] = {n: getattr(self, n) for n in (*SUBJECT_FIELDS, "written", "signal")}
        words |= {**self.numbers, "ask": _Reference(), "choose": _Choice()}
        try:
            if "{remedy}" in template:
                words["remedy"] = self.remedy
            return _Sentence().vformat(template, (), words)
        except (KeyError, ValueError, TypeError):
            # A file may lack a number of the sentence.
            return self.written or self.code

    def to_file(self) -> Finding:
        """Return the finding as it is stored: with its sentence, and numbers that are not finite as text."""
        numbers = {n: _storable(v) for n, v in self.numbers.items()}
        return msgspec.structs.replace(self, numbers=numbers, written=self.text)

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a dictionary for JSON."""
        subject = {n: v for n in (*SUBJECT_FIELDS, "role") if (v := getattr(self, n))}
        numbers = {n: _storable(v) for n, v in self.numbers.items()}
        head = {"code": self.code, "level": self.level}
        return {**head, **subject, "numbers": numbers, "text": self.text, "remedy": self.remedy}

    def __str__(self) -> str:
        return self.text


def _storable(value: float | str) -> float | int | str:
    """Return a value for JSON; a number that is not finite as text."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else str(float(value))
    return value if isinstance(value, str) else int(value)


def make_finding(code: str, **words: Any) -> Finding:
    """Return a finding from its code in the catalogue; subject and numbers are keyword arguments."""
    subject = {n: words.pop(n) for n in SUBJECT_FIELDS if n in words}
    return Finding(code, **subject, numbers=words)


def texts(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return the sentences of findings."""
    return tuple(f.text for f in findings)


def unique(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings without repetitions."""
    kept: list[Finding] = []
    for item in findings:
        if item not in kept:
            kept.append(item)
    return tuple(kept)


@dataclass(frozen=True)
class FindingGroup:
    """Findings of one topic and level.

    Parameters
    ----------
    findings
        The findings, at least one.
    """

    findings: tuple[Finding, ...]

    @property
    def first_finding(self) -> Finding:
        """First finding."""
        return self.findings[0]

    @property
    def count(self) -> str:
        """Number of findings beyond the first, as text; empty for a single finding."""
        more = len(self.findings) - 1
        return f" (and {more} more alike)" if more else ""

    @property
    def remedy(self) -> str:
        """Remedy; empty if the sentence states it."""
        return (
            ""
            if self.first_finding.kind.states_remedy or self.first_finding.topic.remedy == _PLAIN_REMEDY
            else self.first_finding.remedy
        )


def group_findings(findings: Iterable[Finding]) -> tuple[FindingGroup, ...]:
    """Group findings by topic, most serious first; each finding of the topic "other" is a group of its own."""
    order = list(FINDING_TOPICS)
    by: dict[tuple[int, int, int], list[Finding]] = {}
    for place, item in enumerate(unique(findings)):
        alone = place if item.kind.topic == "other" else 0
        by.setdefault((FINDING_LEVELS.index(item.level), order.index(item.kind.topic), alone), []).append(item)
    # A finding with a remedy of its own says more than one with that of its topic.
    return tuple(FindingGroup(tuple(sorted(by[key], key=lambda item: not item.kind.remedy))) for key in sorted(by))


def hidden_findings_text(found: Sequence[FindingGroup]) -> str:
    """Return the number of findings that a summary omits, as text; empty if it omits none."""
    count = sum(len(g.findings) for g in found) - len(found[:MAX_SUMMARY_FINDINGS])
    return f"{count} more warning{'' if count == 1 else 's'}" if count else ""
