"""The search store of a stage under its order law, and of identifications by the lattice."""

import contextlib
import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest

import ftlm
from ftlm.errors import ModelError
from ftlm.order_search.checkpoint import CoupledTable, Rounds, Store, Verdicts, read_store
from stored_searches import bytes_of, job_of, records
from stores import keep

# ----------------------------------------------------------------------------------------------------------------------
# A stage under its order law


PUBLISHED = ftlm.flexible_link(form="published")
STAGE = {
    "alpha1": [1.9, 1.95, 2.0],
    "alpha2": [1.9, 2.0],
    "gamma1": [0.85, 0.95, 1.05],
    "beta2": [0.0, 0.1, 0.2],
    "mu2": [0.75, 0.85, 0.95],
}


@pytest.fixture(scope="module")
def stage_run(plant, drive, with_noise):
    return with_noise(plant("A").simulate(drive("A", samples=301), tolerance=1e-5), 1e-5, 3)


def search_stage(run, path=None, *, structure=None, order_grid=None, **options):
    options = {"m": 64, "top": 8, **options}
    order_grid = order_grid or ftlm.OrderGrid(orders=STAGE)
    return ftlm.search_orders(run, structure or ftlm.flexible_link(form="published"), order_grid, store=path, **options)


@pytest.fixture
def small_pieces(monkeypatch):
    """Some candidates a frame, so that a small store has many."""
    monkeypatch.setattr("ftlm.order_search.batches.MIN_BLOCK_CANDIDATES", 16)
    monkeypatch.setattr("ftlm.order_search.batches.CHECKPOINT_INTERVAL_S", 0.0)


@pytest.fixture(scope="module")
def stage_expected(stage_run):
    return bytes_of(search_stage(stage_run))


