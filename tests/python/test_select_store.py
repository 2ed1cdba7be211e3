"""A selection that was stopped goes on where it was, to the same bits; what is no store of it is refused in words."""

import contextlib
import dataclasses
import shutil
import sqlite3

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.estimation.output_error import fit_output_error
from ftlm.structure_selection import cross_validation as trial
from ftlm.structure_selection.candidates import name_candidates
from ftlm.structure_selection.checkpoint import FitError, Request, Store, StoredAnswer, StoredFit
from ftlm.structure_selection.cross_validation import Folds
from ftlm.utils.checkpoint_file import RECORD_ENCODER, CheckpointFile
from test_select import motor

SECOND = ftlm.equation("D^2 y = d D y + a y + b u")
FIRST = ftlm.equation("D y = a y + b u")


@pytest.fixture(scope="module")
def runs():
    return [motor(0, rows=200), motor(1, rows=200)]


@pytest.fixture
def fits(monkeypatch):
    """Fits that are computed."""
    made = []

    def counted(*args, **more):
        made.append(1)
        return fit_output_error(*args, **more)

    monkeypatch.setattr(trial, "fit_output_error", counted)
    return made


@pytest.fixture(scope="module")
def whole(runs, tmp_path_factory):
    """A store of a selection that ended, and what it came to."""
    path = tmp_path_factory.mktemp("store") / "whole.ftlm"
    return path, ftlm.select(runs, [SECOND, FIRST], threads=1, store=path)


