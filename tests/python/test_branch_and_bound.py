"""Order searches over lattices that are screened in boxes, beside the same candidates one by one."""

import numpy as np
import pytest

import ftlm
from ftlm.order_search.result import search_summary
from ftlm.order_search.search import rank_orders
from ftlm.utils.formatting import number
from slow_cases import slow_after
from small_lattice import EQUATION
from stored_searches import bytes_of
from stores import keep_share

#: From this many candidates on boxes screen.
BOXED = 1 << 25


def search(run, *, alpha=(1.05, 2.0), threads=2, coefficients="least-squares", **options):
    equation = ftlm.equation(EQUATION, initial="rest")
    lattice = ftlm.order_grid(increment=0.015, alpha=alpha)
    return ftlm.search_orders(run, equation, lattice, coefficients=coefficients, m=64, threads=threads, **options)


def rows_of(found):
    return [(row.score, dict(row.orders), dict(row.coefficients)) for row in found.table]


@pytest.fixture(scope="module")
def run(small_run, with_noise):
    return with_noise(small_run, 0.003, 1)


@pytest.fixture(scope="module")
def whole(run):
    return search(run)


def check_one_by_one(run, whole, **options):
    """The table of a search in boxes is that of two searches too small for boxes; every candidate is accounted for."""
    assert whole.candidates >= BOXED
    parts = [search(run, alpha=alpha, **options) for alpha in ((1.05, 1.8), (1.815, 2.0))]
    assert sum(part.candidates for part in parts) == whole.candidates
    assert all(part.candidates < BOXED for part in parts)
    rows = sorted((row for part in parts for row in rows_of(part)), key=lambda row: row[0])
    assert rows_of(whole) == rows[: len(whole.table)]
    assert sum(whole.exclusion_counts.values()) + len(whole.table) == whole.candidates
    assert [part.excluded_by_box for part in parts] == [0, 0]
    assert 0 < whole.excluded_by_box <= whole.exclusion_counts["bound"]
    assert f"{whole.exclusion_counts['bound']} bound ({whole.excluded_by_box} of them in boxes excluded whole)" in str(
        whole
    )
    assert "of these in boxes excluded whole" in whole._repr_html_()
    assert f"{number(whole.excluded_by_box)} are in boxes" in search_summary({"y": whole}).to_html()


@pytest.mark.slow
def test_boxes_keep_the_table_of_one_by_one(run, whole):
    check_one_by_one(run, whole)


def test_boxes_keep_the_table_of_squared_equation_errors(run, tmp_path):
    options = {"criterion": "equation-error", "norm": "l2"}
    path = tmp_path / "s.ftlm"
    whole = search(run, store=path, **options)
    check_one_by_one(run, whole, **options)
    assert whole.excluded_by_box > whole.candidates // 4
    keep_share(path, 0.5)
    assert 0 < ftlm.search_status(path)["y"].done_count < whole.candidates
    assert bytes_of(ftlm.resume_search(path)["y"]) == bytes_of(whole)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [3, 8])
def test_boxes_give_the_same_bits_for_more_threads(run, whole, threads):
    assert bytes_of(search(run, threads=threads)) == bytes_of(whole)


@pytest.mark.slow
def test_boxes_give_the_same_bits_for_any_threads_in_a_store_and_when_cut(run, whole, tmp_path):
    path = tmp_path / "s.ftlm"
    assert bytes_of(search(run, store=path, threads=1)) == bytes_of(whole)
    keep_share(path, 0.5)
    assert 0 < ftlm.search_status(path)["y"].done_count < whole.candidates
    assert bytes_of(ftlm.resume_search(path)["y"]) == bytes_of(whole)


@pytest.fixture(scope="module")
def unruly():
    """Of an output that no equation of the lattice makes, so that test vectors leave most candidates open."""
    y = 0.05 * np.cumsum(np.random.default_rng(5).standard_normal(513))
    u = np.where(np.arange(513) % 160 < 90, 1.0, -0.6)
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y}, name="unruly")


def closely(run, path=None, highest=2.0, coefficients="least-squares", **options):
    equation, lattice = ftlm.equation(EQUATION, initial="rest"), ftlm.order_grid(increment=0.05, alpha=(1.15, highest))
    return ftlm.search_orders(run, equation, lattice, coefficients=coefficients, m=32, store=path, **options)


@slow_after(2, "p, prior", [(1, None), (7, 1e-3), (7, 1.0), (7, 1e6)])
def test_close_proofs_keep_the_table_of_multi_innovation(unruly, p, prior):
    options = {"coefficients": "multi-innovation", "innovation_length": p, "prior_covariance": prior, "threads": 2}
    quick, slow = closely(unruly, **options), closely(unruly, pruning=False, **options)
    assert rows_of(quick) == rows_of(slow)
    assert sum(quick.exclusion_counts.values()) + len(quick.table) == quick.candidates
    if prior is None:
        # As many as for least squares, whose coefficients these are to rounding.
        expected = closely(unruly, threads=2).exclusion_counts["bound"]
        assert quick.exclusion_counts["bound"] == pytest.approx(expected, rel=0.01)


@slow_after(1, "prior", [1.0, None])
def test_boxes_keep_the_table_of_squared_equation_errors_of_multi_innovation(run, prior):
    options = {"criterion": "equation-error", "norm": "l2", "coefficients": "multi-innovation"}
    whole = search(run, prior_covariance=prior, **options)
    check_one_by_one(run, whole, prior_covariance=prior, **options)


def test_a_search_by_close_proofs_goes_on_where_it_was_cut_or_stopped(unruly, tmp_path):
    path = tmp_path / "s.ftlm"
    whole = closely(unruly, path, threads=2)
    # One too small for them excludes next to nothing.
    small = closely(unruly, highest=1.9)
    assert small.candidates < 1 << 18 <= whole.candidates
    assert small.exclusion_counts["bound"] < small.candidates // 10
    assert whole.exclusion_counts["bound"] > whole.candidates // 2
    assert bytes_of(closely(unruly, threads=3)) == bytes_of(whole)
    for share in (0.4, 0.8):
        keep_share(path, share)
        assert 0 < ftlm.search_status(path)["y"].done_count < whole.candidates
        assert bytes_of(ftlm.resume_search(path)["y"]) == bytes_of(whole)

    def stop(done, total):
        if done > total // 2:
            raise KeyboardInterrupt

    again = tmp_path / "again.ftlm"
    with pytest.raises(KeyboardInterrupt):
        closely(unruly, again, progress=stop)
    assert not ftlm.search_status(again)["y"].complete
    assert bytes_of(ftlm.resume_search(again)["y"]) == bytes_of(whole)


@pytest.mark.slow
@pytest.mark.parametrize("p", [1, 7])
@pytest.mark.parametrize("prior", [1.0, 1e6])
def test_one_slab_of_the_paper_keeps_the_rows_of_brute_force(clean_a, p, prior):
    equation = ftlm.flexible_link(form="published", stage=1).equation("theta12")
    options = {"coefficients": "multi-innovation", "innovation_length": p, "prior_covariance": prior, "threads": 2}
    grid = ftlm.order_grid(increment=0.02, alpha=(1.91, 1.91))
    quick = rank_orders(clean_a, equation, grid, **options)
    slow = rank_orders(clean_a, equation, grid, pruning=False, **options)
    assert quick.candidates == slow.candidates == 437_760
    assert len(quick.table) == 20
    assert [row.orders for row in quick.table] == [row.orders for row in slow.table]
    assert [row.score for row in quick.table] == pytest.approx([row.score for row in slow.table], rel=1e-12)
