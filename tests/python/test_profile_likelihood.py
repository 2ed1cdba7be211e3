"""Intervals by profile likelihood, beside closed forms and a naive profile by SciPy on plants simulated elsewhere."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares
from scipy.signal import lfilter, lsim

import ftlm
from ftlm import _core
from ftlm.estimation import confidence_intervals as profiling
from ftlm.estimation.confidence_intervals import ProfileResult, half_width, profile_intervals
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.model_checks import identifiability_findings
from ftlm.estimation.output_error import JointFit, Loss, fit_state
from ftlm.report.html_report import model_page
from ftlm.simulation.discretization import recording
from measured import DATA, needs_data
from profile_oracle import likelihood_of, nonlinear_parameters
from profile_oracle import profile_intervals as intervals_in_python
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

THRESHOLD = 1.959963984540054**2
STEP = 0.05


def record(y: np.ndarray, u: np.ndarray, noise: float, seed: int, step: float = STEP, colour: float = 0.0) -> ftlm.Run:
    """Noise of this share of the output's deviation, of this colour a sample."""
    white = np.random.default_rng(seed).standard_normal(y.size + 200)
    e = lfilter([math.sqrt(1.0 - colour**2)], [1.0, -colour], white)[200:]
    return ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y + noise * np.std(y) * e}, step=step)


