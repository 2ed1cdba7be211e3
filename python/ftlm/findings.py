"""Findings about data, fits and models, and the catalogue of their texts (file findings.toml)."""

from __future__ import annotations

import math
import string
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import msgspec

from ftlm.errors import ModelError
from ftlm.utils.parameters import TYPED_INTERFACES, choose_text, current_interface, parameter
from ftlm.utils.validation import short_repr

#: Severity levels. The model must not be used; it must be used with care; it has a noteworthy property; or there is a
#: note on how the data were read.
LEVEL_DO_NOT_USE, LEVEL_WITH_CARE, LEVEL_FACT, LEVEL_NOTE = "do not use", "with care", "fact", "note"
FINDING_LEVELS = (LEVEL_DO_NOT_USE, LEVEL_WITH_CARE, LEVEL_FACT, LEVEL_NOTE)
#: Maximum number of finding groups in a summary.
MAX_SUMMARY_FINDINGS = 3
#: Codes of findings that residuals are not white.
NOT_WHITE_CODES = ("residuals_not_white", "output_not_white", "noise_coloured", "response_not_white")
#: Codes of findings that residuals indicate a missing part of the model.
MISSING_PART_CODES = (
    "residuals_follow_input",
    "coupling_missing",
    "residuals_follow_direction",
    "residuals_not_white",
    "output_not_white",
)
#: Fields of a finding that name its subject.
SUBJECT_FIELDS = ("run", "output", "input", "parameter", "method")
#: Value of `Finding.role` for findings on validation runs.
VALIDATION_ROLE = "validation"


@dataclass(frozen=True)
class Topic:
    """Topic of findings that have the same remedy; a summary merges findings of one topic.

    Parameters
    ----------
    statement
        Common statement of the findings of this topic.
    remedy
        Template of the recommended action.
    alternative, method
        Template of an alternative action with another estimation method, and the name of that method. The action is
        omitted if the finding is about a fit by that method.
    has_rule
        Whether special rules of the verdict decide if a finding of this topic lowers the verdict. An example is a
        whiteness test that fails because of rounding only.
    """

    statement: str
    remedy: str = ""
    alternative: str = ""
    method: str = ""
    has_rule: bool = False


#: (text for Python, text for the command line, text for a page) by name, for templates.
INTERFACE_TEXTS = {
    "select": ("select(runs, structures)", "ftlm select", "a structure selection"),
    "validate": ("validate(run)", "--validation FILE", "validate the model on another run"),
    "validate response": (
        "validate(load_frequency(file))",
        "--validation FILE",
        "validate the model on another measured response",
    ),
}
#: Value of `FindingKind.reason` if the whole sentence of the finding is the reason of the verdict.
SAME_REASON = "{sentence}"
#: Remedy of topics that is not shown, because it adds nothing to the sentence of the finding.
_PLAIN_REMEDY = "see the warning"


@dataclass(frozen=True)
class FindingKind:
    """Entry of the catalogue for one finding code: topic, level and templates of the texts.

    Parameters
    ----------
    topic
        Name of the topic.
    level
        ``"do not use"``, ``"with care"``, ``"fact"`` or ``"note"``.
    template
        Template of the sentence without the prefix. The character ``|`` marks the end of the first clause, and
        ``{remedy}`` is replaced by the remedy.
    reason
        Template of the reason in a verdict; ``"{sentence}"`` selects the whole sentence. If it is empty, the reason
        is the statement of the topic, followed by the first clause.
    remedy
        Template of the remedy; if it is empty, the remedy of the topic applies.
    prefix
        Template of the beginning of the sentence, which names the run. It is omitted if the finding names no run.
    names_missing_part
        Whether the finding names a missing part of the model. Such a finding precedes findings on residuals.
    simulates_whole_run
        Whether the finding is based on the simulation of a whole run, which diverges for an unstable plant.
    """

    topic: str
    level: str
    template: str
    reason: str = ""
    remedy: str = ""
    prefix: str = ""
    names_missing_part: bool = False
    simulates_whole_run: bool = False

    @property
    def states_remedy(self) -> bool:
        """Whether the sentence itself contains the remedy."""
        return "remedy" in {name for _, name, _, _ in string.Formatter().parse(self.template)}


