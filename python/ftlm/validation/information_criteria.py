"""Information criteria of a model: AIC, AICc and BIC."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from ftlm.data.sampling import drop_missing
from ftlm.svg.html_page import Table
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import Cell, Exact, attributes
from ftlm.utils.validation import check_integer
from ftlm.validation.residual_tests import Residuals


@dataclass(frozen=True)
class InformationCriteria:
    """Information criteria of a model: minus twice the log likelihood plus a penalty per parameter; lower is better.

    They compare models of the same runs.

    Parameters
    ----------
    parameter_count
        Number of estimated parameters: orders, coefficients, initial terms, and one noise level per output.
    sample_count
        Number of residuals over all outputs and runs.
    log_likelihood
        Log likelihood of the residuals as white normal noise.
    aic, aicc, bic
        Akaike's criterion, Akaike's criterion corrected for few samples (infinite if there are too few), and Schwarz's
        criterion.
    """

    parameter_count: int
    sample_count: int
    log_likelihood: float
    aic: float
    aicc: float
    bic: float

    def to_dict(self) -> dict[str, float | int | None]:
        """Return the criteria as a dictionary for JSON."""
        return attributes(self, ("parameter_count", "sample_count", "log_likelihood", "aic", "aicc", "bic"))

    def __str__(self) -> str:
        return (
            f"AIC {self.aic:.6g}, AICc {self.aicc:.6g}, BIC {self.bic:.6g} "
            f"({self.parameter_count} parameters, noise levels included, estimated from {self.sample_count} samples)"
        )


@check_arguments
def information_criteria(tests: Residuals, parameter_count: int) -> InformationCriteria:
    """Return AIC, AICc and BIC of a model from its residuals; free orders count like coefficients.

    Parameters
    ----------
    tests
        Result of :func:`ftlm.resid` on the runs that the model was identified from.
    parameter_count
        Number of free orders and free coefficients. The function adds initial terms and noise levels.

    Returns
    -------
    InformationCriteria
        Criteria that are comparable between models of the same outputs on the same runs. Correlated residuals
        exaggerate the differences.

    Raises
    ------
    ModelError
        If the number of parameters is not a nonnegative integer.

    Notes
    -----
    AIC: doi:10.1109/TAC.1974.1100705. AICc: doi:10.1093/biomet/76.2.297. BIC: doi:10.1214/aos/1176344136.
    """
    count = check_integer("parameter_count", parameter_count, 0)
    counts = {name: sum(drop_missing(r).size for r in output.residuals) for name, output in tests.outputs.items()}
    samples = sum(counts.values())
    k = count + tests.initial_terms + len(tests.outputs)
    likelihood = normal_log_likelihood([(counts[name], output.rms) for name, output in tests.outputs.items()])
    return criteria_of_likelihood(likelihood, k, samples)


def normal_log_likelihood(noise: Iterable[tuple[float, float]]) -> float:
    """Return the log likelihood of residuals as white normal noise, from (number, root mean square) of each output."""
    likelihood = 0.0
    for count, rms in noise:
        # A residual of exactly 0 has an infinite likelihood.
        log_variance = 2 * math.log(rms) if 0 < rms < math.inf else math.copysign(math.inf, rms - 1)
        likelihood -= 0.5 * count * (math.log(2 * math.pi) + 1 + log_variance)
    return likelihood


def criteria_of_likelihood(log_likelihood: float, parameters: int, samples: int) -> InformationCriteria:
    """Return AIC, AICc and BIC from a log likelihood, the number of estimated parameters and the number of samples."""
    k = parameters
    aic = 2 * k - 2 * log_likelihood
    degrees_of_freedom = samples - k - 1
    aicc = aic + 2 * k * (k + 1) / degrees_of_freedom if degrees_of_freedom > 0 else math.inf
    return InformationCriteria(k, samples, log_likelihood, aic, aicc, schwarz_criterion(log_likelihood, k, samples))


def schwarz_criterion(log_likelihood: float, parameters: int, samples: float) -> float:
    """Return Schwarz's criterion (BIC) of a log likelihood; doi:10.1214/aos/1176344136."""
    return parameters * math.log(samples) - 2 * log_likelihood


def information_table(information: InformationCriteria) -> Table:
    """Return a table of AIC, AICc, BIC, and the numbers of parameters and samples."""
    criteria = (("AIC", information.aic), ("AICc", information.aicc), ("BIC", information.bic))
    # Only differences matter, so all digits before the decimal point are shown.
    rows: list[list[Cell]] = [[name, Exact(round(value, 1))] for name, value in criteria]
    rows += [["parameters", information.parameter_count], ["samples", information.sample_count]]
    note = (
        "Lower is better, among models of the same outputs on the same runs. The parameters include orders, "
        "coefficients, initial terms and one noise standard deviation for each output."
    )
    return Table("Information criteria", ("criterion", "value"), rows, note=note)
