"""Verdicts that follow from many cases by one rule: several arms, several records of each, both ends of a setting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Word = Literal["holds", "does not hold", "turns with", "cannot be told from a simulated truth", "cannot be told"]
#: The factor that is chosen where an arm is simulated: a verdict that it alone decides says what was put in.
TRUTH = "the arm"


@dataclass(frozen=True)
class Case:
    """One case of a claim.

    Parameters
    ----------
    factors
        What it was computed with: (name, level), such as ("K0", "1"). The names are the same in all cases of a claim.
    holds
        Whether the claim holds there.
    """

    factors: tuple[tuple[str, str], ...]
    holds: bool


@dataclass(frozen=True)
class Ruling:
    """What a claim comes to.

    Parameters
    ----------
    word
        The verdict.
    factors
        What it turns with, the factor that decides most of it first.
    cases, held
        How many there were, and in how many of them the claim holds.
    levels
        (level, cases, held) of the first of these factors.
    """

    word: Word
    factors: tuple[str, ...] = ()
    cases: int = 0
    held: int = 0
    levels: tuple[tuple[str, int, int], ...] = ()

    def __str__(self) -> str:
        return f"turns with {_listed(self.factors)}" if self.word == "turns with" else self.word


def case(holds: bool, **factors: str) -> Case:
    """A case from factors by keyword; an underscore stands for a space."""
    return Case(tuple((name.replace("_", " "), level) for name, level in factors.items()), holds)


def ruled(cases: Sequence[Case], *, of_the_machine: bool = False) -> Ruling:
    """Return the verdict of all cases together.

    A claim holds where every case does, and does not where none does. Where they differ it turns with those factors
    that change the outcome while every other one stays.

    Parameters
    ----------
    cases
        At least one, or nothing can be told.
    of_the_machine
        Whether the claim is one of the machine, not of a method, and the machine was simulated: where it turns with the
        arm, or there is one arm alone, the answer is what was put into it.
    """
    held = sum(case.holds for case in cases)
    counts = len(cases), held
    if not cases:
        return Ruling("cannot be told")
    if of_the_machine and len({dict(case.factors).get(TRUTH) for case in cases}) < 2:
        return Ruling("cannot be told from a simulated truth", (TRUTH,), *counts)
    if held in (0, len(cases)):
        return Ruling("holds" if held else "does not hold", (), *counts)
    names = [name for name, _ in cases[0].factors]
    flips = {name: _flips(cases, name) for name in names}
    turning = sorted((n for n in names if flips[n]), key=lambda n: -flips[n])
    if of_the_machine and TRUTH in turning:
        return Ruling("cannot be told from a simulated truth", (TRUTH,), *counts, _levels(cases, TRUTH))
    # One factor that decides every outcome says all.
    factors = next(([n] for n in names if _decides(cases, n)), turning or names)
    return Ruling("turns with", tuple(factors), *counts, _levels(cases, factors[0]))


def _levels(cases: Sequence[Case], name: str) -> tuple[tuple[str, int, int], ...]:
    """Every level of a factor with its cases and in how many of them the claim holds."""
    outcomes: dict[str, list[bool]] = {}
    for item in cases:
        outcomes.setdefault(dict(item.factors)[name], []).append(item.holds)
    return tuple((level, len(each), sum(each)) for level, each in outcomes.items())


def _flips(cases: Sequence[Case], name: str) -> int:
    """Pairs of cases that differ in one factor alone, and in the outcome."""
    groups: dict[tuple[tuple[str, str], ...], list[Case]] = {}
    for case in cases:
        rest = tuple(pair for pair in case.factors if pair[0] != name)
        groups.setdefault(rest, []).append(case)
    return sum(sum(c.holds for c in g) * sum(not c.holds for c in g) for g in groups.values())


def _decides(cases: Sequence[Case], name: str) -> bool:
    """Whether every level of a factor has one outcome."""
    levels: dict[str, set[bool]] = {}
    for case in cases:
        levels.setdefault(dict(case.factors)[name], set()).add(case.holds)
    return all(len(outcomes) == 1 for outcomes in levels.values())


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