class Catalogue(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Catalogue of findings: topics and kinds, as read from the catalogue file.

    Parameters
    ----------
    topics
        Topics by name. Within a level, findings are shown in the sequence of their topics.
    kinds
        Entries by finding code.
    """

    topics: dict[str, Topic]
    kinds: dict[str, FindingKind]


@cache
def finding_catalogue() -> Catalogue:
    """Return the catalogue of findings; the file findings.toml is read once, when this module is imported."""
    return msgspec.toml.decode(resources.files("ftlm").joinpath("findings.toml").read_bytes(), type=Catalogue)


# msgspec inspects a class without a lock: first calls on two threads at once can crash the interpreter. The lock of the
# import admits one thread.
finding_catalogue()


class _ParameterText:
    """Object ``option`` in templates, which replaces ``{option[offset]}`` and ``{option[offset is none]}`` by text.

    The text is that of :func:`ftlm.utils.parameters.parameter`.
    """

    def __getitem__(self, key: str) -> str:
        name, _, value = key.partition(" is ")
        return parameter(name, value or None)


class _InterfaceText:
    """Object ``choose`` in templates, which replaces ``{choose[validate]}`` by text for the interface."""

    def __getitem__(self, key: str) -> str:
        return choose_text(*INTERFACE_TEXTS[key])


class _SentenceFormatter(string.Formatter):
    """Formatter of templates that inserts text such as "inf" unchanged, even where the template formats a number."""

    def format_field(self, value: Any, format_spec: str) -> str:
        return value if isinstance(value, str) else str(format(value, format_spec))


class Finding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Finding about data, a fit or a model: a code, its subjects, and the values in its sentence.

    Parameters
    ----------
    code
        Code of the finding, a key of the catalogue.
    run, output, input, parameter, method
        Names of the subjects of the finding; empty if not applicable. Several names are joined by commas.
    role
        ``"validation"`` if the run is a validation run, otherwise empty.
    numbers
        Numbers and texts that are inserted into the sentence, by name.

    Raises
    ------
    ModelError
        If `code` is not in the catalogue.
    """

    code: str
    run: str = ""
    output: str = ""
    input: str = ""
    parameter: str = ""
    method: str = ""
    role: str = ""
    numbers: dict[str, float | int | str] = {}

    def __post_init__(self) -> None:
        if self.code not in finding_catalogue().kinds:
            raise ModelError(
                f"{short_repr(self.code)} is not a code of the catalogue of findings; give one of its codes"
            )

    @property
    def kind(self) -> FindingKind:
        """Entry of the catalogue for the code."""
        return finding_catalogue().kinds[self.code]

    @property
    def topic(self) -> Topic:
        """Topic of the finding, from the catalogue."""
        return finding_catalogue().topics[self.kind.topic]

    @property
    def level(self) -> str:
        """Severity level: ``"do not use"``, ``"with care"``, ``"fact"`` or ``"note"``."""
        return self.kind.level

    @property
    def signal(self) -> str:
        """Name of the output that the finding is about, or else of the input; empty without either."""
        return self.output or self.input

    @property
    def sentence(self) -> str:
        """Sentence of the finding without the prefix that names the run."""
        return self._render(self.kind.template.replace("|", ""))

    @property
    def text(self) -> str:
        """Sentence of the finding, with a prefix that names the run if the finding is about a run."""
        prefix = "validation run {run}: " if self.role == VALIDATION_ROLE else self.kind.prefix if self.run else ""
        return self._render(prefix) + self.sentence

    @property
    def reason(self) -> str:
        """Text of the finding as the reason of a verdict."""
        kind = self.kind
        if kind.reason == SAME_REASON:
            return self.sentence
        return self._render(kind.reason or f"{self.topic.statement}: {kind.template.partition('|')[0]}")

    @property
    def remedy(self) -> str:
        """Remedy for the method of the fit, as text; empty if the catalogue has none."""
        if self.kind.remedy:
            return self._render(self.kind.remedy)
        topic = self.topic
        if not topic.alternative or self.method == topic.method:
            return self._render(topic.remedy)
        return self._render("; ".join(part for part in (topic.remedy, topic.alternative) if part))

    def _render(self, template: str) -> str:
        fields: dict[str, Any] = {n: getattr(self, n) for n in (*SUBJECT_FIELDS, "signal")}
        # An option in the words of the one who loaded the run means nothing to the reader of a page.
        override = self.numbers.get("override", "") if current_interface() in TYPED_INTERFACES else ""
        override = f"; otherwise {override}" if override else ""
        fields |= {**self.numbers, "override": override, "option": _ParameterText(), "choose": _InterfaceText()}
        try:
            if "{remedy}" in template:
                fields["remedy"] = self.remedy
            return _SentenceFormatter().vformat(template, (), fields)
        except (KeyError, ValueError, TypeError):
            # A finding from a file may lack a number of the sentence.
            return self.code

    def to_file(self) -> Finding:
        """Return a copy of the finding for a file, with nonfinite numbers as text."""
        return msgspec.structs.replace(self, numbers={n: _storable(v) for n, v in self.numbers.items()})

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a dictionary for JSON, with its level, text and remedy."""
        subject = {n: v for n in (*SUBJECT_FIELDS, "role") if (v := getattr(self, n))}
        numbers = {n: _storable(v) for n, v in self.numbers.items()}
        head = {"code": self.code, "level": self.level}
        return {**head, **subject, "numbers": numbers, "text": self.text, "remedy": self.remedy}

    def __str__(self) -> str:
        return self.text


def _storable(value: float | str) -> float | int | str:
    """Return a Python value that JSON can represent: a finite number, an integer, or text for a nonfinite number."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else str(float(value))
    return value if isinstance(value, str) else int(value)


def make_finding(code: str, **fields: Any) -> Finding:
    """Return the finding with the given code; keyword arguments are its subjects and numbers by name.

    Raise ModelError if the code is not in the catalogue.
    """
    subject = {n: fields.pop(n) for n in SUBJECT_FIELDS if n in fields}
    return Finding(code, **subject, numbers=fields)


def texts(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return the sentence of every finding, with the name of its run."""
    return tuple(f.text for f in findings)


def mark_validation(findings: Iterable[Finding], run: str) -> list[Finding]:
    """Return copies of findings, marked as coming from the validation run with the name `run`."""
    return [msgspec.structs.replace(f, run=f.run or run, role=VALIDATION_ROLE) for f in findings]


def unique_findings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings in their sequence, without repetitions."""
    selection: list[Finding] = []
    for item in findings:
        if item not in selection:
            selection.append(item)
    return tuple(selection)


@dataclass(frozen=True)
class FindingGroup:
    """Group of findings with the same topic and level.

    Parameters
    ----------
    findings
        Findings of the group, at least one.
    """

    findings: tuple[Finding, ...]

    @property
    def first_finding(self) -> Finding:
        """First finding of the group, whose sentence a summary shows."""
        return self.findings[0]

    @property
    def count(self) -> str:
        """Text such as " (and 2 more alike)" on the findings after the first; empty for a single finding."""
        count = len(self.findings) - 1
        return f" (and {count} more alike)" if count else ""

    @property
    def remedy(self) -> str:
        """Remedy of the first finding; empty if its sentence contains the remedy, or the topic has none of its own."""
        return (
            ""
            if self.first_finding.kind.states_remedy or self.first_finding.topic.remedy == _PLAIN_REMEDY
            else self.first_finding.remedy
        )


def group_findings(findings: Iterable[Finding]) -> tuple[FindingGroup, ...]:
    """Return findings grouped by level and topic, most serious first.

    Each finding of the topic "other" forms its own group.
    """
    order = list(finding_catalogue().topics)
    groups: dict[tuple[int, int, int], list[Finding]] = {}
    for index, item in enumerate(unique_findings(findings)):
        singleton = index if item.kind.topic == "other" else 0
        groups.setdefault((FINDING_LEVELS.index(item.level), order.index(item.kind.topic), singleton), []).append(item)
    # Within a group, findings with their own remedy precede those with the remedy of their topic.
    return tuple(
        FindingGroup(tuple(sorted(g, key=lambda item: not item.kind.remedy))) for _, g in sorted(groups.items())
    )


def hidden_findings_text(groups: Sequence[FindingGroup]) -> str:
    """Return text such as "2 more warnings" on the findings that a summary of groups omits; empty if it omits none.

    A summary shows the first finding of at most `MAX_SUMMARY_FINDINGS` groups.
    """
    count = sum(len(g.findings) for g in groups) - len(groups[:MAX_SUMMARY_FINDINGS])
    return f"{count} more warning{'' if count == 1 else 's'}" if count else ""
