"""Result of a structure selection: ranked candidates, the chosen one, and the reason."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import Validation, Verdict
from ftlm.findings import Finding, texts
from ftlm.model.best_identification import BestIdentification
from ftlm.model.model import Model
from ftlm.model.parameter_estimates import Parameter
from ftlm.structure.structure import Structure
from ftlm.structure_selection.cross_validation import MIN_FIT_PERCENT, Trial
from ftlm.svg.html_page import Section, Table
from ftlm.svg.line_chart import LineChart
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, Exact, attributes, json_value, wrap_text

#: Maximum number of printed rows, and lower limit of printed fits [%].
MAX_PRINTED_ROWS, MIN_PRINTED_FIT_PERCENT = 12, -1000.0
#: Note on an unstable candidate.
UNSTABLE_NOTE = " (grows without bound)"


@dataclass(frozen=True)
class Selection(BestIdentification):
    """Result of a structure selection: validated candidates, the chosen one, and the reason.

    Parameters
    ----------
    trials
        Candidates, best prediction first. Candidates that fail on a part of the validation data that others predict
        follow, then unstable candidates, and then candidates without a fit.
    chosen_index
        Index of the chosen candidate in `trials`.
    best
        Identification of the chosen structure on all runs.
    validation
        Description of the validation as text.
    reason
        Reason for the choice.
    fitted_count
        Total number of fitted candidates, of which only the most promising ones of each step are validated.
    findings
        Findings on the choice, and on separate validation runs.
    validation_comparison
        Comparison of the chosen model with separate validation runs; None if runs or blocks were left out in turn.
    """

    trials: tuple[Trial, ...]
    chosen_index: int
    best: Identification
    validation: str
    reason: str
    fitted_count: int
    findings: tuple[Finding, ...] = field(default=())
    validation_comparison: Validation | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences."""
        return texts(self.findings)

    @property
    def model(self) -> Model:
        """Model of the chosen structure, identified from all runs."""
        return self.best.model

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Parameters of the model by name, with standard errors, intervals and units."""
        return self.best.parameters

    @property
    def orders(self) -> dict[str, float]:
        """Values of the free orders of the model by name."""
        return self.best.orders

    @property
    def coefficients(self) -> dict[str, float]:
        """Values of the coefficients of the model by name."""
        return self.best.coefficients

    @property
    def verdict(self) -> Verdict:
        """Verdict on the model, with separate validation runs if there were any; see also :meth:`validate`."""
        return self.best.verdict if self.validation_comparison is None else self.validation_comparison.verdict

    @property
    def winner(self) -> Trial:
        """Trial of the chosen candidate."""
        return self.trials[self.chosen_index]

    @property
    def structure(self) -> Structure:
        """Structure that was chosen, with the initial conditions of its validation."""
        return self.winner.structure if self.best.task is None else self.best.task.structure

    def tables(self) -> list[Table]:
        """Return a table of the candidates for an HTML page, and one of candidates without a fit if there are any."""
        lowest_bic = min((t.effective_bic for t in self.trials if t.effective_bic is not None), default=0.0)
        rows: list[list[Cell]] = [
            [
                ("chosen: " if trial is self.winner else "") + trial.name + (UNSTABLE_NOTE if trial.unstable else ""),
                trial.parameter_count,
                trial.estimation_fit,
                trial.validation_fit,
                trial.worst_fold,
                None if trial.bic is None else Exact(round(trial.bic, 1)),
                None if trial.effective_bic is None else Exact(round(trial.effective_bic - lowest_bic, 1)),
                ", ".join(trial.insignificant),
            ]
            for trial in self.trials
            if trial.failure is None
        ]
        columns = ("structure", "param.", "estimation", "validation", "worst fold", "all", "effective", "insignificant")
        candidates = Table(
            "Candidates, best prediction first",
            columns,
            rows,
            groups=(("", 2), ("fit %", 3), ("BIC, samples", 2), ("", 1)),
            wrap=True,
            note="Fits are means over runs and outputs; the worst fold is the worst run or block left out. BIC of all "
            "samples is that of the residuals. The choice uses BIC of effective samples, from the autocorrelation of "
            "the best residuals; the table has its excess over the lowest.",
        )
        failed: list[list[Cell]] = [[t.name, t.failure] for t in self.trials if t.failure is not None]
        if not failed:
            return [candidates]
        return [candidates, Table("Candidates without a fit", ("structure", "reason"), failed, wrap=True, stacked=True)]

    def figure(self) -> LineChart:
        """Return a chart of the best fit over the number of parameters."""
        best_by_count: dict[int, Trial] = {}
        for trial in (t for t in self.trials if t.failure is None):
            if trial.parameter_count not in best_by_count or trial.score < best_by_count[trial.parameter_count].score:
                best_by_count[trial.parameter_count] = trial
        counts = sorted(best_by_count)
        estimation, validation_data = (
            [best_by_count[n].estimation_fit for n in counts],
            [max(best_by_count[n].validation_fit, MIN_FIT_PERCENT) for n in counts],
        )
        winner_count = self.winner.parameter_count
        choice = [v if n == winner_count else math.nan for n, v in zip(counts, validation_data, strict=True)]
        return LineChart(
            [float(n) for n in counts],
            [("estimation", estimation), ("validation", validation_data), ("chosen", choice)],
            title="Fit by number of parameters",
            x_label="estimated parameters",
            y_label="fit in %",
            dots=("chosen",),
            caption=f"The best candidate with each number of parameters; the chosen one has {winner_count}.",
        )

    def report(self, path: str | os.PathLike[str], *, validation: Any = None, force: bool = False) -> Path:
        """Write the choice and the model to an HTML file, as :meth:`ftlm.Identification.report` does."""
        counts = f"Validation data: {self.validation}. {self.fitted_count} candidates fitted."
        choice = Section(
            "The choice",
            paragraphs=[self.reason, counts],
            tables=self.tables(),
            # Fits of different outputs are not compared.
            figures=[self.figure()] if len({t.structure.outputs for t in self.trials}) == 1 else [],
        )
        return self.best._write_page(
            path,
            sections=[choice],
            choice_findings=self.findings,
            validation=validation,
            validated=self.validation_comparison,
            force=force,
        )

    def to_frame(self) -> Any:
        """Return the candidates as a pandas DataFrame, one row per candidate, by rank."""
        rows = [
            {
                "rank": k + 1,
                "structure": t.name,
                "parameter_count": t.parameter_count,
                "estimation_fit": t.estimation_fit,
                "validation_fit": t.validation_fit,
                "worst_fold": t.worst_fold,
                "score": t.score,
                "bic": math.nan if t.bic is None else t.bic,
                "chosen": k == self.chosen_index,
                "failure": t.failure or "",
            }
            for k, t in enumerate(self.trials)
        ]
        return to_frame(rows, ["rank"])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        return {**self.ranking_dict(), "identification": self.best.to_dict()}

    def ranking_dict(self) -> dict[str, Any]:
        """Return the candidates and the choice as a dictionary for JSON, without the identification."""
        return {
            "chosen": self.winner.name,
            **attributes(self, ("reason", "validation", "fitted_count")),
            "candidates": [
                {
                    "structure": t.name,
                    **attributes(t, ("parameter_count", "estimation", "validation", "score", "bic", "values")),
                    "standard_errors": json_value(t.standard_errors),
                    **attributes(t, ("insignificant", "unstable", "failure")),
                }
                for t in self.trials
            ],
            **attributes(self, ("findings", "warnings")),
        }

    def __str__(self) -> str:
        return f"{self.best.summary(self.validation_comparison)}\n\n{self.ranking_text()}"

    def ranking_text(self) -> str:
        """Return the table of the candidates and the reason for the choice, as text."""
        lines = [f"{len(self.trials)} of {self.fitted_count} fitted candidates validated: {self.validation}"]
        lines.append(f"{'':2}{'valid. %':>9}{'worst %':>9}{'estim. %':>10}{'param.':>9}  structure")
        for index, trial in enumerate(self.trials[:MAX_PRINTED_ROWS]):
            prefix = "> " if index == self.chosen_index else "  "
            lines += _row_lines(prefix, trial)
        if self.chosen_index >= MAX_PRINTED_ROWS:
            lines += _row_lines("> ", self.winner)
        if len(self.trials) > MAX_PRINTED_ROWS:
            lines.append(f"  … and {len(self.trials) - MAX_PRINTED_ROWS} more")
        return "\n".join([*lines, self.reason, *(f"warning: {w}" for w in self.warnings)])


def _row_lines(prefix: str, trial: Trial) -> list[str]:
    """Return the text lines of a candidate in the ranking: its fits, and its structure in as many lines as it takes."""
    fits = trial.validation_fit, trial.worst_fold, trial.estimation_fit
    validation, worst_fold, estimation = ("-" if trial.failure is not None else format_fit(fit) for fit in fits)
    row_start = f"{prefix}{validation:>9}{worst_fold:>9}{estimation:>10}{trial.parameter_count:>9}  "
    lines = wrap_text(trial.name + (UNSTABLE_NOTE if trial.unstable else ""), row_start, " " * len(row_start))
    return lines if trial.failure is None else lines + wrap_text(trial.failure, " " * len(row_start))


def format_fit(fit: float) -> str:
    """Return a fit in percent as text; values below a minimum are shown as the minimum."""
    return f"{fit:.2f}" if not fit < MIN_PRINTED_FIT_PERCENT else f"< {MIN_PRINTED_FIT_PERCENT:.0f}"
