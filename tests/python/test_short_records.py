"""Records of a few rows and of extreme sizes: a method ends in a result or in words, without NumPy's warnings."""

import contextlib

import numpy as np
import pytest

import ftlm
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

#: Errors that a record may end in.
IN_WORDS = (ftlm.DataError, ftlm.ModelError, ftlm.ConvergenceError)
LINEAR = ftlm.equation("D y = a0 y + b0 u")
COUPLED = ftlm.equation("D y = a0 y + b0 u; D z = a1 z + b1 y + b2 u")
FREE = ftlm.equation("D^alpha y = a0 D^beta y + b0 u", initial="rest")
METHODS = ("least-squares", "multi-innovation", "output-error", "instrumental-variables")


def record(seed):
    """A record of three to eight rows whose step, sizes and shape are drawn."""
    g = np.random.default_rng(seed)
    rows, step = int(g.choice([3, 4, 6, 8])), float(g.choice([1e-30, 1e-4, 0.1, 1e3, 1e12, 1e29]))
    size, of_input = (float(v) for v in g.choice([1e-150, 1e-5, 1.0, 1e5, 1e149], 2))
    walk = g.standard_normal(rows).cumsum()
    shapes = (walk, np.arange(rows) * 1.0, np.exp(g.integers(1, 40) * 0.1 * np.arange(rows)), np.eye(rows)[0])
    return ftlm.Run.from_arrays(
        step=step,
        inputs={"u": of_input * g.standard_normal(rows)},
        outputs={"y": size * shapes[seed % len(shapes)], "z": size * walk},
    )


#: What is asked of a record, by name.
ASKED = {
    **{f"identify by {m}": lambda run, m=m: ftlm.identify(run, LINEAR, method=m, threads=1) for m in METHODS},
    "identify coupled": lambda run: ftlm.identify(run, COUPLED, method="multi-innovation", threads=1),
    "identify orders": lambda run: ftlm.identify(run, FREE, threads=1),
    "search": lambda run: ftlm.search_orders(run, FREE, ftlm.order_grid(increment=0.5), threads=1),
    "select": lambda run: ftlm.select(run, LINEAR, threads=1),
    "certify": lambda run: ftlm.certify_orders(run, FREE, threads=1, max_cells=50),
    "compare": lambda run: ftlm.compare(ftlm.Model(ftlm.equation("D^1.5 y = -y + 2 u")), run),
    "residuals": lambda run: ftlm.resid(ftlm.Model(ftlm.equation("D y = -y + 2 u")), run),
}


@slow_after(1, "seeds", [6, 60])
@pytest.mark.parametrize("name", ASKED)
def test_a_short_record_ends_in_a_result_or_in_words(name, seeds):
    for seed in range(seeds if name.startswith("identify") else seeds // 4):
        with contextlib.suppress(*IN_WORDS):
            str(ASKED[name](record(seed)))


@slow_after(1, "seeds", [10, 40])
def test_three_rows_in_small_steps_and_large_numbers(seeds):
    for seed in range(seeds):
        g = np.random.default_rng(seed)
        walk = np.cumsum(g.standard_normal(3)) * 1e5
        run = ftlm.Run.from_arrays(step=1e-4, inputs={"u": g.standard_normal(3)}, outputs={"y": walk})
        for method in METHODS[:2]:
            with contextlib.suppress(*IN_WORDS):
                ftlm.identify(run, LINEAR, method=method)


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_fewer_than_three_rows_are_refused(rows):
    with pytest.raises(ftlm.DataError, match=r"3 are needed"):
        ftlm.Run.from_arrays(step=0.1, inputs={}, outputs={"y": np.arange(rows)})


def test_poles_out_of_the_range_of_numbers_are_refused():
    with pytest.raises(ftlm.ModelError, match="the poles overflow"):
        ftlm.analysis.poles(ftlm.Model(ftlm.equation("D^0.01 y = 1e12 y + 2 u")))
    assert not ftlm.analysis.poles(ftlm.Model(ftlm.equation("D^0.01 y = -1e12 y + 2 u"))).size
    slow = ftlm.analysis.poles(ftlm.Model(ftlm.equation("D^1.5 y = -1e-200 D^0.5 y + 2 u")))
    np.testing.assert_allclose(slow, [-1e-200], rtol=1e-9)


@slow_after(1, "seeds", [12, 60])
def test_rows_that_a_model_fits_exactly_end_in_a_result_or_in_words(seeds):
    # Residuals of 0 have no size with which other initial conditions could be compared.
    for seed in range(seeds):
        g = np.random.default_rng(seed)
        run = ftlm.Run.from_arrays(
            step=1e3,
            inputs={"u": g.standard_normal(5)},
            outputs={"y": 1e-9 * np.cumsum(g.standard_normal(5))},
        )
        with contextlib.suppress(*IN_WORDS):
            ftlm.identify(run, LINEAR, threads=1)
