"""Best-subset search over input terms in closed form, against SciPy's responses and against joint fits."""

import math

import numpy as np
import pytest
from scipy import signal

import ftlm
from ftlm.structure_selection import best_subset
from ftlm.structure_selection.best_subset import (
    MAX_EXHAUSTIVE_SUBSETS,
    BaseModel,
    Column,
    SubsetScorer,
    base_models,
    score_subsets,
    screen_subsets,
)
from ftlm.structure_selection.candidates import NestedStructures
from ftlm.structure_selection.cross_validation import Folds

WORDS = "D^2 y = a y + d D y + c0 s + c1 D s + c2 D^2 s + c3 v"


class Alone:
    """Work done one after another."""

    def map_items(self, work, items):
        return [work(item) for item in items]


def link(seed, rows=400, step=0.02):
    """A mass on a spring whose base moves: y'' = -25 y - 1.5 y' - s'' + 0.4 s, and a signal that does nothing."""
    rng = np.random.default_rng([3, seed])
    t = np.arange(rows) * step
    # From rest, and so smooth that a line between samples is what it does.
    s, v = (
        sum(rng.standard_normal() * (np.sin(w * t) - w * t * np.exp(-t)) for w in rng.uniform(0.5, 4.0, 6))
        for _ in range(2)
    )
    den = [1.0, 1.5, 25.0]
    y = signal.lsim(signal.TransferFunction([-1.0, 0.0, 0.4], den), s, t)[1]
    y += 0.01 * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(
        step=step,
        inputs={"s": s, "v": v},
        outputs={"y": y},
        intersample={"s": "foh", "v": "foh"},
        name=f"link {seed}",
    )


@pytest.fixture(scope="module")
def runs():
    return [link(0), link(1)]


@pytest.fixture(scope="module")
def subsets(runs):
    return screen_subsets(NestedStructures(ftlm.equation(WORDS, initial="rest")), Folds.of(runs, "runs"), Alone())


def by_scipy(runs, subset, own):
    """A subset fitted by least squares over SciPy's responses to one run, judged on the other one: mean ln(1 - fit)."""
    ways = {"c0": ([1.0], "s"), "c1": ([1.0, 0.0], "s"), "c2": ([1.0, 0.0, 0.0], "s"), "c3": ([1.0], "v")}
    den = [1.0, -own["d"], -own["a"]]
    tables, measured = [], []
    for run in runs:
        t = np.arange(run.length) * run.step
        rows = [signal.lsim(signal.TransferFunction(ways[c][0], den), run[ways[c][1]], t)[1] for c in subset]
        tables.append(np.array(rows).T[1:-1])
        measured.append(np.asarray(run["y"])[1:-1])
    scores = []
    for fitted, judged in ((0, 1), (1, 0)):
        found = np.linalg.lstsq(tables[fitted], measured[fitted], rcond=None)[0]
        left = np.linalg.norm(measured[judged] - tables[judged] @ found)
        scores.append(math.log(left / np.linalg.norm(measured[judged] - np.mean(measured[judged]))))
    every = np.linalg.lstsq(np.concatenate(tables), np.concatenate(measured), rcond=None)[0]
    return float(np.mean(scores)), dict(zip(subset, every, strict=True))


def score_at(monkeypatch, point, ground, runs):
    """Return the scores at one grid point, without refinement."""
    monkeypatch.setattr(BaseModel, "grid_points", lambda _: [point])
    monkeypatch.setattr(best_subset, "GRID_REFINEMENTS", 0)
    return score_subsets(ground, Folds.of(runs, "runs"), Alone())


def test_the_products_say_what_scipy_says(runs, monkeypatch):
    """At given own coefficients: every subset fitted on one run and judged on the other one, and fitted on both."""
    every = base_models(NestedStructures(ftlm.equation(WORDS, initial="rest")), tuple(runs))
    ground = next(g for g in every if len(g.output_coefficients) == 2)
    point = (math.log(5.0), math.log(0.3))
    own = ground.coefficients(point)
    assert own == pytest.approx({"a": -25.0, "d": -1.5})
    found = score_at(monkeypatch, point, ground, runs)
    assert len(found) == 15
    for one in found:
        subset = sorted(set(one.start) - {"a", "d"})
        score, coefficients = by_scipy(runs, subset, own)
        assert one.score == pytest.approx(score, abs=0.02), subset
        for name, value in coefficients.items():
            assert one.start[name] == pytest.approx(value, abs=0.01, rel=0.01), (subset, name)


