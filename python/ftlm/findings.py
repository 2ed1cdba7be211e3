"""Findings about data, fits and models: their records, and the catalogue of their sentences."""

from __future__ import annotations

import math
import string
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
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
    has_rule
        Whether rules of the verdict cover it, so that its findings alone are no reasons: a test of whiteness may fail
        by rounding alone, and a parameter may be uncertain, but not by much.
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
        Template of the reason in a verdict; ``{sentence}`` for the sentence, empty for topic and first clause.
    remedy
        Template of the remedy; empty for that of the topic.
    prefix
        Template of the beginning that names the run; a page about that run omits it.
    names_missing_part
        Whether it names what a model lacks, and is reported before the residuals that show it.
    judges_whole_run
        Whether it is about the simulation of a whole run, which an unstable plant does not allow.
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
        """Whether the sentence itself states the remedy."""
        return "remedy" in {name for _, name, _, _ in string.Formatter().parse(self.template)}


class Catalogue(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Topics and kinds of findings as their file has them.

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
    """Return the catalogue, which is read from its file at the first call."""
    return msgspec.toml.decode(resources.files("ftlm").joinpath("findings.toml").read_bytes(), type=Catalogue)


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
        return finding_catalogue().kinds.get(self.code) or FindingKind(
            "other", LEVEL_WITH_CARE, "{written}", "{written}"
        )

    @property
    def topic(self) -> Topic:
        """Group of the catalogue: findings that share a remedy and stand together in a summary."""
        return finding_catalogue().topics[self.kind.topic]

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
        if kind.reason == SAME_REASON:
            return self.sentence
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
    selection: list[Finding] = []
    for item in findings:
        if item not in selection:
            selection.append(item)
    return tuple(selection)


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
    order = list(finding_catalogue().topics)
    by: dict[tuple[int, int, int], list[Finding]] = {}
    for place, item in enumerate(unique(findings)):
        alone = place if item.kind.topic == "other" else 0
        by.setdefault((FINDING_LEVELS.index(item.level), order.index(item.kind.topic), alone), []).append(item)
    # A finding with a remedy of its own says more than one with that of its topic.
    return tuple(FindingGroup(tuple(sorted(by[key], key=lambda item: not item.kind.remedy))) for key in sorted(by))


def hidden_findings_text(groups: Sequence[FindingGroup]) -> str:
    """Return the number of findings that a summary omits, as text; empty if it omits none."""
    count = sum(len(g.findings) for g in groups) - len(groups[:MAX_SUMMARY_FINDINGS])
    return f"{count} more warning{'' if count == 1 else 's'}" if count else ""
