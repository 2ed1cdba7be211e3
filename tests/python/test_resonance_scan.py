"""Output errors with own terms known: the core's projection against dense lower triangular systems."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_triangular, toeplitz

from ftlm import _core
from ftlm.errors import FtlmError
from ftlm.kernels import block_pulse_kernel

STEP = 0.02
SIGNALS, INPUTS = 3, [False, True, True]


def integral(eta: float, m: int) -> np.ndarray:
    """Lower triangular matrix of I^eta."""
    return np.tril(toeplitz(block_pulse_kernel(eta, m, step=STEP)))


def records(*, filtered: bool) -> list[tuple[float, np.ndarray, np.ndarray | None]]:
    rng = np.random.default_rng(5)
    out = []
    for m in (90, 120):
        means = np.cumsum(rng.standard_normal((SIGNALS, m)), axis=1)
        low_pass = _core.filter_series([(9.0, 0.0)], [(1.0, 1.0), (9.0, 0.0)], m, STEP) if filtered else None
        out.append((STEP, means, low_pass))
    return out


def naive(
    runs: list[tuple[float, np.ndarray, np.ndarray | None]],
    order: float,
    terms: list[tuple[int, float]],
    fixed: list[float | None],
    powers: list[float],
    own: list[float],
    point: list[float],
) -> tuple[float, np.ndarray]:
    """The same by dense matrices: own terms are divided by, all else is regressed upon."""
    targets, blocks, starts = [], [], []
    for step, means, low_pass in runs:
        m = means.shape[1]
        divisor = np.eye(m) - sum(c * integral(eta, m) for c, eta in zip(point, own, strict=True))
        free, target = [], means[0].copy()
        for (signal, nu), known in zip(terms, fixed, strict=True):
            answer = solve_triangular(divisor, integral(order - nu, m) @ means[signal], lower=True)
            if known is None:
                free.append(answer)
            else:
                target -= known * answer
        edges = np.arange(m + 1) * step
        begun = []
        for e in powers:
            pulses = np.diff(edges ** (e + 1)) / (e + 1) / step
            pulses = pulses if low_pass is None else np.tril(toeplitz(low_pass)) @ pulses
            begun.append(solve_triangular(divisor, pulses, lower=True))
        targets.append(target)
        blocks.append(np.array(free).reshape(-1, m))
        starts.append(begun)
    rows = [t.size for t in targets]
    columns = [np.concatenate([b[k] for b in blocks]) for k in range(blocks[0].shape[0])]
    for r, begun in enumerate(starts):
        for series in begun:
            column = np.zeros(sum(rows))
            column[sum(rows[:r]) : sum(rows[: r + 1])] = series
            columns.append(column)
    matrix, target = np.stack(columns, axis=1), np.concatenate(targets)
    x = np.linalg.lstsq(matrix, target, rcond=None)[0]
    size = np.linalg.norm(np.concatenate([means[0] for _, means, _ in runs]))
    return float(np.linalg.norm(target - matrix @ x) / size), x[: blocks[0].shape[0]]


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("powers", [[], [0.0, 0.8]])
@pytest.mark.parametrize("fixed", [[None, None], [0.7, None]])
def test_projection_is_that_of_dense_systems(*, filtered: bool, powers: list[float], fixed: list[float | None]) -> None:
    runs, order, terms, own = records(filtered=filtered), 1.8, [(1, 0.0), (2, 0.5)], [1.8, 1.0]
    points = [[-9.0, -1.0], [-400.0, -0.3], [-30.0, -12.0]]
    found = _core.projected_errors(runs, (0, order, terms), INPUTS, fixed, (False, powers), own, points)
    assert len(found) == len(points)
    for at, point in zip(found, points, strict=True):
        error, values = naive(runs, order, terms, fixed, powers, own, point)
        assert at is not None
        assert at[0] == pytest.approx(error, rel=1e-8)
        given = iter(values)
        expected = [c if c is not None else next(given) for c in fixed]
        np.testing.assert_allclose(at[1], expected, rtol=1e-6)


def test_a_constant_input_beside_a_constant_start_keeps_its_coefficient() -> None:
    # I^1 of a constant is t: behind t^1 as an initial term it would be lost, if that were taken away first.
    runs = [(STEP, np.stack([np.linspace(0, 1, 60) ** 2, np.ones(60)]), None)]
    structure, exponents = (0, 1.0, [(1, 0.0)]), [0.0, 1.0]
    (found,) = _core.projected_errors(runs, structure, [False, True], [None], (False, exponents), [1.0], [[-2.0]])
    assert found is not None
    assert np.isfinite(found[0])
    error, _ = naive(runs, 1.0, [(1, 0.0)], [None], exponents, [1.0], [-2.0])
    assert found[0] == pytest.approx(error, rel=1e-6)


def test_what_no_step_carries_and_twins_are_none() -> None:
    runs = records(filtered=False)
    # 1 = c h^eta / gamma(eta + 2): the divisor begins with zero.
    unsolvable = [2.0 / STEP]
    found = _core.projected_errors(runs, (0, 1.0, [(1, 0.0)]), INPUTS, [None], (False, []), [1.0], [unsolvable, [-1.0]])
    assert found[0] is None
    assert found[1] is not None
    twins = (0, 1.0, [(1, 0.0), (1, 0.0)])
    assert _core.projected_errors(runs, twins, INPUTS, [None, None], (False, []), [1.0], [[-1.0]]) == [None]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"fixed": [None, None]}, "fixed"),
        ({"fixed": [float("nan")]}, "fixed"),
        ({"autoregressive_orders": [-1.0]}, "autoregressive term"),
        ({"points": [[-1.0, 2.0]]}, "point"),
        ({"runs": []}, "records"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, object], word: str) -> None:
    given: dict[str, object] = {
        "runs": records(filtered=False),
        "equation": (0, 1.0, [(1, 0.0)]),
        "inputs": INPUTS,
        "fixed": [None],
        "terms": (False, []),
        "autoregressive_orders": [1.0],
        "points": [[-1.0]],
    }
    with pytest.raises(FtlmError, match=word):
        _core.projected_errors(**(given | change))  # type: ignore[arg-type]