@pytest.fixture
def stage_store(stage_run, small_pieces, tmp_path):
    """Bytes of a complete store of a stage."""
    search_stage(stage_run, tmp_path / "whole.ftlm")
    return (tmp_path / "whole.ftlm").read_bytes()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"pruning": False, "threads": 3},
        {"criterion": "equation-error", "norm": "l2", "row_basis": "time", "top": 30},
        {"coefficients": "instrumental-variables", "norm": "l2", "threads": 1},
        {
            "structure": ftlm.flexible_link(form="published", laws=("orders",), coupling="measured"),
            "coefficients": "least-squares",
        },
        # More candidates than the first pass follows at a time, so that some are left early and followed further.
        pytest.param(
            {
                "order_grid": ftlm.OrderGrid(increment=0.1, orders={"alpha": (1.8, 2.0)}),
                "coefficients": "least-squares",
            },
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_search_of_a_stage_with_a_store_is_the_search_without(stage_run, small_pieces, tmp_path, options):
    path = tmp_path / "s.ftlm"
    reports = []
    found = search_stage(stage_run, **options)
    with_store = search_stage(stage_run, path, progress=lambda *done: reports.append(done), **options)
    assert bytes_of(with_store) == bytes_of(found)
    assert reports[-1][0] == reports[-1][1]
    assert [d for d, _ in reports] == sorted(d for d, _ in reports)
    size = path.stat().st_size
    assert bytes_of(search_stage(stage_run, path, **options)) == bytes_of(found)
    assert bytes_of(ftlm.resume_search(path)["stage"]) == bytes_of(found)
    assert path.stat().st_size == size
    status = ftlm.search_status(path)["stage"]
    assert status.complete
    assert status.candidates == reports[-1][1]
    assert status.best == found.score


def test_a_store_of_a_stage_cut_or_flipped_anywhere_never_gives_a_wrong_verdict(stage_store, tmp_path):
    path = tmp_path / "damaged.ftlm"
    path.write_bytes(stage_store)
    whole = read_store(path).sections[0]
    assert len(whole.frames) > 10
    for at in range(0, len(stage_store), 17):
        flipped = bytearray(stage_store)
        flipped[at] ^= 0x10
        for content in (stage_store[:at], bytes(flipped)):
            path.write_bytes(content)
            with contextlib.suppress(ftlm.DataError):
                found = read_store(path)
                assert found.sections[0].frames.items() <= whole.frames.items()
                assert found.sections[0].table in (None, whole.table)
                assert found.corruption is not None or found.sections[0].table == whole.table


def test_a_stage_goes_on_wherever_it_was_stopped(stage_run, stage_store, stage_expected, tmp_path):
    path = tmp_path / "cut.ftlm"
    path.write_bytes(stage_store)
    payloads = records(path)
    # Without its table alone it is joined anew, to the same bytes.
    keep(path, len(payloads) - 1)
    assert ftlm.search_status(path)["stage"].complete
    assert read_store(path).sections[0].table is None
    assert bytes_of(ftlm.resume_search(path)["stage"]) == stage_expected
    assert records(path) == payloads
    done = []
    for count in range(1, len(payloads) - 1, len(payloads) // 6):
        path.write_bytes(stage_store)
        keep(path, count)
        status = ftlm.search_status(path)["stage"]
        done.append(status.done_count)
        assert not status.complete
        threads = 1 + len(done) % 3
        assert bytes_of(ftlm.resume_search(path, threads=threads)["stage"]) == stage_expected
        assert ftlm.search_status(path)["stage"].complete
    assert len(done) > 3
    assert done[0] < done[-1]


def test_a_finished_search_of_a_stage_is_only_read(stage_run, stage_store, stage_expected, tmp_path, monkeypatch):
    path = tmp_path / "s.ftlm"
    path.write_bytes(stage_store)
    monkeypatch.setattr("ftlm.order_search.batches.CoupledProblem.build_evaluator", None)
    assert bytes_of(ftlm.resume_search(path)["stage"]) == stage_expected
    assert ftlm.search_status(path)["stage"].complete
    stored = msgspec.structs.asdict(read_store(path).sections[0].table)
    whole = read_store(path)
    for number, change in enumerate(
        (
            {"rows": ()},
            {"rows": ((*stored["rows"][0][:2], (1.0,), stored["rows"][0][3]), *stored["rows"][1:])},
            {"rows": ((*stored["rows"][0][:3], stored["rows"][0][3][:1]), *stored["rows"][1:])},
            {"counts": {**stored["counts"], "beaten": 0}},
            {"counts": {"candidates": 0}},
            {"failures": ((0, (1.0,), "singular"),)},
        )
    ):
        forged = tmp_path / f"{number}.ftlm"
        with Store(forged, whole.requests) as kept:
            kept._append([CoupledTable(**{**stored, **change})])
        for call in (ftlm.resume_search, ftlm.search_status):
            with pytest.raises(ftlm.DataError, match="the stored table belongs to another search"):
                call(forged)
    with Store(path) as kept, pytest.raises(ModelError, match="the search has an unexpected final table"):
        kept.contents.sections[0].add_frame(CoupledTable(**stored))


def test_a_stage_that_is_interrupted_goes_on(stage_run, stage_expected, small_pieces, tmp_path):
    path = tmp_path / "s.ftlm"
    for after in (1, 3, 2):
        reports = []

        def stop(done, total, reports=reports, after=after):
            reports.append(done)
            if len(reports) == after:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            search_stage(stage_run, path, progress=stop)
        # What was told is in the store.
        assert ftlm.search_status(path)["stage"].done_count == reports[-1]
    assert bytes_of(search_stage(stage_run, path)) == stage_expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run, path: search_stage(run, path, m=32), "this one has other data"),
        (lambda run, path: search_stage(run, path, top=9), "this one has other settings: top = 9"),
        (
            lambda run, path: search_stage(run, path, structure=PUBLISHED.with_coefficients({"g1": 40.0})),
            "this one has another equation",
        ),
        (
            lambda run, path: search_stage(run, path, order_grid=ftlm.OrderGrid(orders=STAGE | {"alpha2": 2.0})),
            "this one has another order grid",
        ),
    ],
)
def test_the_search_of_another_stage_is_refused(stage_run, stage_store, tmp_path, change, message):
    path = tmp_path / "s.ftlm"
    path.write_bytes(stage_store)
    with pytest.raises(ftlm.DataError, match=message):
        change(stage_run, path)
    assert path.read_bytes() == stage_store