def test_a_selection_stopped_anywhere_goes_on_to_the_same_bits(runs, fits, tmp_path):
    asked = ftlm.equation("D^2 y = d D^mu y + a y + b u", orders={"mu": (0.5, 1.5, 0.1)}, offset="auto")
    plain = ftlm.select(runs, asked, threads=2)
    needed, place = len(fits), tmp_path / "grown.ftlm"
    for stop in (1, plain.fitted_count // 2, plain.fitted_count - 1):

        def interrupt(done, known, stop=stop):
            if done == stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            ftlm.select(runs, asked, threads=1, store=place, progress=interrupt)
    fits.clear()
    again = ftlm.select(runs, asked, threads=2, store=place)
    # Nearly all was there: what the last stop left, and the fits of what is not judged by growth.
    assert len(fits) < needed / 3
    assert again.to_dict() == plain.to_dict()
    assert str(again) == str(plain)
    fits.clear()
    assert ftlm.select(runs, asked, threads=1, store=place).to_dict() == plain.to_dict()
    assert fits == []


def test_screened_subsets_are_kept(tmp_path):
    rng = np.random.default_rng(5)
    made = []
    for seed in range(2):
        one = motor(seed, rows=200)
        others = {n: np.cumsum(rng.standard_normal(200)) * 0.02 for n in ("v", "w")}
        made.append(
            ftlm.Run.from_arrays(
                step=one.step, inputs={"u": one["u"], **others}, outputs={"y": one["y"]}, name=one.name
            )
        )
    asked = ftlm.equation("D^2 y = d D y + a y + b u + e v + f w")
    plain = ftlm.select(made, asked, threads=2)
    place = tmp_path / "subsets.ftlm"
    assert ftlm.select(made, asked, threads=2, store=place).to_dict() == plain.to_dict()
    assert ftlm.select(made, asked, threads=1, store=place).to_dict() == plain.to_dict()


def test_a_store_stopped_anywhere_goes_on_and_one_that_is_damaged_is_refused(runs, whole, tmp_path):
    path, found = whole
    data, place = path.read_bytes(), tmp_path / "cut.ftlm"
    request = Request.of(*_asked(runs))
    with CheckpointFile(path, "selection") as file:
        payloads, _ = file.read()
    assert len(payloads) == 5  # The request, two fits, two judgements.
    for count in range(5):
        place.write_bytes(data)
        with contextlib.closing(sqlite3.connect(place)) as file, file:
            file.execute("DELETE FROM selection WHERE number > ?", (count,))
        with Store(place, request) as kept:
            assert len(kept) == max(count - 1, 0)
        assert ftlm.select(runs, [SECOND, FIRST], threads=1, store=place).to_dict() == found.to_dict()
        with CheckpointFile(place, "selection") as file:
            assert file.read() == (payloads, None)
    rng, damaged = np.random.default_rng(8), 0
    for at in rng.integers(0, len(data), 60).tolist():
        flipped = bytearray(data)
        flipped[at] ^= 0x10
        for content in (bytes(flipped), data[: at + 1]):
            place.write_bytes(content)
            try:
                Store(place, request).close()
            except ftlm.DataError:
                damaged += 1
                assert place.read_bytes() == content
            else:
                # Some bytes of a page hold nothing.
                with CheckpointFile(place, "selection") as file:
                    assert file.read() == (payloads, None)
    assert damaged > 75


def _asked(runs):
    folds = Folds.of(runs, "runs")
    return folds.runs, [[], name_candidates([SECOND, FIRST])], [], folds.description


def test_what_is_another_selection_is_refused(runs, whole, tmp_path):
    path, _ = whole
    place = tmp_path / "other.ftlm"
    shutil.copy(path, place)
    before = place.read_bytes()
    for words, other in {
        "of other candidates": lambda: ftlm.select(runs, [SECOND], store=place),
        "of other runs": lambda: ftlm.select([runs[0], motor(3, rows=200)], [SECOND, FIRST], store=place),
        "with other validation data": lambda: ftlm.select(runs, [SECOND, FIRST], validation="blocks", store=place),
    }.items():
        with pytest.raises(ftlm.DataError, match=f"contains a selection {words}; choose another file"):
            other()
    judged = ftlm.select(runs[0], [FIRST], validation=runs[1], store=tmp_path / "judged.ftlm")
    assert judged.winner.failure is None
    with pytest.raises(ftlm.DataError, match="with other validation data"):
        ftlm.select(runs[0], [FIRST], validation=motor(3, rows=200), store=tmp_path / "judged.ftlm")
    request = Request.of(*_asked(runs))
    with Store(place, request), pytest.raises(ftlm.DataError, match="in use by another selection; wait for it"):
        ftlm.select(runs, [SECOND, FIRST], store=place)
    older = Request(request.algorithm + 1, "0.0.1", request.runs, request.candidates, request.validation)
    with Store(tmp_path / "older.ftlm", older):
        pass
    with pytest.raises(ftlm.DataError, match=r"was written by ftlm 0\.0\.1, algorithm .* finish the selection"):
        ftlm.select(runs, [SECOND, FIRST], store=tmp_path / "older.ftlm")
    # Digests of another version tell nothing of what it was asked.
    strange = Request(request.algorithm, "0.0.1", b"other", b"others", b"another")
    with Store(tmp_path / "strange.ftlm", strange):
        pass
    with pytest.raises(ftlm.DataError, match=r"was written by ftlm 0\.0\.1, algorithm .* finish the selection"):
        ftlm.select(runs, [SECOND, FIRST], store=tmp_path / "strange.ftlm")
    assert place.read_bytes() == before
    text = tmp_path / "notes.txt"
    text.write_text("to do\n")
    with pytest.raises(ftlm.DataError, match="is not an ftlm selection store; give a file written with store="):
        ftlm.select(runs, [FIRST], store=text)
    assert text.read_text() == "to do\n"
    with pytest.raises(ftlm.DataError, match="is not a regular file"):
        ftlm.select(runs, [FIRST], store=tmp_path)
    with pytest.raises(ftlm.DataError, match="cannot be opened: No such file"):
        ftlm.select(runs, [FIRST], store=tmp_path / "no" / "such.ftlm")
    with pytest.raises(
        ftlm.DataError, match="is the store of a selection, not of a search; resume it with the call that created it"
    ):
        ftlm.resume_search(place)
    with pytest.raises(ftlm.DataError, match=r"^.*other\.ftlm is the store of a selection, not of a search"):
        ftlm.search_status(place)
    forged = tmp_path / "forged.ftlm"
    with Store(forged, request) as kept:
        kept._file.append([RECORD_ENCODER.encode(request)])
    with pytest.raises(ftlm.DataError, match="has an unexpected entry in record"):
        Store(forged, request)


def test_errors_of_candidates_are_kept_and_those_of_ftlm_are_not(runs, tmp_path):
    with Store(tmp_path / "errors.ftlm", Request.of(*_asked(runs))) as kept:
        lost = kept.fit(FIRST, [], True, lambda: ftlm.ConvergenceError("no start"))
        again = kept.fit(FIRST, [], True, lambda: pytest.fail("is known"))
        assert (type(again), str(again)) == (type(lost), str(lost)) == (ftlm.ConvergenceError, "no start")
        wrong = ftlm.InternalError("a panic")
        assert kept.fit(SECOND, [], True, lambda: wrong) is wrong
        assert len(kept) == 1
    assert RECORD_ENCODER.encode(StoredAnswer(b"0", FitError("DataError", "x")))


def _forged(path, request, *payloads):
    """A store as the log itself writes it, its digests valid whatever its frames hold."""
    with Store(path, request) as kept:
        kept._file.append(payloads)
    return path


def _fit(runs):
    resting = ftlm.equation("D y = a y + b u", initial="rest")
    return StoredFit.of(fit_output_error(runs, resting, start={"a": -1.0, "b": 1.0}))


def test_wrong_contents_under_valid_digests_are_refused_in_words(runs, tmp_path):
    request = Request.of(*_asked(runs))
    plain = _fit(runs)
    sound = _forged(tmp_path / "sound.ftlm", request, RECORD_ENCODER.encode(StoredAnswer(b"0", plain)))
    with Store(sound, request) as kept:
        assert len(kept) == 1
    unknown = RECORD_ENCODER.encode(StoredAnswer(b"0", FitError("KeyError", "x")))
    history = StoredFit(dataclasses.replace(plain.joint, initial="auto"), True)
    joint = plain.joint

    def but(**changes):
        return StoredFit(dataclasses.replace(joint, **changes), plain.history)

    fits = {
        r"a covariance or values of another size than its \d parameters": [
            but(covariance=joint.covariance[:-1]),
            but(covariance=joint.covariance.ravel()),
            but(finest_grid_values=np.tile(joint.finest_grid_values, 2)),
            but(coefficients=joint.coefficients | {"c": 1.0}),
        ],
        "residuals that are not one-dimensional": [but(residuals=[{"y": np.zeros((2, 2))}])],
        "the initial terms 'auto' instead of powers of t": [history],
    }
    wrong = [("has an unexpected entry in record .*choose another file", unknown)]
    wrong += [
        ("has an unexpected entry in record .*choose another file", RECORD_ENCODER.encode(StoredAnswer(b"0", one)))
        for one in (
            but(initial="nowhere"),
            but(unstable_optimum=(True, "x", False)),
            but(covariance=((2, 2), bytes(31))),
            but(covariance=((-1, 1 << 60), bytes(32))),
        )
    ]
    wrong += [
        (
            f"contains a fit with {words} in record .*; choose another file",
            RECORD_ENCODER.encode(StoredAnswer(b"0", one)),
        )
        for words, each in fits.items()
        for one in each
    ]
    for number, (words, payload) in enumerate(wrong):
        place = _forged(tmp_path / f"{number}.ftlm", request, payload)
        before = place.read_bytes()
        with pytest.raises(ftlm.DataError, match=words):
            Store(place, request)
        assert place.read_bytes() == before


def test_an_answer_to_another_question_is_refused_in_words(runs, tmp_path):
    request = Request.of(*_asked(runs))
    joint = _fit(runs).fit()

    def ask(kept, what):
        if what == "a fit":
            return kept.fit(FIRST, [], True, lambda: joint)
        if what == "a validation":
            return kept.validation("first", FIRST, joint, False, lambda: trial.Trial("first", FIRST, 2, failure="x"))
        return kept.subsets(FIRST, list)

    questions, answers = ("a fit", "a validation", "subsets"), {}
    for what in questions:
        with Store(tmp_path / f"{what}.ftlm", request) as kept:
            ask(kept, what)
            answers[what] = next(iter(kept._results.items()))
    for what, (key, _) in answers.items():
        others = {n: answer for n, (_, answer) in answers.items() if n != what}
        if what != "a fit":
            others["an error"] = FitError("DataError", "x")
        for held, answer in others.items():
            place = _forged(tmp_path / f"{what} {held}.ftlm", request, RECORD_ENCODER.encode(StoredAnswer(key, answer)))
            with (
                Store(place, request) as kept,
                pytest.raises(ftlm.DataError, match=f"contains {held} where {what} is expected; choose another file"),
            ):
                ask(kept, what)


def test_the_command_goes_on(runs, tmp_path, monkeypatch):
    for run in runs:
        table = np.column_stack([np.arange(run.length) * run.step, run["u"], run["y"]])
        np.savetxt(tmp_path / f"{run.name}.csv", table, delimiter=",", header="t,u,y", comments="")
    files = [str(tmp_path / f"{r.name}.csv") for r in runs]
    place = tmp_path / "kept.ftlm"
    words = [
        "select",
        *files,
        "--time",
        "t",
        "-u",
        "u=u",
        "-y",
        "y=y",
        "--structure",
        "D y = a y + b u",
        "--structure",
        "D^2 y = d D y + a y + b u",
        "--store",
        str(place),
        "--json",
        "--threads",
        "1",
    ]
    held = []

    def stopped(*args, **more):
        held.append(1)
        if len(held) == 3:
            raise KeyboardInterrupt
        return fit_output_error(*args, **more)

    with monkeypatch.context() as here:
        here.setattr(trial, "fit_output_error", stopped)
        first = CliRunner().invoke(app, words)
    assert first.exit_code == 130
    assert "interrupted; go on with: the same command" in first.output
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    without = CliRunner().invoke(app, [w for w in words if w not in ("--store", str(place))])
    assert done.stdout == without.stdout
