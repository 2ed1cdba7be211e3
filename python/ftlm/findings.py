"""Findings about data, fits and models, and the catalogue of their messages."""

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
from ftlm.utils.parameters import choose_text, parameter
from ftlm.utils.validation import short_repr

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
    """Topic that groups findings with the same remedy; a summary shows them together.

    Parameters
    ----------
    what
        Summary of the findings of this topic.
    remedy
        Template of the recommended action.
    alternative, method
        Template of an action that uses another method, and the name of that method. The action is omitted if the
        finding is about a fit by that method.
    has_rule
        Whether rules of the verdict decide when findings of this topic are reasons. A whiteness test may fail only
        because of rounding, for example.
    """

    what: str
    remedy: str = ""
    alternative: str = ""
    method: str = ""
    has_rule: bool = False


#: Texts of Python and of the command line by name, for templates.
INTERFACE_TEXTS = {
    "validate": ("validate(run)", "--validation FILE"),
    "validate response": ("validate(load_frequency(file))", "--validation FILE"),
}
#: Reason of a kind whose sentence is the reason of a verdict.
SAME_REASON = "{sentence}"
#: Remedies that say no more than the finding itself.
_PLAIN_REMEDY = "see the warning"


@dataclass(frozen=True)
class FindingKind:
    """Entry of the catalogue for one code: topic, level and templates of the sentences.

    Parameters
    ----------
    topic
        Name of its topic.
    level
        ``"do not use"``, ``"with care"``, ``"fact"`` or ``"note"``.
    template
        Template of the sentence after the prefix. A bar marks the end of its first clause, and ``{remedy}`` is replaced
        by the remedy.
    reason
        Template of the reason in a verdict, in which ``{sentence}`` is the sentence. If it is empty, the reason
        consists of topic and first clause.
    remedy
        Template of the remedy; empty for that of the topic.
    prefix
        Template of the beginning of the sentence, which names the run. It is omitted on a page about that run.
    names_missing_part
        Whether the finding names a missing part of the model. It is reported before findings on residuals.
    judges_whole_run
        Whether the finding is about the simulation of a whole run, which diverges for an unstable plant.
    """

    topic: str
    level: str
    template: str
    reason: str = ""
    remedy: str = ""
    prefix: str = ""
    names_missing_part: bool = False
    judges_whole_run: bool = False

    @property
    def states_remedy(self) -> bool:
        """Whether the sentence itself contains the remedy."""
        return "remedy" in {name for _, name, _, _ in string.Formatter().parse(self.template)}