def test_verdicts_that_do_not_fit_their_search_are_refused(stage_run, small_pieces, tmp_path):
    """What a forger would write: whole frames, under digests that are right."""
    job = job_of(stage_run, ftlm.flexible_link(form="published"), ftlm.OrderGrid(orders=STAGE), m=64, top=8)
    work = job.coupled_problem()
    wave = sum(last - first for _, first, last, _ in work.build_evaluator(keeps_state=True).pending_spans())
    for number, (first, last, kind, message) in enumerate(
        [
            (0, wave + 1, 0, "are divided into other blocks"),
            (0, wave, 9, "of kinds do not match"),
            (10**9, 10**9 + 1, 0, "the search has"),
        ]
    ):
        path = tmp_path / f"{number}.ftlm"
        with Store(path, [job.request("stage")]) as kept:
            kept.append_block(Verdicts(0, first, last, bytes(8 * (last - first)), bytes([kind]) * (last - first)))
        with pytest.raises(ftlm.DataError, match=message):
            ftlm.resume_search(path)
    path = tmp_path / "nan.ftlm"
    with Store(path, [job.request("stage")]) as kept:
        kept.append_block(Verdicts(0, 0, wave, np.full(wave, np.nan).tobytes(), bytes(wave)))
    for call in (ftlm.resume_search, ftlm.search_status):
        with pytest.raises(ftlm.DataError, match="do not match"):
            call(path)
    path = tmp_path / "kinds.ftlm"
    with Store(path, [job.request("stage")]) as kept, pytest.raises(ModelError, match="wrong number of verdicts"):
        kept.contents.sections[0].add_frame(Verdicts(0, 0, 2, bytes(8), b"\0"))
    with Store(path) as kept, pytest.raises(ModelError, match="not a valid range"):
        kept.contents.sections[0].add_frame(Rounds(0, 0, 1, ((), (0,) * 7, ())))


# ----------------------------------------------------------------------------------------------------------------------
# Identifications by the lattice


@pytest.mark.parametrize(
    ("structure", "names"),
    [
        (ftlm.flexible_link(form="published"), ["stage"]),
        (ftlm.flexible_link(form="published", laws=(), coupling="measured"), ["theta11", "theta12"]),
    ],
)
def test_an_identification_keeps_its_searches(stage_run, small_pieces, tmp_path, structure, names):
    path = tmp_path / "s.ftlm"
    order_grid = ftlm.OrderGrid(orders=STAGE) if names == ["stage"] else ftlm.OrderGrid(increment=0.3, alpha=(1.8, 2.0))
    method, options = ftlm.LeastSquares(order_grid=order_grid, top=5), {"m": 64, "threads": 1}
    plain = ftlm.identify(stage_run, structure, method=method, **options)
    calls = []

    def stop(done, total):
        calls.append(done)
        if len(calls) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ftlm.identify(stage_run, structure, method=replace(method, store=path), progress=stop, **options)
    assert list(ftlm.search_status(path)) == names
    found = ftlm.identify(stage_run, structure, method=replace(method, store=path), **options)
    assert json.dumps(found.to_dict()) == json.dumps(plain.to_dict())
    assert all(status.complete for status in ftlm.search_status(path).values())
    resumed = ftlm.resume_search(path)
    assert {n: s.to_dict() for n, s in resumed.items()} == {n: s.to_dict() for n, s in plain.searches.items()}


def test_a_store_where_nothing_is_searched_is_refused(stage_run, tmp_path):
    path = tmp_path / "s.ftlm"
    known = ftlm.equation("D^1.6 theta11 = a D^0.6 theta11 + b I1")
    with pytest.raises(ModelError, match="store= is not used: it is for order searches, and every order here is a num"):
        ftlm.identify(stage_run, known, method=ftlm.LeastSquares(store=path))
    with pytest.raises(ModelError, match="a store keeps one identification"):
        ftlm.identify_many([stage_run], ftlm.flexible_link(form="published"), method=ftlm.LeastSquares(store=path))
    assert not path.exists()


def test_the_command_identify_goes_on_with_its_store(tmp_path, clean_a):
    from typer.testing import CliRunner

    from ftlm.cli.main import app

    data, path = tmp_path / "a.csv", tmp_path / "s.ftlm"
    clean_a.to_csv(data)
    call = ["identify", str(data), "--structure", "flexible-link:1", "--laws", "orders", "--method", "least-squares"]
    call += ["--increment", "0.25", "--m", "128", "--json"]
    plain = CliRunner().invoke(app, call)
    kept = CliRunner().invoke(app, [*call, "--store", str(path)])
    keep(path, 2)
    again = CliRunner().invoke(app, [*call, "--store", str(path)])
    assert [r.exit_code for r in (plain, kept, again)] == [0, 0, 0], kept.output + again.output
    assert plain.stdout == kept.stdout == again.stdout