def switched(rows: int, every: int, seed: int = 100) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(np.where(rng.random(rows // every + 1) < 0.5, -1.0, 1.0), every)[:rows]


def quadratic(run: ftlm.Run, words: str, loss: Loss = "squares") -> ftlm.Identification:
    method = ftlm.OutputError(intervals="quadratic", loss=loss)
    return ftlm.identify(run, ftlm.equation(words, initial="rest"), method=method, threads=1)


def problem_of(result: ftlm.Identification) -> FreeProblem:
    assert result.joint is not None
    return FreeProblem.of(replace(result.task.structure, initial=result.joint.initial))


def intervals_of(
    result: ftlm.Identification, *, most: int | None = None, fit: JointFit | None = None, **options: int
) -> ProfileResult:
    """Intervals of all free parameters by the core, with a budget of simulations, around another optimum."""
    problem, budget = problem_of(result), None if most is None else (most, 0)
    assert result.joint is not None
    joint = result.joint if fit is None else fit
    return profile_intervals(joint, problem, result.task.runs, problem.names, 0.95, budget=budget, **options)


def one_error_beside(result: ftlm.Identification) -> JointFit:
    """The fit as if it had ended a standard error beside the optimum."""
    valley = likelihood_of(result)
    assert result.joint is not None
    return replace(result.joint, finest_grid_values=valley.best.values + valley.errors)


# ---------------------------------------------------------------------------------------------- the program in NumPy


@pytest.mark.parametrize(
    ("words", "truth", "noise", "options"),
    [
        ("D^2 y = c D y + a y + b u", (-26.0, -25.0, 25.0), 0.8, {}),
        ("D^2 y = c D y + a y + b u", (-26.0, -25.0, 25.0), 0.1, {"loss": "huber", "colour": 0.8}),
        ("D^alpha y = a D^nu y + c y + b u", (-3.0, -25.0, 25.0), 0.2, {}),
        ("D^2 y = c D y + a y + b u", (-2.0, -25.0, 25.0), 0.3, {"delay": {"u": (0.0, 0.3)}}),
    ],
)
def test_the_core_finds_what_the_program_in_numpy_finds(
    words: str, truth: tuple[float, ...], noise: float, options: dict
) -> None:
    u = switched(240, 15)
    run = record(fast_pole(*truth, u), u, noise, 4, colour=options.get("colour", 0.0))
    structure = ftlm.equation(words, initial="rest", delay=options.get("delay"))
    method = ftlm.OutputError(intervals="quadratic", loss=options.get("loss", "squares"))
    found = ftlm.identify(run, structure, method=method, threads=1)
    valley = likelihood_of(found)
    found_intervals, expected_intervals = intervals_of(found), intervals_in_python(valley, valley.names, 0.95)
    assert list(found_intervals.intervals) == list(expected_intervals.intervals)
    for name, own in found_intervals.intervals.items():
        other = expected_intervals.intervals[name]
        # Refits end at their tolerance, where rounding decides on a last step.
        width = other.high - other.low if math.isfinite(other.high - other.low) else valley.errors.max()
        # A delay ends at 0, its lower bound.
        least = 0.0 if name == "delay_u" else -math.inf
        np.testing.assert_allclose(
            (own.low, own.high), (max(other.low, least), other.high), rtol=1e-7, atol=1e-7 * width
        )
        np.testing.assert_allclose(own.points, other.points, rtol=1e-6, atol=1e-6)
        assert own.evaluations == other.evaluations
    chosen = profile_intervals(found.joint, problem_of(found), found.task.runs, None, 0.95)
    assert list(chosen.intervals) == nonlinear_parameters(valley, 0.95)


# ------------------------------------------------------------------------------------------------ closed forms


@pytest.mark.parametrize("colour", [0.0, 0.8])
@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_the_profile_of_a_linear_problem_is_the_quadratic_interval(colour: float, loss: str) -> None:
    u, rng = switched(300, 10), np.random.default_rng(1)
    v = u[::-1] + rng.standard_normal(u.size)
    ramps = [np.concatenate([[0.0], np.cumsum(x)[:-1]]) * STEP for x in (u, v)]
    run = record(2.0 * ramps[0] - ramps[1], u, 0.1, 2, colour=colour)
    run = ftlm.Run.from_arrays(inputs={"u": u, "v": v}, outputs={"y": run["y"]}, step=STEP)
    found = quadratic(run, "D y = b u + c v", loss=loss)
    exact = found.intervals
    for name, own in found.profile(threads=1).items():
        width = exact[name][1] - exact[name][0]
        np.testing.assert_allclose((own.low, own.high), exact[name], atol=2e-4 * width)
        assert len(own.points) == 2
    # At another level, and the test by two evaluations says nothing against the picture.
    (wide,) = found.profile("b", level=0.99).values()
    assert wide.high - wide.low == pytest.approx(2 * 2.5758293 * found.standard_errors["b"], rel=1e-3)
    assert nonlinear_parameters(likelihood_of(found), 0.95) == []


def test_the_profile_of_one_number_is_its_likelihood() -> None:
    t = np.arange(40) * 0.25
    answer = lambda a: np.expm1(a * t) / a  # noqa: E731 — D y = a y + 1 from rest
    run = record(answer(-0.15), np.ones(t.size), 1.5, 3, 0.25)
    found = quadratic(run, "D y = a y + 1 u")
    squares = lambda a: float(np.sum((run["y"] - answer(a))[1:-1] ** 2))  # noqa: E731
    best = least_squares(lambda a: (run["y"] - answer(a[0]))[1:-1], [-0.15], xtol=1e-12, ftol=1e-12).x[0]
    limit = squares(best) * (1.0 + THRESHOLD / (t.size - 2 - 1))
    ends = [brentq(lambda a: squares(a) - limit, *between) for between in ((best - 1.0, best), (best, best + 0.5))]
    own = found.profile("a")["a"]
    np.testing.assert_allclose((own.low, own.high), ends, atol=5e-3 * (ends[1] - ends[0]))
    # The likelihood is skewed by more than that.
    low, high = found.intervals["a"]
    assert abs(low - ends[0]) + abs(high - ends[1]) > 0.04 * (ends[1] - ends[0])


# --------------------------------------------------------------------------------------- a naive profile by SciPy


def fast_pole(c: float, a: float, b: float, u: np.ndarray) -> np.ndarray:
    """D^2 y = c D y + a y + b u under a held input."""
    plant = ([[0.0, 1.0], [a, c]], [[0.0], [b]], [[1.0, 0.0]], 0)
    return lsim(plant, u, np.arange(u.size) * STEP, interp=False)[1]


def relaxation(alpha: float, a: float, b: float, u: np.ndarray) -> np.ndarray:
    """D^alpha y = a y + b u by Grünwald and Letnikov's sum, ticks halved and extrapolated."""

    def on_grid(fine: int) -> np.ndarray:
        held, tick = np.repeat(u, fine), STEP / fine
        size = 1 << (4 * held.size).bit_length()
        radius = 1e-8 ** (1.0 / size)
        z = radius * np.exp(-2j * np.pi * np.fft.rfftfreq(size))
        answer = np.fft.irfft(b * z / (((1.0 - z) / tick) ** alpha - a), size)[: held.size]
        answer = answer / radius ** np.arange(held.size)
        half = 2 * size
        return np.fft.irfft(np.fft.rfft(answer, half) * np.fft.rfft(held, half), half)[: held.size : fine]

    return 2.0 * on_grid(16) - on_grid(8)


def naive_rise(
    answer: Callable[..., np.ndarray], run: ftlm.Run, centre: Sequence[float], i: int, value: float, near: np.ndarray
) -> float:
    """Rise of the sum of squares over the noise's variance, all numbers but one refitted by SciPy."""
    u, y = run["u"], run["y"]

    def left(others: np.ndarray, number: float | None) -> np.ndarray:
        values = list(others) if number is None else [*others[:i], number, *others[i:]]
        return (y - answer(*values, u))[1:-1]

    tight = {"x_scale": "jac", "xtol": 1e-10, "ftol": 1e-10, "gtol": 1e-10}
    whole = least_squares(left, centre, args=(None,), **tight)
    rest = least_squares(left, np.delete(near, i), args=(value,), **tight)
    variance = 2.0 * whole.cost / (y.size - 2 - len(centre))
    return 2.0 * (rest.cost - whole.cost) / variance


@slow_after(
    1,
    "words, answer, truth, noise",
    [
        ("D^2 y = c D y + a y + b u", fast_pole, {"c": -26.0, "a": -25.0, "b": 25.0}, 0.1),
        ("D^alpha y = a y + b u", relaxation, {"alpha": 0.6, "a": -0.8, "b": 1.0}, 1.1),
    ],
)
def test_at_its_ends_the_cost_has_risen_by_the_threshold(
    words: str, answer: Callable[..., np.ndarray], truth: dict[str, float], noise: float
) -> None:
    u = switched(300, 15)
    run = record(answer(*truth.values(), u), u, noise, 4)
    found = quadratic(run, words)
    values = np.array([found.parameters[n].value for n in truth])
    valley = likelihood_of(found)
    asked = {n: valley.names.index(n) for n in truth}
    bent = nonlinear_parameters(valley, 0.95)
    assert bent
    for i, (name, own) in enumerate(found.profile(*truth).items()):
        quadratic_ends = found.intervals[name]
        off = max(abs(own.low - quadratic_ends[0]), abs(own.high - quadratic_ends[1]))
        if name in bent:
            assert off > 0.02 * (quadratic_ends[1] - quadratic_ends[0])
        for end in (own.low, own.high):
            assert math.isfinite(end)
            near = valley.refit(asked[name], end, valley.best)
            assert near is not None
            start = np.array([near.values[k] for k in asked.values()])
            rise = naive_rise(answer, run, values, i, end, start)
            assert math.sqrt(rise) == pytest.approx(math.sqrt(THRESHOLD), rel=0.03), (name, end)


# ------------------------------------------------------------------------------------------------ a bent valley


@pytest.fixture(scope="module")
def bent() -> ftlm.Run:
    """A fast pole that noise hides: c, a and b are known from one side alone."""
    u = switched(200, 20)
    return record(fast_pole(-26.0, -25.0, 25.0, u), u, 0.8, 3)


@pytest.fixture(scope="module")
def found(bent: ftlm.Run) -> ftlm.Identification:
    return ftlm.identify(bent, ftlm.equation("D^2 y = c D y + a y + b u", initial="rest"), threads=1)


def test_an_open_end_is_infinite_and_so_is_the_naive_cost_below_the_threshold(
    bent: ftlm.Run, found: ftlm.Identification
) -> None:
    own = found.profiles["c"]
    assert own.low == -math.inf
    assert own.is_open
    assert -26.0 in own
    assert 0.0 not in own
    far = 100.0 * found.coefficients["c"]
    ratio = np.array([far, far * 1.0, -far * 1.0])
    values = [found.coefficients[n] for n in "cab"]
    assert naive_rise(fast_pole, bent, values, 0, far, ratio) < THRESHOLD
    # Its own standard error reaches across 0.
    assert found.standard_errors["c"] * 1.96 > abs(found.coefficients["c"])


def test_terminal_json_frame_page_and_file_say_the_same(found: ftlm.Identification, tmp_path: Path) -> None:
    own = found.profiles["c"]
    assert found.intervals["c"] == (own.low, own.high)
    assert found.joint is not None
    assert found.joint.intervals["c"] == (own.low, own.high)
    text = found.details()
    assert f"−∞ to {own.high:.6g}" in text
    assert "but those written out: by profile likelihood" in text
    assert [w for w in found.warnings if "unbounded intervals (c below" in w]
    assert not [w for w in found.warnings if "coefficient c = " in w]
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["intervals"]["c"] == [None, own.high]
    assert "c" in document["profiled"]
    frame = found.to_frame()
    assert (frame.loc["c", "low"], frame.loc["c", "high"]) == (own.low, own.high)
    page = found.report(tmp_path / "report.html").read_text(encoding="utf-8")
    assert "by profile likelihood" in page
    assert "−∞" in page
    found.model.save(tmp_path / "model.json")
    read = ftlm.load_model(tmp_path / "model.json")
    assert read.estimate is not None
    assert read.estimate.intervals["c"] == (None, own.high)
    assert "by profile likelihood" in model_page(read, tmp_path / "model.html").read_text(encoding="utf-8")


def test_what_has_no_profile_is_written_without_one(bent: ftlm.Run, tmp_path: Path) -> None:
    plain = quadratic(bent, "D^2 y = c D y + a y + b u")
    assert plain.profiles == {}
    assert "profile likelihood" not in str(plain)
    plain.model.save(tmp_path / "model.json")
    assert json.loads((tmp_path / "model.json").read_text())["estimate"]["intervals"] == {}
    low, high = plain.intervals["c"]
    assert high - low == pytest.approx(2 * 1.959964 * plain.standard_errors["c"])


def test_the_same_ends_for_any_number_of_threads(found: ftlm.Identification) -> None:
    one, four = (found.profile(threads=n) for n in (1, 4))
    assert one == four
    assert {n: (p.low, p.high) for n, p in one.items() if n in found.profiles} == {
        n: (p.low, p.high) for n, p in found.profiles.items()
    }


def test_progress_counts_ends_and_stops_the_work(found: ftlm.Identification) -> None:
    told: list[tuple[int, int]] = []
    found.profile("c", "b", threads=1, progress=lambda done, total: told.append((done, total)))
    assert told == [(k, 4) for k in range(1, 5)]

    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        found.profile(threads=2, progress=interrupt)
    stop = _core.Stop()
    stop.set()
    problem = problem_of(found)
    runs = [recording(run, problem.structure) for run in found.task.runs]
    with pytest.raises(KeyboardInterrupt):
        _core.profile_intervals(problem.core, runs, fit_state(found.joint, problem), [0], half_width(0.95), stop=stop)
    with pytest.raises(ftlm.ModelError, match="parameter 3 of 3; count them from 0"):
        _core.profile_intervals(problem.core, runs, fit_state(found.joint, problem), [3], half_width(0.95))


def test_numbers_that_are_known_well_are_not_profiled(bent: ftlm.Run) -> None:
    u = bent["u"]
    run = record(fast_pole(-0.8, -4.0, 4.0, u), u, 0.01, 7)
    well = ftlm.identify(run, ftlm.equation("D^2 y = c D y + a y + b u", initial="rest"), threads=1)
    assert well.profiles == {}
    asked = ftlm.identify(
        run,
        ftlm.equation("D^2 y = c D y + a y + b u", initial="rest"),
        threads=1,
        method=ftlm.OutputError(intervals="profile"),
    )
    for name, own in asked.profiles.items():
        low, high = well.intervals[name]
        np.testing.assert_allclose((own.low, own.high), (low, high), atol=0.05 * (high - low))


def test_a_profile_that_nobody_asked_for_is_left_where_it_takes_long(
    bent: ftlm.Run, found: ftlm.Identification, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ftlm.estimation.confidence_intervals.MAX_AUTO_PULSES", 0)
    monkeypatch.setattr("ftlm.estimation.confidence_intervals.MIN_INITIAL_BUDGET_PER_BOUND", 6)
    structure = found.task.structure
    short = ftlm.identify(bent, structure)
    assert "c" not in short.profiles
    (said,) = [w for w in short.warnings if "profile-likelihood intervals would take too long" in w]
    assert "along c" in said
    assert "intervals='profile'" in said
    half = 1.959963984540054 * short.standard_errors["c"]
    assert short.intervals["c"] == pytest.approx((short.coefficients["c"] - half, short.coefficients["c"] + half))
    # Asked for, it takes what it needs.
    assert "c" in ftlm.identify(bent, structure, method=ftlm.OutputError(intervals="profile")).profiles


def test_what_one_end_does_not_need_goes_to_the_others(found: ftlm.Identification) -> None:
    free = intervals_of(found)
    took = {n: i.evaluations for n, i in free.intervals.items()}
    # Dealt out evenly alone, this budget would not do for the number that takes most.
    scarce = sum(took.values()) + 8 * len(took)
    assert max(took.values()) > scarce / len(took)
    dealt = intervals_of(found, most=scarce)
    assert dealt.incomplete_names == ()
    for name, interval in dealt.intervals.items():
        # A refit that was cut short goes on from where it was, by other steps.
        assert (interval.low, interval.high) == pytest.approx((free.intervals[name].low, free.intervals[name].high))
    assert max(took, key=took.__getitem__) in intervals_of(found, most=max(took.values())).incomplete_names


def test_a_number_that_is_not_seen_has_the_whole_line() -> None:
    u = switched(200, 20)
    run = record(fast_pole(-0.8, -4.0, 4.0, u), u, 0.01, 8)
    twice = ftlm.Run.from_arrays(inputs={"u": u, "v": u}, outputs={"y": run["y"]}, step=STEP)
    structure = ftlm.equation("D^2 y = -0.8 D y + a y + b u + e v", initial="rest")
    plain = quadratic(run, "D^2 y = -0.8 D y + a y + b u")
    assert plain.joint is not None
    assert plain.task is not None
    task = replace(plain.task, runs=(twice,), structure=structure)
    values = np.array([plain.coefficients["a"], 1.0, plain.coefficients["b"] - 1.0])
    joint = replace(
        plain.joint,
        coefficients=dict(zip("abe", values.tolist(), strict=True)),
        finest_grid_values=values,
        covariance=np.diag([1.0, np.inf, np.inf]),
    )
    seen = replace(plain, task=task, joint=joint).profile(threads=1)
    assert (seen["b"].low, seen["e"].high) == (-math.inf, math.inf)
    assert -4.0 in seen["a"]
    assert not seen["a"].is_open


def test_a_lower_optimum_on_the_way_is_gone_on_from(bent: ftlm.Run) -> None:
    u = bent["u"]
    plain = quadratic(record(fast_pole(-0.8, -4.0, 4.0, u), u, 0.05, 9), "D^2 y = c D y + a y + b u")
    right = intervals_of(plain).intervals
    there = intervals_of(plain, fit=one_error_beside(plain), evaluations=1)
    assert there.lower_optimum is not None
    assert there.lower_on_finer_grid
    assert plain.joint is not None
    np.testing.assert_allclose(there.lower_optimum, plain.joint.finest_grid_values, rtol=1e-3)
    shift = dict(zip(plain.joint.names, plain.joint.values - plain.joint.finest_grid_values, strict=True))
    for name, own in there.intervals.items():
        shifted = (right[name].low - shift[name], right[name].high - shift[name])
        np.testing.assert_allclose((own.low, own.high), shifted, rtol=2e-3)


def test_a_budget_holds_for_every_optimum_on_the_way(bent: ftlm.Run) -> None:
    u = bent["u"]
    plain = quadratic(record(fast_pole(-0.8, -4.0, 4.0, u), u, 0.05, 9), "D^2 y = c D y + a y + b u")
    names, apart = plain.names, {"fit": one_error_beside(plain), "evaluations": 1}
    free = intervals_of(plain, **apart)
    # It went on from a lower optimum; what it took until there counts.
    assert free.lower_optimum is not None
    assert free.evaluations > sum(i.evaluations for i in free.intervals.values())
    # As many as all ends are begun with: the way down leaves too few of them for the ends around the lower optimum.
    least = 10 * 2 * len(names)
    scarce = intervals_of(plain, most=least, **apart)
    assert 0 < scarce.evaluations <= least
    assert scarce.lower_optimum is not None
    assert scarce.incomplete_names == names
    assert intervals_of(plain, most=least).incomplete_names == ()
    # The first way down is the last that is followed, whatever the threads.
    assert intervals_of(plain, threads=3, **apart).evaluations == free.evaluations


def test_identify_goes_on_from_a_lower_optimum_and_says_so(bent: ftlm.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    u = bent["u"]
    run = record(fast_pole(-0.8, -4.0, 4.0, u), u, 0.05, 9)
    right = quadratic(run, "D^2 y = c D y + a y + b u")
    calls = []

    def beside(joint: JointFit, *arguments: object, **options: int) -> ProfileResult:
        calls.append(joint)
        if len(calls) > 1:
            return profile_intervals(joint, *arguments, **options)
        return profile_intervals(one_error_beside(right), *arguments, **options, evaluations=1)

    monkeypatch.setattr(profiling, "profile_intervals", beside)
    structure = ftlm.equation("D^2 y = c D y + a y + b u", initial="rest")
    same = ftlm.identify(run, structure, threads=1, method=ftlm.OutputError(intervals="profile"))
    # The fit was right all the while: its residuals do not fall, and its starts stay told.
    assert not [w for w in same.warnings if "it was found during the search for intervals" in w]
    assert same.joint.starts == right.joint.starts
    calls.clear()
    # As if it had been lower: of one optimum found twice rounding decides which is.
    monkeypatch.setattr(profiling, "MIN_NOISE_REDUCTION", -1.0)
    again = ftlm.identify(run, structure, threads=1, method=ftlm.OutputError(intervals="profile"))
    assert [w for w in again.warnings if "led to this optimum; it was found during the search for intervals" in w]
    assert "from a lower optimum" in again.details()
    for name, value in right.coefficients.items():
        assert again.coefficients[name] == pytest.approx(value, rel=1e-4)


def test_delays_and_orders_are_held_where_they_are_profiled() -> None:
    u = switched(300, 20)
    late = np.concatenate([np.zeros(3), u[:-3]])
    run = record(fast_pole(-0.8, -4.0, 4.0, late), u, 0.02, 10)
    structure = ftlm.equation("D^alpha y = -0.8 D y + a y + b u", initial="rest", delay={"u": (0.0, 0.5)})
    found = ftlm.identify(run, structure, threads=1, method=ftlm.OutputError(intervals="profile"))
    for name, value in {"alpha": 2.0, "a": -4.0, "b": 4.0, "delay_u": 3 * STEP}.items():
        own = found.profiles[name]
        assert value in own
        assert own.high - own.low < 10 * found.standard_errors[name]
    valley = likelihood_of(found)
    for i, name in enumerate(valley.names):
        moved = float(valley.best.values[i]) + float(valley.errors[i])
        refit = valley.refit(i, moved, valley.best)
        assert refit is not None
        assert refit.values[i] == moved, name


# ------------------------------------------------------------------------------------------------ refusals


def test_what_has_no_profile_says_so(bent: ftlm.Run, found: ftlm.Identification) -> None:
    structure = ftlm.equation("D^2 y = c D y + a y + b u", initial="rest")
    with pytest.raises(ftlm.ModelError, match="'e', nor 1 more is not a free parameter of this fit; it has c, a, b"):
        found.profile("e", "f")
    for level in (0.0, 1.0, 95, math.nan):
        with pytest.raises(ftlm.ModelError, match="is not a probability; give one between 0 and 1"):
            found.profile(level=level)
    with pytest.raises(ftlm.ModelError, match="level = '95 %' is not a number"):
        found.profile(level="95 %")  # type: ignore[arg-type]
    least = ftlm.identify(bent, structure, method="least-squares")
    with pytest.raises(ftlm.ModelError, match="'least-squares' has no likelihood to profile"):
        least.profile()
    with pytest.raises(ftlm.ModelError, match="intervals = 'likelihood' is not known; use 'auto' or"):
        ftlm.identify(bent, structure, method=ftlm.OutputError(intervals="likelihood"))  # type: ignore[arg-type]
    with pytest.raises(ftlm.ModelError, match="intervals='profile' needs a cost"):
        ftlm.identify(bent, structure, method=ftlm.OutputError(intervals="profile", reference="r"))
    looped = replace(found, settings={**found.settings, "reference": "r"})
    with pytest.raises(ftlm.ModelError, match="has no cost function to profile"):
        looped.profile()


def test_warnings_follow_the_profile(found: ftlm.Identification) -> None:
    assert found.joint is not None
    problem = problem_of(found)
    before = identifiability_findings(replace(found.joint, profiles={}), problem)
    after = identifiability_findings(found.joint, problem)
    assert [f for f in before if (f.code, f.parameter) == ("not_different_from_0", "c")]
    assert not [f for f in after if (f.code, f.parameter) == ("not_different_from_0", "c")]


# ------------------------------------------------------------------------------------------------ a real run


@needs_data
@pytest.mark.slow
def test_the_link_of_the_real_arm_is_bounded_from_one_side_alone() -> None:
    """The deflection driven by the hub: D^mu near 0 and the spring trade for each other without end."""
    run = ftlm.load(
        DATA / "two_link_psf" / "psf.csv",
        time="t_s",
        inputs={"theta11": "th11_deg"},
        outputs={"theta12": "th12_deg"},
        units={"theta11": "deg", "theta12": "deg"},
        intersample={"theta11": "foh"},
    ).window(1.1, 10.3)
    thin = ftlm.Run.from_arrays(
        step=4 * run.step,
        inputs={"theta11": run["theta11"][::4]},
        outputs={"theta12": run["theta12"][::4]},
        units=run.units,
        intersample={"theta11": "foh"},
    )
    words = "D^2 theta12 = d D^mu theta12 + a theta12 + b D^2 theta11"
    # Asked for: along a valley without end the default says that its profile takes long, and leaves it.
    link = ftlm.identify(
        thin, ftlm.equation(words, initial="caputo"), threads=1, method=ftlm.OutputError(intervals="profile")
    )
    assert link.standard_errors["d"] > 100 * abs(link.coefficients["d"])
    d, a, mu = (link.profiles[n] for n in ("d", "a", "mu"))
    assert d.low == -math.inf
    assert d.high < -1.0
    assert a.high == math.inf
    assert -200.0 < a.low < 0.0
    assert 0.0 <= mu.low < 0.01
    assert 0.1 < mu.high < 1.0
