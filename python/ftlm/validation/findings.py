"""Findings on an estimate: groups of warnings by kind, most serious first, each with a remedy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ftlm.utils.parameters import parameter

#: Maximum number of warning groups in a summary.
MAX_SUMMARY_WARNINGS = 3
#: Severity levels: the model must not be used, must be used with care, or has a note.
LEVEL_DO_NOT_USE, LEVEL_WITH_CARE, LEVEL_FACT = "do not use", "with care", "fact"


@dataclass(frozen=True)
class WarningKind:
    """Kind of warning.

    Parameters
    ----------
    name
        Identifier of one word.
    level
        ``"do not use"``, ``"with care"`` or ``"fact"``.
    what
        Summary of such warnings.
    remedy
        Recommended action, with a placeholder for each parameter in it.
    marks
        Phrases by which its warnings are recognized, those of saved models included.
    references
        Parameters in the remedy, with their values.
    """

    name: str
    level: str
    what: str
    remedy: str
    marks: tuple[str, ...] = ()
    references: tuple[tuple[str, object], ...] = ()

    def format_remedy(self) -> str:
        """Return the remedy for the interface in use."""
        return self.remedy.format(*(parameter(name, value) for name, value in self.references))


#: Kinds, most serious first. A warning has the first kind of which it contains a mark.
WARNING_KINDS = (
    WarningKind(
        "unstable",
        LEVEL_DO_NOT_USE,
        "the free run grows without bound",
        "leave out the term that pushes, bound its coefficient, or, in a closed loop, name what drives it with {}",
        (
            "free run grows without bound",
            "whose free run grows",
            "the free run of this optimum grows",
            "coefficients is unstable",
        ),
        (("reference", None),),
    ),
    WarningKind(
        "range",
        LEVEL_DO_NOT_USE,
        "the free run leaves the range of numbers",
        "take other orders, or fewer terms",
        ("leaves the range of numbers",),
    ),
    WarningKind(
        "unseen",
        LEVEL_DO_NOT_USE,
        "the runs do not tell some numbers apart",
        "leave a term out, fix one of them, or record a richer input",
        ("moved together they change nothing", "standard errors are not finite", "covariance is not finite"),
    ),
    WarningKind(
        "identity",
        LEVEL_DO_NOT_USE,
        "its equation nearly says that an output equals itself",
        "keep own orders well below the highest one",
        ("Do not use these orders",),
    ),
    WarningKind(
        "useless",
        LEVEL_DO_NOT_USE,
        "the free run explains little of an output",
        "add what drives it, a delay or a term; or use {}",
        ("the free run explains little", "the equation error flatters this model"),
        (("method", "output-error"),),
    ),
    WarningKind(
        "lost",
        LEVEL_WITH_CARE,
        "it predicts other runs worse than its own",
        "fewer free numbers, or more runs in one fit",
        ("describes the data it was identified from",),
    ),
    WarningKind(
        "loop",
        LEVEL_WITH_CARE,
        "the runs were made in a closed loop",
        "name what drives the loop with {}, or open it",
        ("a closed loop",),
        (("reference", None),),
    ),
    WarningKind(
        "instrument",
        LEVEL_WITH_CARE,
        "what drives the loop tells little of its input",
        "record a stronger reference",
        ("says little of",),
    ),
    WarningKind(
        "untold",
        LEVEL_WITH_CARE,
        "the runs do not tell a number at all",
        "fix it, leave it out, or record a richer input",
        ("its standard error exceeds its bounds", "nothing tells fs and vs", "do not tell its damping"),
    ),
    WarningKind(
        "residuals",
        LEVEL_WITH_CARE,
        "the model leaves something out",
        "add a term, a delay or a free order; ftlm select compares",
        ("residuals are not white", "are not white: the model", "residuals still follow"),
    ),
    WarningKind(
        "provisional",
        LEVEL_WITH_CARE,
        "the fit is provisional",
        "give {} another result, or fewer free numbers",
        ("ended before it stood still", "it has not found the optimum", "there may be others"),
        (("start", None),),
    ),
    WarningKind(
        "vague",
        LEVEL_WITH_CARE,
        "the runs hardly tell some numbers",
        "fix a number, leave a term out, or record a richer input",
        (
            "cannot be told",
            "is not different from 0",
            "do not bound",
            "what is seen of friction",
            "free numbers, but",
            "too few for orders",
        ),
    ),
    WarningKind(
        "rough",
        LEVEL_WITH_CARE,
        "some intervals are rough",
        "{} finds them",
        ("intervals are rough",),
        (("intervals", "profile"),),
    ),
    WarningKind(
        "step",
        LEVEL_WITH_CARE,
        "the sampling is coarse for this model",
        "sample faster, raise m, or trust its fast poles less",
        (
            "the step still moves",
            "still moves with the step",
            "the discretisation itself is unstable",
            "the step alone moves",
        ),
    ),
    WarningKind(
        "prior",
        LEVEL_WITH_CARE,
        "the prior pulls its coefficients",
        "raise {}, or use {}",
        ("the prior (K0",),
        (("prior_covariance", None), ("method", "least-squares")),
    ),
    WarningKind(
        "law",
        LEVEL_WITH_CARE,
        "it breaks the law of its coefficients",
        "use {}",
        ("coefficient law:",),
        (("method", "output-error"),),
    ),
    WarningKind(
        "edge",
        LEVEL_WITH_CARE,
        "an order or a number is on its bound",
        "widen the bound",
        ("on the edge of its interval", "is on its bound"),
    ),
    WarningKind(
        "offset",
        LEVEL_WITH_CARE,
        "a constant is missing, or hidden",
        "{} or {}",
        ("explains as much with", "an unknown constant"),
        (("offset", "constant"), ("offset", "auto")),
    ),
    WarningKind(
        "history",
        LEVEL_WITH_CARE,
        "what the run did before its start counts",
        "begin the run at rest",
        ("ask for what was before",),
    ),
    WarningKind(
        "samples",
        LEVEL_WITH_CARE,
        "the samples harm the figures",
        "see the warning",
        (
            "times the usual one",
            "is quantised",
            "were read at times of their own",
            "a channel that was off",
            "nothing can be identified",
            "never changes its sign",
            "the rig stopped",
        ),
    ),
    WarningKind(
        "same",
        LEVEL_FACT,
        "a validation run is one of its own",
        "give another run",
        ("it validates nothing", "has the name of a run"),
    ),
)
OTHER_KIND = WarningKind("other", LEVEL_FACT, "to know", "see the warning")


def warning_kind(warning: str) -> WarningKind:
    """Return the kind of a warning by the phrases in it."""
    return next((kind for kind in WARNING_KINDS if any(mark in warning for mark in kind.marks)), OTHER_KIND)


@dataclass(frozen=True)
class WarningGroup:
    """Warnings of one kind.

    Parameters
    ----------
    kind
        Kind, with its remedy.
    warnings
        Full texts.
    """

    kind: WarningKind
    warnings: tuple[str, ...]

    @property
    def count(self) -> str:
        """Number of warnings beyond the first, as text; empty for a single warning."""
        more = len(self.warnings) - 1
        return f" (and {more} more alike)" if more else ""

    @property
    def remedy(self) -> str:
        """Remedy; empty if the warning itself states it."""
        return "" if self.kind.remedy == OTHER_KIND.remedy else self.kind.format_remedy()


def group_warnings(warnings: Iterable[str]) -> tuple[WarningGroup, ...]:
    """Group warnings by kind, most serious first; a warning of no kind is a group of its own."""
    by: dict[str, list[str]] = {}
    for warning in dict.fromkeys(warnings):
        by.setdefault(warning_kind(warning).name, []).append(warning)
    known = [WarningGroup(kind, tuple(by[kind.name])) for kind in WARNING_KINDS if kind.name in by]
    return (*known, *(WarningGroup(OTHER_KIND, (warning,)) for warning in by.get(OTHER_KIND.name, ())))


def hidden_warnings_text(found: Sequence[WarningGroup]) -> str:
    """Text on the number of warnings that a summary omits; empty if it omits none."""
    count = sum(len(c.warnings) for c in found) - len(found[:MAX_SUMMARY_WARNINGS])
    return f"{count} more warning{'' if count == 1 else 's'}" if count else ""
