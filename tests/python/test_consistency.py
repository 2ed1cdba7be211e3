"""Consistency of segments: segments of one machine agree, and a changed parameter is named with its segment."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.estimation.consistency import differences, joint_statistic

SECOND = ftlm.equation("D^2 y = d D y + a y + b u")


def changing(stiffness, seed=0, rows=300, step=0.02):
    """A motor by SciPy whose stiffness changes after each part, in noise of 1 %; its state goes on."""
    rng = np.random.default_rng([23, seed])
    state, out, command = np.zeros(2), [], []
    for value in stiffness:
        u = np.repeat(rng.choice([-1.0, 1.0], rows // 15), 15)[:rows]
        system = [np.array(m) for m in ([[0, 1], [-value, -5.0]], [[0], [40.0]], [[1, 0]], [[0]])]
        a, b, *_ = signal.cont2discrete(system, step, "zoh")
        for now in u:
            out.append(state[0])
            state = a @ state + b[:, 0] * now
        command.append(u)
    y = np.array(out)
    y = y + 0.01 * np.std(y) * rng.standard_normal(y.size)
    return ftlm.Run.from_arrays(step=step, inputs={"u": np.concatenate(command)}, outputs={"y": y}, name="motor")


@pytest.fixture(scope="module")
def same():
    return ftlm.consistency(changing([40.0, 40.0]), SECOND, threads=1)


@pytest.fixture(scope="module")
def changed():
    return ftlm.consistency(changing([40.0, 48.0]), SECOND, threads=1)


def test_a_machine_that_stays_is_one_model(same):
    assert same.consistent is True
    assert same.segments == ("motor 0 to 6 s", "motor 6 to 12 s")
    assert same.reason.startswith("The same model within its uncertainty: the 95 % intervals of every")
    assert same.statistic < same.limit
    assert same.degrees_of_freedom == 3
    # Each part predicts the other as well as itself.
    assert all(fit["y"] > 97 for row in same.cross_validation for fit in row)


def test_a_machine_that_changes_is_named_with_number_parts_and_distance(changed):
    assert changed.consistent is False
    assert [d.name for d in changed.differences if d.disjoint] == ["a"]
    (first, second) = changed.results
    values = [r.coefficients["a"] for r in changed.results]
    assert values == pytest.approx([-40.0, -48.0], rel=0.02)
    between = abs(values[0] - values[1]) / math.hypot(first.standard_errors["a"], second.standard_errors["a"])
    assert changed.differences[0].difference_in_errors == pytest.approx(between, rel=0.05)
    words = str(changed)
    assert words.startswith("Not the same model: a is -")
    assert "in motor 0 to 6 s and -4" in words
    assert f"in motor 6 to 12 s, {changed.differences[0].difference_in_errors:.2g} standard errors apart" in words
    assert changed.statistic > changed.limit


def test_what_parts_are_is_what_is_identified_of_them(changed):
    """By hand: the second half, identified by itself."""
    run = changing([40.0, 48.0])
    alone = ftlm.identify(run.window(6.0, None), SECOND, threads=1)
    assert changed.results[1].coefficients == alone.coefficients
    assert changed.results[1].intervals == alone.intervals
    assert changed.cross_validation[1][0] == alone.model.compare(run.window(0.0, 6.0)).fit


def test_a_part_begins_as_its_own_fit_found():
    """A run that looks like rest and is not: what another part's model is told of it is what its own fit was."""
    step = 0.1
    u = np.sign(np.sin(0.025 * np.arange(1200)))
    u[:300] = 2.0
    blank = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": 0 * u})
    y = ftlm.Model(ftlm.equation("D^0.7 y = -0.3 y + u")).simulate(blank)["y"]
    first = 300 + int(np.argmin(np.abs(y[300:500])))
    y = y + 0.02 * np.random.default_rng(0).standard_normal(y.size)
    y[first] = 0.0
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u[first:]}, outputs={"y": y[first:]})
    consistency = ftlm.consistency(run, ftlm.equation("D^alpha y = a y + b u"))
    assert consistency.results[0].model.structure.initial == "history"
    assert min(fit["y"] for row in consistency.cross_validation for fit in row) > 90


