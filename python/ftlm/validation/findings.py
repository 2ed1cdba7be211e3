"""Findings on an estimate: groups of warnings by kind, most serious first, each with a remedy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

#: Maximum number of warning groups in a summary.
SHOWN = 3
#: Severity levels: the model must not be used, must be used with care, or has a note.
BAD, CARE, FACT = "do not use", "with care", "fact"


@dataclass(frozen=True)
class Kind:
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
        Recommended action.
    marks
        Phrases by which its warnings are recognized, those of saved models included.
    """

    name: str
    level: str
    what: str
    remedy: str
    marks: tuple[str, ...] = ()


#: Kinds, most serious first. A warning has the first kind of which it contains a mark.
KINDS = (
    Kind(
        "unstable",
        BAD,
        "the free run grows without bound",
        "leave out the term that pushes, bound its coefficient, or, in a closed loop, name what drives it with "
        "reference=",
        (
            "free run grows without bound",
            "whose free run grows",
            "the free run of this optimum grows",
            "coefficients is unstable",
        ),
    ),
    Kind(
        "range",
        BAD,
        "the free run leaves the range of numbers",
        "take other orders, or fewer terms",
        ("leaves the range of numbers",),
    ),
    Kind(
        "unseen",
        BAD,
        "the runs do not tell some numbers apart",
        "leave a term out, fix one of them, or record a richer input",
        ("moved together they change nothing", "standard errors are not finite", "covariance is not finite"),
    ),
    Kind(
        "identity",
        BAD,
        "its equation nearly says that an output equals itself",
        "keep own orders well below the highest one",
        ("Do not use these orders",),
    ),
    Kind(
        "useless",
        BAD,
        "the free run explains little of an output",
        "add what drives it, a delay or a term; or use method='output-error'",
        ("the free run explains little", "the equation error flatters this model"),
    ),
    Kind(
        "lost",
        CARE,
        "it predicts other runs worse than its own",
        "fewer free numbers, or more runs in one fit",
        ("describes the data it was identified from",),
    ),
    Kind(
        "loop",
        CARE,
        "the runs were made in a closed loop",
        "name what drives the loop with reference=, or open it",
        ("a closed loop",),
    ),
    Kind(
        "instrument",
        CARE,
        "what drives the loop tells little of its input",
        "record a stronger reference",
        ("says little of",),
    ),
    Kind(
        "untold",
        CARE,
        "the runs do not tell a number at all",
        "fix it, leave it out, or record a richer input",
        ("its standard error exceeds its bounds", "nothing tells fs and vs", "do not tell its damping"),
    ),
    Kind(
        "residuals",
        CARE,
        "the model leaves something out",
        "add a term, a delay or a free order; ftlm select compares",
        ("residuals are not white", "are not white: the model", "residuals still follow"),
    ),
    Kind(
        "provisional",
        CARE,
        "the fit is provisional",
        "start=… another result, or fewer free numbers",
        ("ended before it stood still", "it has not found the optimum", "there may be others"),
    ),
    Kind(
        "vague",
        CARE,
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
    Kind(
        "rough",
        CARE,
        "some intervals are rough",
        "intervals='profile' finds them",
        ("intervals are rough",),
    ),
    Kind(
        "step",
        CARE,
        "the sampling is coarse for this model",
        "sample faster, raise m, or trust its fast poles less",
        (
            "the step still moves",
            "still moves with the step",
            "the discretisation itself is unstable",
            "the step alone moves",
        ),
    ),
    Kind(
        "prior",
        CARE,
        "the prior pulls its coefficients",
        "raise prior_covariance, or use method='least-squares'",
        ("the prior (K0",),
    ),
    Kind("law", CARE, "it breaks the law of its coefficients", "use method='output-error'", ("coefficient law:",)),
    Kind(
        "edge",
        CARE,
        "an order or a number is on its bound",
        "widen the bound",
        ("on the edge of its interval", "is on its bound"),
    ),
    Kind(
        "offset",
        CARE,
        "a constant is missing, or hidden",
        "offset='constant' or offset='auto'",
        ("explains as much with", "an unknown constant"),
    ),
    Kind(
        "history",
        CARE,
        "what the run did before its start counts",
        "begin the run at rest",
        ("ask for what was before",),
    ),
    Kind(
        "samples",
        CARE,
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
    Kind(
        "same",
        FACT,
        "a validation run is one of its own",
        "give another run",
        ("it validates nothing", "has the name of a run"),
    ),
)
OTHER = Kind("other", FACT, "to know", "see the warning")


def kind_of(warning: str) -> Kind:
    """Return the kind of a warning by the phrases in it."""
    return next((kind for kind in KINDS if any(mark in warning for mark in kind.marks)), OTHER)


@dataclass(frozen=True)
class Concern:
    """Warnings of one kind.

    Parameters
    ----------
    kind
        Kind, with its remedy.
    warnings
        Full texts.
    """

    kind: Kind
    warnings: tuple[str, ...]

    @property
    def count(self) -> str:
        """Number of warnings beyond the first, as text; empty for a single warning."""
        more = len(self.warnings) - 1
        return f" (and {more} more alike)" if more else ""

    @property
    def remedy(self) -> str:
        """Remedy; empty if the warning itself states it."""
        return "" if self.kind.remedy == OTHER.remedy else self.kind.remedy


def concerns(warnings: Iterable[str]) -> tuple[Concern, ...]:
    """Group warnings by kind, most serious first; a warning of no kind is a group of its own."""
    by: dict[str, list[str]] = {}
    for warning in dict.fromkeys(warnings):
        by.setdefault(kind_of(warning).name, []).append(warning)
    known = [Concern(kind, tuple(by[kind.name])) for kind in KINDS if kind.name in by]
    return (*known, *(Concern(OTHER, (warning,)) for warning in by.get(OTHER.name, ())))


def left_over(found: Sequence[Concern]) -> str:
    """Text on the number of warnings that a summary omits; empty if it omits none."""
    count = sum(len(c.warnings) for c in found) - len(found[:SHOWN])
    return f"{count} more warning{'' if count == 1 else 's'}" if count else ""