class Catalogue(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Topics and kinds of findings, as read from the catalogue file.

    Parameters
    ----------
    topics
        Topics by name, most serious first within a level.
    kinds
        Kinds by code.
    """

    topics: dict[str, Topic]
    kinds: dict[str, FindingKind]


@cache
def finding_catalogue() -> Catalogue:
    """Return the catalogue of findings, which is read from its file at the first call."""
    return msgspec.toml.decode(resources.files("ftlm").joinpath("findings.toml").read_bytes(), type=Catalogue)


class _Reference:
    """Formatter of references to parameters in templates, such as ``{ask[offset]}`` or ``{ask[offset is none]}``."""

    def __getitem__(self, key: str) -> str:
        name, _, value = key.partition(" is ")
        return parameter(name, value or None)


class _Choice:
    """Formatter of texts in templates that differ between Python and command line, such as ``{choose[validate]}``."""

    def __getitem__(self, key: str) -> str:
        return choose_text(*INTERFACE_TEXTS[key])


class _Sentence(string.Formatter):
    """Formatter of templates, which inserts numbers that were stored as text (such as inf) unchanged."""

    def format_field(self, value: Any, format_spec: str) -> str:
        return value if isinstance(value, str) else str(format(value, format_spec))


class Finding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Finding about data, a fit or a model: a code with the subjects and numbers of its sentence.

    Parameters
    ----------
    code
        Code of the finding in the catalogue.
    run, output, input, parameter, method
        Names that the finding is about, empty if not applicable; several names are joined by commas.
    role
        ``"validation"`` for a run that the model was not identified from.
    numbers
        Numbers and texts by name, which are inserted into the sentence.

    Raises
    ------
    ModelError
        If the catalogue has no such code.
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
        """Entry of the code in the catalogue."""
        return finding_catalogue().kinds[self.code]

    @property
    def topic(self) -> Topic:
        """Topic of the finding, which groups findings with the same remedy."""
        return finding_catalogue().topics[self.kind.topic]

    @property
    def level(self) -> str:
        """Level: ``"do not use"``, ``"with care"``, ``"fact"`` or ``"note"``."""
        return self.kind.level

    @property
    def signal(self) -> str:
        """Name of the output or input that the finding is about; empty if it is about the whole run."""
        return self.output or self.input

    @property
    def sentence(self) -> str:
        """Sentence of the finding, without the name of the run."""
        return self._render(self.kind.template.replace("|", ""))

    @property
    def text(self) -> str:
        """Sentence of the finding, with the name of the run if it is about a single run."""
        prefix = "validation run {run}: " if self.role == VALIDATION_ROLE else self.kind.prefix if self.run else ""
        return self._render(prefix) + self.sentence

    @property
    def reason(self) -> str:
        """Sentence of the finding as a reason of a verdict."""
        kind = self.kind
        if kind.reason == SAME_REASON:
            return self.sentence
        return self._render(kind.reason or f"{self.topic.what}: {kind.template.partition('|')[0]}")

    @property
    def remedy(self) -> str:
        """Remedy that suits the method of the fit; empty if the catalogue has none."""
        if self.kind.remedy:
            return self._render(self.kind.remedy)
        topic = self.topic
        if not topic.alternative or self.method == topic.method:
            return self._render(topic.remedy)
        return self._render("; ".join(part for part in (topic.remedy, topic.alternative) if part))

    def _render(self, template: str) -> str:
        words: dict[str, Any] = {n: getattr(self, n) for n in (*SUBJECT_FIELDS, "signal")}
        words |= {**self.numbers, "ask": _Reference(), "choose": _Choice()}
        try:
            if "{remedy}" in template:
                words["remedy"] = self.remedy
            return _Sentence().vformat(template, (), words)
        except (KeyError, ValueError, TypeError):
            # A file may lack a number of the sentence.
            return self.code

    def to_file(self) -> Finding:
        """Return the finding as a file stores it, with nonfinite numbers as text."""
        return msgspec.structs.replace(self, numbers={n: _storable(v) for n, v in self.numbers.items()})

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a dictionary for JSON."""
        subject = {n: v for n in (*SUBJECT_FIELDS, "role") if (v := getattr(self, n))}
        numbers = {n: _storable(v) for n, v in self.numbers.items()}
        head = {"code": self.code, "level": self.level}
        return {**head, **subject, "numbers": numbers, "text": self.text, "remedy": self.remedy}

    def __str__(self) -> str:
        return self.text


def _storable(value: float | str) -> float | int | str:
    """Return a value for JSON; a nonfinite number is returned as text."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else str(float(value))
    return value if isinstance(value, str) else int(value)


def make_finding(code: str, **words: Any) -> Finding:
    """Return a finding with a code of the catalogue; keyword arguments give its subjects and numbers."""
    subject = {n: words.pop(n) for n in SUBJECT_FIELDS if n in words}
    return Finding(code, **subject, numbers=words)


def texts(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return the sentences of findings."""
    return tuple(f.text for f in findings)


def unique(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings without repetitions."""
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
        """First finding of the group."""
        return self.findings[0]

    @property
    def count(self) -> str:
        """Text on the number of findings after the first; empty for a single finding."""
        more = len(self.findings) - 1
        return f" (and {more} more alike)" if more else ""

    @property
    def remedy(self) -> str:
        """Remedy of the group; empty if the sentence contains it."""
        return (
            ""
            if self.first_finding.kind.states_remedy or self.first_finding.topic.remedy == _PLAIN_REMEDY
            else self.first_finding.remedy
        )


def group_findings(findings: Iterable[Finding]) -> tuple[FindingGroup, ...]:
    """Return findings grouped by topic, most serious first; each finding of the topic "other" forms a group."""
    order = list(finding_catalogue().topics)
    by: dict[tuple[int, int, int], list[Finding]] = {}
    for place, item in enumerate(unique(findings)):
        alone = place if item.kind.topic == "other" else 0
        by.setdefault((FINDING_LEVELS.index(item.level), order.index(item.kind.topic), alone), []).append(item)
    # Findings with a specific remedy precede those with the remedy of their topic.
    return tuple(FindingGroup(tuple(sorted(by[key], key=lambda item: not item.kind.remedy))) for key in sorted(by))


def hidden_findings_text(groups: Sequence[FindingGroup]) -> str:
    """Return text on the number of findings that a summary omits; empty if it omits none."""
    count = sum(len(g.findings) for g in groups) - len(groups[:MAX_SUMMARY_FINDINGS])
    return f"{count} more warning{'' if count == 1 else 's'}" if count else ""