def test_several_runs_are_parts_by_themselves():
    runs = [replace_name(changing([v], seed=k), f"day {k}") for k, v in enumerate([40.0, 40.0, 50.0])]
    found = ftlm.consistency(runs, SECOND, threads=1)
    assert found.segments == ("day 0", "day 1", "day 2")
    assert {d.segments for d in found.differences if d.disjoint and d.name == "a"} == {(0, 2), (1, 2)}
    assert found.degrees_of_freedom == 6
    assert found.consistent is False


def replace_name(run, name):
    return ftlm.Run.from_arrays(step=run.step, inputs={"u": run["u"]}, outputs={"y": run["y"]}, name=name)


def test_all_numbers_together_are_told_by_their_covariances():
    """Two parts by the formula for two: the difference in the sum of their covariances; three by weights."""
    parts = [changing([40.0], seed=seed) for seed in range(3)]
    results = [ftlm.identify(run, SECOND, threads=1) for run in parts]
    points = [r.joint.values for r in results]
    spreads = [r.joint.covariance for r in results]
    apart = points[0] - points[1]
    assert joint_statistic(results[:2]) == (
        pytest.approx(float(apart @ np.linalg.solve(spreads[0] + spreads[1], apart))),
        3,
    )
    weights = [np.linalg.inv(s) for s in spreads]
    centre = np.linalg.solve(sum(weights), sum(w @ p for w, p in zip(weights, points, strict=True)))
    far = sum((p - centre) @ w @ (p - centre) for w, p in zip(weights, points, strict=True))
    assert joint_statistic(results) == (pytest.approx(float(far), rel=1e-6), 6)


def test_a_number_that_a_part_does_not_tell_agrees_with_any(same):
    first, second = same.results
    blind = replace(second.joint, covariance=np.where(np.eye(3) * [1, 0, 0] > 0, np.inf, second.joint.covariance))
    place = second.joint.names[0]
    half = [first, replace(second, joint=blind)]
    consistency = {d.name: d for d in differences(half)}
    assert math.isnan(consistency[place].difference_in_errors)
    assert not consistency[place].disjoint
    assert joint_statistic(half)[1] == 2
    found = replace(same, results=tuple(half), differences=tuple(differences(half)))
    assert found.not_identifiable == (place,)
    assert f"{place} is not identifiable from at least one segment" in str(found)
    nothing = replace(second.joint, covariance=np.diag([np.inf] * 3))
    none = [first, replace(second, joint=nothing)]
    assert joint_statistic(none) == (None, 0)
    found = replace(
        same, results=tuple(none), differences=tuple(differences(none)), statistic=None, degrees_of_freedom=0
    )
    assert found.consistent is None
    assert found.reason == "Inconclusive: no parameter is identifiable from two segments"


def test_intervals_by_profile_are_compared_by_the_ends_that_face_each_other(same):
    first, second = same.results
    name = first.joint.names[0]
    value = values(first)[name], values(second)[name]
    low, high = sorted(value)

    def bent(result, below, above):
        bounds = replace_interval(result, name, values(result)[name] - below, values(result)[name] + above)
        return replace(result, joint=bounds)

    order = (first, second) if value[0] <= value[1] else (second, first)
    gap = high - low
    # Ends that do not face each other may be anywhere.
    wide = [bent(order[0], 1e6, 0.3 * gap), bent(order[1], 0.3 * gap, 1e6)]
    (found,) = [d for d in differences(wide) if d.name == name]
    assert found.disjoint
    assert found.difference_in_errors == pytest.approx(1.959964 / (0.3 * math.sqrt(2)))
    (found,) = [d for d in differences([wide[0], bent(order[1], 0.8 * gap, 1e6)]) if d.name == name]
    assert not found.disjoint
    (found,) = [d for d in differences([wide[0], bent(order[1], math.inf, 1.0)]) if d.name == name]
    assert math.isnan(found.difference_in_errors)
    # A covariance says little of numbers like these.
    assert joint_statistic(wide)[1] == 2


