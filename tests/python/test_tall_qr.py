"""Tall matrices: against NumPy's factorisations, and whether any library's threads wake for them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ftlm.utils.linalg import (
    dot,
    minimum_norm_solution,
    orthonormal,
    projections,
    thin_svd,
    triangular_factor,
    vector_norm,
)

SHAPES = [(1, 1), (3, 5), (5, 5), (300, 5), (1800, 5), (1801, 5), (20_000, 5), (700, 60), (2300, 13), (40, 0)]


def table(rows: int, columns: int) -> np.ndarray:
    """Columns of which two are nearly alike and one is 0."""
    made = np.random.default_rng(5).standard_normal((rows, columns))
    if columns >= 5:
        made[:, 3] = made[:, 1] + 1e-9 * made[:, 3]
        made[:, 4] = 0.0
    return made


@pytest.mark.parametrize(("rows", "columns"), SHAPES)
def test_singular_values_are_numpy_s(rows: int, columns: int) -> None:
    tall = table(rows, columns)
    left, sizes, right = thin_svd(tall)
    largest = sizes.max(initial=1.0)
    np.testing.assert_allclose(sizes, np.linalg.svd(tall, compute_uv=False), rtol=1e-6, atol=1e-14 * largest)
    np.testing.assert_allclose(left * sizes @ right, tall, atol=1e-13 * largest)
    np.testing.assert_allclose(left.T @ left, np.eye(sizes.size), atol=1e-13)
    assert left.shape == (rows, min(rows, columns))


@pytest.mark.parametrize(("rows", "columns"), SHAPES)
def test_a_triangle_keeps_inner_products(rows: int, columns: int) -> None:
    tall = table(rows, columns)
    last = triangular_factor(tall)
    assert last.shape == (columns, columns)
    scale = float(np.max(np.abs(tall.T @ tall), initial=1.0))
    np.testing.assert_allclose(last.T @ last, tall.T @ tall, atol=1e-13 * scale)


@pytest.mark.parametrize(("rows", "columns"), [(300, 3), (9001, 3), (2300, 13), (700, 60), (4, 3)])
@pytest.mark.parametrize("rcond", [None, 1e-6])
def test_least_squares_are_numpy_s(rows: int, columns: int, rcond: float | None) -> None:
    tall = table(rows, columns)
    tall[:, 4:5] += 1.0
    wanted = np.random.default_rng(6).standard_normal(rows)
    expected = np.linalg.lstsq(tall, wanted, rcond=rcond)[0]
    found = minimum_norm_solution(tall, wanted, rcond)
    # Of two columns that are nearly alike the difference has seven digits.
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-9 * float(np.max(np.abs(expected))))
    np.testing.assert_allclose(tall @ found, tall @ expected, atol=1e-6)


def test_a_basis_leaves_out_what_is_rounding() -> None:
    assert orthonormal(1e100 * table(5000, 5), 1e-6).shape == (5000, 3)


def test_sums_are_those_of_rows() -> None:
    row = np.random.default_rng(1).standard_normal(30_000)
    assert dot(row, row[::-1]) == pytest.approx(float(np.sum(row * row[::-1])), rel=1e-10)
    assert vector_norm(row) == pytest.approx(float(np.linalg.norm(row)), rel=1e-12)
    assert vector_norm(np.zeros(0)) == 0.0
    np.testing.assert_allclose(projections(np.stack([row, 2 * row], axis=1), row), [dot(row, row), 2 * dot(row, row)])


WORK = """
import os, time
from pathlib import Path
import numpy as np
import ftlm

own = str(os.getpid())

def spent():
    # Processor time [ns] of each other thread, once all of them sleep.
    while True:
        tasks = [task for task in Path("/proc/self/task").iterdir() if task.name != own]
        try:
            if all((task / "stat").read_text().rsplit(")", 1)[1].split()[0] == "S" for task in tasks):
                return {task.name: int((task / "schedstat").read_text().split()[0]) for task in tasks}
        except (FileNotFoundError, ProcessLookupError):
            # A worker of the fit ended between the listing and the reading: look again.
            pass
        time.sleep(0.05)

rng = np.random.default_rng(0)
u = np.repeat(rng.standard_normal(240), 50)
run = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": np.zeros(u.size)})
y = ftlm.equation("D^1.5 y = -4 y - 0.5 D^0.5 y + 3 u")
measured = ftlm.simulate(ftlm.Model(y), run)["y"] + 0.01 * rng.standard_normal(u.size)
run = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": measured})
structure = ftlm.equation("D^alpha y = a y + d D^0.5 y + b u", initial="history")
method = ftlm.OutputError(intervals="quadratic")
before = spent()
%s
after = spent()
print(sum(after[task] - before[task] for task in before if task in after))
"""


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="threads are counted by Linux' own files")
@pytest.mark.parametrize(
    ("work", "wakes"),
    [
        ("ftlm.identify(run, structure, method=method, threads=1).model.compare(run)", False),
        ("np.linalg.qr(rng.standard_normal((12000, 20)))", True),
    ],
)
def test_an_identification_wakes_no_threads_of_a_library(work: str, wakes: bool) -> None:
    kept = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    found = subprocess.run(
        [sys.executable, "-c", WORK % work], capture_output=True, text=True, check=True, timeout=300, env=kept
    )
    nanoseconds = int(found.stdout.split()[-1])
    if (os.cpu_count() or 1) < 2:
        # One processor has no threads to wake.
        wakes = False
    assert (nanoseconds > 0) == wakes