def test_every_subset_has_a_verdict_and_the_true_one_leads(subsets):
    # Two sets of own terms, without damping no free run dies away; fifteen subsets of what drives.
    assert len(subsets) == 30
    assert [s.score for s in subsets] == sorted(s.score for s in subsets)
    ahead = [s for s in subsets if s.score < subsets[0].score + 0.01]
    small = min(ahead, key=lambda s: len(s.start))
    assert sorted(small.start) == ["a", "c0", "c2", "d"]
    assert small.start == pytest.approx({"a": -25.0, "d": -1.5, "c0": 0.4, "c2": -1.0}, rel=0.2)


def test_the_choice_begins_with_the_best_subset(runs):
    found = ftlm.select(runs, ftlm.equation(WORDS, initial="rest"), threads=1)
    assert found.winner.name == "D^2 y = a y + d D^1 y + c0 s + c2 D^2 s"
    # 40 dB of noise leave 1 % over.
    assert 98.5 < found.winner.validation_fit < 99.5


def test_too_many_subsets_are_widened_and_the_best_is_among_them():
    """Products of random responses: of 2^14 subsets the best ones of each size are widened; the true one is found."""
    rng = np.random.default_rng(5)
    true, count = (1, 4, 9), 14
    values = []
    for _ in range(2):
        table = rng.standard_normal((400, count))
        y = table[:, list(true)] @ [1.0, -2.0, 0.5] + 0.01 * rng.standard_normal(400)
        rows = np.column_stack([table, y])
        values.append(rows.T @ rows)
    made = tuple(Column(f"c{k}", 0.0, ()) for k in range(count))
    judge = SubsetScorer(made, ((1,), (0,), (0, 1)), (0, 1), np.array([values[0][-1, -1], values[1][-1, -1]]))
    found = judge.score_all(np.array([values]))
    assert 2**count > MAX_EXHAUSTIVE_SUBSETS > len(found)
    best = min(found.values(), key=lambda v: v.score).score
    assert found[true].score < best + 0.02
    # One more that does nothing is as good; one less is not.
    assert all(v.score > best + 1.0 for s, v in found.items() if not set(true) <= set(s))


def test_a_term_at_several_orders_is_one_at_a_time(runs, monkeypatch):
    words = "D^2 y = a y + d D y + c0 D^g0 s + c1 D^g1 s + c3 v"
    inside = NestedStructures(
        ftlm.equation(words, initial="rest", orders={"g0": (0.0, 1.0, 0.1), "g1": (1.0, 2.0, 0.1)})
    )
    ground = next(g for g in base_models(inside, tuple(runs)) if len(g.output_coefficients) == 2)
    assert [(c.coefficient, c.order) for c in ground.columns] == [
        ("c0", 0.0),
        ("c0", 1.0),
        ("c1", 1.0),
        ("c1", 2.0),
        ("c3", 0.0),
    ]
    found = score_at(monkeypatch, (math.log(5.0), math.log(0.3)), ground, runs)
    # Both at order 1 are one term twice: (3 x 3 - 1 pairs, none included) x (v or not) less nothing at all.
    assert len(found) == 8 * 2 - 1
    assert "c0 s + c1 D^2 s" in " ".join(s.change.words for s in found)


def test_little_choice_and_blocks_are_not_screened(runs):
    few = ftlm.equation("D^2 y = a y + d D y + c0 s + c3 v")
    assert screen_subsets(NestedStructures(few), Folds.of(runs, "runs"), Alone()) == []
    assert screen_subsets(NestedStructures(ftlm.equation(WORDS)), Folds.of(runs[0], "blocks"), Alone()) == []
    delayed = ftlm.equation(WORDS, delay={"v": (0.0, 0.1)})
    assert screen_subsets(NestedStructures(delayed), Folds.of(runs, "runs"), Alone()) == []