def values(result):
    return {**result.orders, **result.coefficients}


def replace_interval(result, name, low, high):
    return replace(result.joint, profiles={name: ftlm.ProfileInterval(low, high, 0.95)})


def test_a_page_a_frame_and_json(changed, tmp_path):
    page = changed.report(tmp_path / "parts.html").read_text(encoding="utf-8")
    assert "not the same model" in page
    assert "motor 6 to 12 s" in page
    with pytest.raises(ftlm.DataError, match="exists"):
        changed.report(tmp_path / "parts.html")
    consistency = json.loads(json.dumps(changed.to_dict()))
    assert consistency["consistent"] is False
    assert consistency["segments"] == list(changed.segments)
    assert consistency["differences"][0]["parameter"] == "a"
    frame = changed.to_frame()
    assert len(frame) == 6
    assert frame.loc[("a", "motor 0 to 6 s"), "value"] == changed.results[0].coefficients["a"]


def test_words_where_nothing_can_be_compared():
    run = changing([40.0])
    for parts in (1, 0, -2, 1.5, True, "2"):
        with pytest.raises(ftlm.ModelError, match="is not a whole number of at least 2"):
            ftlm.consistency(run, SECOND, segments=parts)
    with pytest.raises(ftlm.ModelError, match="2 runs are given, and each is a segment; leave segments= out"):
        ftlm.consistency([run, changing([40.0], seed=1)], SECOND, segments=2)
    for parts in (200, 10**9):
        with pytest.raises(ftlm.DataError, match=f"motor has 300 rows, too few to be cut into {parts} parts"):
            ftlm.consistency(run, SECOND, segments=parts)
    with pytest.raises(ftlm.ModelError, match="store= applies to a single identification"):
        ftlm.consistency(run, SECOND, method=ftlm.LeastSquares(store="a.ftlm"))
    with pytest.raises(ftlm.ModelError, match="method 'least-squares' gives no standard errors of D"):
        ftlm.consistency(run, SECOND, method="least-squares", threads=1)
    with pytest.raises(ftlm.DataError, match=r"motor 0 to 3 s: .*'z'"):
        ftlm.consistency(run, ftlm.equation("D^2 z = a z + b u"))
    with pytest.raises(TypeError, match="partz"):
        ftlm.consistency(run, SECOND, partz=2)
    still = ftlm.Run.from_arrays(
        step=0.02,
        inputs={"u": run["u"] * (np.arange(300) < 150)},
        outputs={"y": run["y"] * (np.arange(300) < 150)},
        name="half",
    )
    with pytest.raises(ftlm.DataError, match=r"half 3 to 6 s: .*constant"):
        ftlm.consistency(still, SECOND, threads=1)


def test_what_cannot_be_meant_is_refused_in_words(same):
    run = same.results[0].task.runs[0]
    structure = ftlm.equation("D^alpha y = a0 y + b0 u")
    for runs, options, words in (
        (run, {"segments": np.complex64(2)}, "segments = np.complex64"),
        (run, {"method": np.array(["output-error", "x"])}, "method is ndarray"),
        (run, {"method": "x" * 10**6}, "method = 'x{59}… is not known"),
    ):
        with pytest.raises(ftlm.FtlmError, match=words):
            ftlm.consistency(runs, structure, **options)


def test_the_command(tmp_path):
    run = changing([40.0, 48.0])
    table = np.column_stack([np.arange(run.length) * run.step, run["u"], run["y"]])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="t,u,y", comments="")
    asked = ["consistency", str(tmp_path / "run.csv"), "-u", "u", "-y", "y", "--structure", "D^2 y = d D y + a y + b u"]
    done = CliRunner().invoke(app, [*asked, "--report", str(tmp_path / "parts.html")])
    assert done.exit_code == 0, done.output
    assert "Not the same model: a is -" in done.output
    assert (tmp_path / "parts.html").exists()
    done = CliRunner().invoke(app, [*asked, "--segments", "1"])
    assert done.exit_code == 2
    assert "at least 2" in done.output
