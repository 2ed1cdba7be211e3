"""The report of a saved model."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from ftlm.base.output import check_free
from ftlm.data.run import Run
from ftlm.data.several import as_runs
from ftlm.identification.first import title_of, verdict_box
from ftlm.identification.page import first_sections, frequency_section, lead_of, residual_section, tests_on
from ftlm.identification.verdict import saved_verdict
from ftlm.judge.comparison import compare, initial_terms_table, lost_fits
from ftlm.model.model import Model
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, symbol_html


def model_page(
    model: Model, path: str | os.PathLike[str], *, validation: Run | Sequence[Run] | None = None, force: bool = False
) -> Path:
    """Write the report of a saved model: what its file knows of its identification, and validation runs.

    Parameters
    ----------
    model
        From :func:`ftlm.load_model`.
    path, validation, force
        See :func:`identification_page`.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    DataError
        See :func:`identification_page`.
    """
    check_free(path, force=force)
    others = [] if validation is None else as_runs(validation)
    known = model.estimate
    warnings = [] if known is None else list(known.warnings)
    validated = [compare(model, run) for run in others]
    for run, comparison in zip(others, validated, strict=True):
        words = [*comparison.warnings, *run.warnings]
        if known is not None:
            words += lost_fits({n: f for n, f in known.fit.items() if f is not None}, comparison)
            words += ["it has the name of a run that the model was identified from"] * (run.name in known.runs)
        warnings += [f"validation run {run.name}: {w.removeprefix(run.name + ': ')}" for w in words]
    compared = [("validation", comparison) for comparison in validated]
    sections = first_sections(model, warnings, compared, bool(others), None, others)
    if tests := tests_on(model, others):
        sections.append(residual_section(tests, None, compared, model.units))
    sections.append(frequency_section(model, [(r.step, r.duration) for r in others]))
    about: list[list[Cell]] = [["structure", model.structure.name], ["coupling in free runs", model.structure.coupling]]
    if known is not None:
        about += [["estimator", known.method], ["identified from", ", ".join(known.runs)]]
        about += [[Markup("fit of {} there, %").format(symbol_html(n)), f] for n, f in known.fit.items()]
        about += [[n.upper().replace("AICC", "AICc"), v] for n, v in known.information.items()]
    initial = [t for _, c in compared if (t := initial_terms_table(c)) is not None]
    sections.append(Section("Settings", tables=[Table("What the file says", ("setting", "value"), about), *initial]))
    judged = saved_verdict(model, validated)
    return write_page(
        path, title=title_of(model), sections=sections, lead=lead_of(compared), force=force, verdict=verdict_box(judged)
    )
