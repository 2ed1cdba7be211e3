"""What a result depends on: the settings of its estimator, which its JSON holds, in words and as rows of a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from ftlm.paint.text import Cell, Exact, symbol

COORDINATES = {"haar": "Haar coordinates", "time": "order of time"}
INITIAL = {"rest": "none, the records start at rest", "caputo": "Caputo's, estimated for each run"}
NORMS = {"l1": "sum of absolute errors (45)", "l2": "RMSE (46)"}


def settings_in_words(settings: Mapping[str, Any]) -> str:
    """On one line."""
    words = f"M = {settings['m']}"
    if "refinement" in settings:
        words = f"all samples, {settings['refinement']} pulses each, {settings['starts']} starts"
    if "seeds" in settings:
        seeds = ", ".join(map(str, settings["seeds"]))
        words += f", seeds {seeds}, {sum(settings['evaluations'].values())} evaluations in all"
    if "innovation_length" in settings:
        words += f", p = {settings['innovation_length']}, K0 = {settings['prior_covariance']:g}"
        words += f", {settings['rows']} rows"
    if "loss" in settings:
        words += f", loss: {settings['loss']} ({robust_in_words(settings)})"
    words += f", initial terms: {settings['initial']}"
    words += f", offset: {settings['offset']}, one a run" if "offset" in settings else ""
    words += f", offset found by test: {settings['offset_test']}" if "offset_test" in settings else ""
    return words + (
        f", instrument: what of the inputs follows {settings['reference']}" if "reference" in settings else ""
    )


def robust_in_words(settings: Mapping[str, Any]) -> str:
    """What a robust loss did."""
    return (
        f"{settings['lowered']} of {settings['samples']} residuals down-weighted, {settings['outliers']} of them "
        "beyond five deviations"
    )


def settings_rows(settings: Mapping[str, Any], *, searched: bool) -> list[list[Cell]]:
    """As rows of a table; what ranks orders only where they were searched."""
    rows: list[list[Cell]] = [["block pulses a run, M", int(settings["m"])]]
    if "innovation_length" in settings:
        rows += [
            ["innovation length, p", int(settings["innovation_length"])],
            [Markup("prior covariance, K<sub>0</sub>"), Exact(settings["prior_covariance"])],
            ["rows of the recursion", COORDINATES.get(settings["rows"], settings["rows"])],
        ]
    if "refinement" in settings:
        rows += [
            ["pulses a sample interval", int(settings["refinement"])],
            ["automatic starts", int(settings["starts"])],
        ]
        rows += [[f"noise found on {symbol(name)}", float(level)] for name, level in settings["noise"].items()]
    if "loss" in settings:
        rows.append(["loss", f"{settings['loss']}: {robust_in_words(settings)}"])
    rows.append(["initial terms", INITIAL.get(str(settings["initial"]), str(settings["initial"]))])
    if "offset" in settings:
        rows.append(["offset of each equation", f"{settings['offset']}, estimated for each run"])
    if "offset_test" in settings:
        rows.append(["offset found by test", settings["offset_test"]])
    if "reference" in settings:
        rows.append(["reference", f"{settings['reference']}; instrument: what of the inputs follows it"])
    if searched:
        rows.append(["orders ranked by", f"{settings['criterion']}, {NORMS.get(settings['norm'], settings['norm'])}"])
    return rows
