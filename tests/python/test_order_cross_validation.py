"""Integer against fractional orders on validation runs: verdicts follow the numbers, the page shows both."""

import json
from dataclasses import replace

import numpy as np
import pytest

import ftlm
from command_line import run_command
from ftlm.estimation.verdict import MIN_FIT_GAIN, improves_prediction
from ftlm.reproduction.cross_validation import (
    cross_validate_orders,
    cross_validation_page,
    cross_validation_text,
    dead_channel_notes,
    link_structure,
    rate_effect_table,
    verdict_sentence,
)
from ftlm.reproduction.simulated_arm import stages_with

ROWS, STEP = 251, 0.02


def hub(seed: int) -> np.ndarray:
    """A hub that swings at several frequencies [rad], from rest."""
    t = np.arange(ROWS) * STEP
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, 6)
    swing = sum(np.sin(2 * np.pi * f * t + p) for f, p in zip((0.3, 0.7, 1.3, 1.9, 2.6, 3.4), phases, strict=True))
    return np.asarray(0.05 * swing * np.clip(t, 0, 1) ** 3)


def link_run(order: float, damping: float, seed: int, name: str) -> ftlm.Run:
    """A link on that hub, noise on its deflection."""
    truth = ftlm.Model(ftlm.equation(f"D^2 theta12 = -170 theta12 - {damping} D^{order} theta12 - D^2 theta11"))
    blank = ftlm.Run.from_arrays(
        step=STEP, inputs={"theta11": hub(seed)}, outputs={"theta12": np.zeros(ROWS)}, intersample={"theta11": "foh"}
    )
    clean = truth.simulate(blank)["theta12"]
    noise = 0.01 * np.std(clean) * np.random.default_rng([seed, 1]).standard_normal(ROWS)
    return ftlm.Run.from_arrays(
        step=STEP,
        inputs={},
        outputs={"theta11": hub(seed), "theta12": clean + noise},
        units={"theta11": "rad", "theta12": "rad"},
        name=name,
    )


@pytest.fixture(scope="module")
def fractional():
    """Two runs of a link whose damping has order 0.4."""
    runs = [link_run(0.4, 8.0, seed, name) for seed, name in ((1, "first"), (2, "second"))]
    return cross_validate_orders(runs, filtered=False, threads=1)


@pytest.fixture(scope="module")
def whole():
    """Two runs of a link whose orders are whole."""
    runs = [link_run(1.0, 1.0, seed, name) for seed, name in ((1, "first"), (2, "second"))]
    return cross_validate_orders(runs, filtered=False, threads=1)


SURE, OTHER, WIDE = (0.2, 0.4), (0.6, 0.8), (-0.2, 0.4)


@pytest.mark.parametrize(
    ("gains", "intervals", "wanted"),
    [
        ([3.0, 2.0], (SURE, SURE), True),
        ([3.0, 2.0], (SURE, WIDE), None),  # one run does not tell
        ([3.0, 2.0], (SURE, OTHER), None),  # one machine has one order
        ([3.0, -MIN_FIT_GAIN], (SURE, SURE), None),  # one run loses
        ([MIN_FIT_GAIN, MIN_FIT_GAIN], (SURE, SURE), True),
        ([0.9 * MIN_FIT_GAIN, 0.9 * MIN_FIT_GAIN], (SURE, SURE), False),  # told apart, and worth nothing
        ([0.1, -4.0], (WIDE, WIDE), False),
        ([3.0, -4.0], (WIDE, WIDE), False),
        ([3.0, 2.0], (WIDE, WIDE), None),
        ([-np.inf, 2.0], (SURE, SURE), None),
        ([-np.inf, -np.inf], (SURE, SURE), False),
    ],
)
def test_a_verdict_follows_gains_and_intervals(gains, intervals, wanted):
    told = {"beta2": dict(zip(("a", "b"), intervals, strict=True))}
    assert improves_prediction(gains, told, {"beta2": 0.0}) is wanted


def test_one_of_two_orders_tells_a_run_apart():
    told = {"beta2": {"a": WIDE, "b": SURE}, "mu2": {"a": (0.5, 0.7), "b": (0.6, 1.4)}}
    assert improves_prediction([1.0, 2.0], told, {"beta2": 0.0, "mu2": 1.0}) is True


def test_a_fractional_damping_improves_the_prediction_where_the_link_has_one(fractional):
    link = fractional.deflections["theta12"]
    assert link.verdict("fractional damping").improves is True
    assert link.verdict("both fractional").improves is True
    assert min(link.gains("fractional damping").values()) > 2 * MIN_FIT_GAIN
    for low, high in link.intervals("fractional damping")["mu2"].values():
        assert low < 0.4 < high
    assert verdict_sentence("theta12", link.verdict("fractional damping")) == (
        "θ₁₂: a fractional order of the damping improves the prediction."
    )


@pytest.mark.slow
def test_no_fractional_order_improves_the_prediction_where_orders_are_whole(whole):
    for verdict in whole.deflections["theta12"].verdicts:
        assert verdict.improves is False, verdict


def test_fits_are_those_of_the_models_on_the_other_run(fractional):
    link = fractional.deflections["theta12"]
    runs = {run.name: run for run in fractional.runs}
    for each in link.fits.values():
        for name, fitted in each.items():
            for other, run in runs.items():
                wanted = fitted.result.model.compare(run.select(["theta11", "theta12"])).fit["theta12"]
                assert fitted.fit(other) == pytest.approx(wanted, abs=1e-9), (name, other)
    gain = link.fits["fractional damping"]["first"].fit("second") - link.fits["integer orders"]["first"].fit("second")
    assert link.gains("fractional damping")["first", "second"] == pytest.approx(gain)
    assert set(link.gains("fractional damping")) == {("first", "second"), ("second", "first")}


def test_the_lower_of_two_orders_is_the_elasticity_s_whatever_the_fit_called_it(fractional):
    link = fractional.deflections["theta12"]
    for fitted in link.fits["both fractional"].values():
        found = fitted.estimates
        assert found["beta2"][0] < found["mu2"][0]
        # The stiff term of the truth has 170, the other 8.
        assert abs(found["a2"][0]) > abs(found["d2"][0])
        joint = {**fitted.result.orders, **fitted.result.joint.coefficients}
        assert sorted(v for v, *_ in found.values()) == sorted(joint.values())
        ends = sorted((low, high) for _, low, high in found.values())
        assert ends == sorted(tuple(fitted.result.intervals[n]) for n in joint)


def test_numbers_are_counted(fractional):
    link = fractional.deflections["theta12"]
    # a, d, e of the hub's angle; then an order or two.
    assert [next(iter(each.values())).parameter_count for each in link.fits.values()] == [3, 4, 4, 5]


def test_a_fit_that_failed_cannot_be_told(fractional):
    link = fractional.deflections["theta12"]
    lacking = {kind: dict(each) for kind, each in link.fits.items()}
    del lacking["fractional damping"]["second"]
    broken = replace(link, fits=lacking, failures={("fractional damping", "second"): "no start"})
    verdict = broken.verdict("fractional damping")
    assert verdict.improves is None
    assert "second → first" in verdict.reason
    assert "no fit" in verdict.reason
    assert broken.verdict("both fractional").improves is True
    assert verdict_sentence("theta12", verdict).endswith("is inconclusive.")


def test_a_fit_that_is_worse_than_what_it_contains_tells_nothing(fractional):
    link = fractional.deflections["theta12"]
    assert link.worse_runs("both fractional") == []
    fitted = link.fits["fractional damping"]["first"]
    own = fitted.comparisons["first"]
    flown = replace(own, output_error={n: replace(f, fit=50.0) for n, f in own.output_error.items()})
    lost = replace(fitted, comparisons={**fitted.comparisons, "first": flown})
    fits = {**link.fits, "fractional damping": {**link.fits["fractional damping"], "first": lost}}
    broken = replace(link, fits=fits)
    assert broken.worse_runs("fractional damping") == ["first"]
    verdict = broken.verdict("fractional damping")
    assert verdict.improves is None
    assert "On first it fits worse than the integer orders that it contains" in verdict.reason


def test_the_page_begins_with_verdicts_and_pictures(fractional, tmp_path):
    page = cross_validation_page(fractional, tmp_path / "orders.html")
    text = page.read_text()
    first = text[text.index('id="section-1"') : text.index('id="section-2"')]
    assert "fractional orders improve the prediction." in first
    for title in ("θ₁₂ on second, fitted to first", "θ₁₂ on first, fitted to second"):
        assert title in first
    link = fractional.deflections["theta12"]
    for kind in ("integer orders", "both fractional"):
        assert f"{kind[1:]} {link.fits[kind]['first'].fit('second'):.1f} %" in first
    assert "http://" not in text.replace("http://www.w3.org", "")
    assert page.stat().st_size < 1_000_000
    assert cross_validation_page(fractional, tmp_path / "again.html").read_bytes() == page.read_bytes()
    with pytest.raises(ftlm.DataError, match="exists"):
        cross_validation_page(fractional, page)
    json.dumps(fractional.to_dict(), allow_nan=False)
    assert "first → second" in cross_validation_text(fractional)


def test_a_page_without_a_fit_says_so(fractional, tmp_path):
    link = fractional.deflections["theta12"]
    lacking = {kind: dict(each) for kind, each in link.fits.items()}
    del lacking["both fractional"]["first"]
    broken = replace(link, fits=lacking, failures={("both fractional", "first"): "no start was found"})
    found = replace(fractional, deflections={"theta12": broken})
    text = cross_validation_page(found, tmp_path / "orders.html").read_text()
    assert "both fractional: no fit" in text
    assert "no start was found" in text
    assert "is inconclusive." in text
    assert "no fit" in cross_validation_text(found)


def test_both_stages_push_on_each_other():
    alone = link_structure(1, both=False, filtered=True)
    assert set(alone.signals) == {"theta11", "theta12"}
    assert set(alone.order_names) == {"beta2", "mu2"}
    both = link_structure(2, both=True, filtered=True)
    assert set(both.signals) == {"theta11", "theta12", "theta21", "theta22"}
    assert set(both.sensor_filter.signals) == {"theta12", "theta22"}


def test_the_rate_of_the_other_deflection_stands_where_it_was_measured():
    for stage, rate in ((1, "w2 D^1 theta22"), (2, "w4 D^1 theta12")):
        full = link_structure(stage, both=True, filtered=True)
        less = link_structure(stage, both=True, filtered=True, rate=False)
        assert rate in str(full)
        assert set(full.coefficient_names) - set(less.coefficient_names) == {f"w{2 * stage}"}
        assert full.order_names == less.order_names
    assert link_structure(1, both=False, filtered=True) == link_structure(1, both=False, filtered=True, rate=False)


def test_places_are_told_before_and_after_the_rate(fractional, tmp_path):
    # As if the rate had taken the order's place: what is fractional without it gains nothing beside it.
    link = fractional.deflections["theta12"]
    assert rate_effect_table(fractional) is None
    idle = {
        run: replace(each, comparisons=link.fits["integer orders"][run].comparisons)
        for run, each in link.fits["fractional damping"].items()
    }
    after = replace(link, fits={**link.fits, "fractional damping": idle}, without_rate=link)
    found = replace(fractional, deflections={"theta12": after})
    table = rate_effect_table(found)
    assert [row[0] for row in table.rows] == ["fractional elasticity", "fractional damping", "both fractional"]
    assert list(table.rows[1][1:]) == ["yes", "no"]
    assert list(table.rows[2][1:]) == ["yes", "yes"]
    page = cross_validation_page(found, tmp_path / "orders.html").read_text()
    assert "Does the order improve the prediction?" in page
    assert page.count("θ₁₂, without the rate of the other deflection") >= 2
    said = found.to_dict()["deflections"]["theta12"]
    assert said["without_rate"] == fractional.to_dict()["deflections"]["theta12"]
    assert [s["verdicts"]["fractional damping"]["improves"] for s in (said["without_rate"], said)] == [True, False]
    text = cross_validation_text(found)
    told = text[text.index("θ₁₂, without the rate of the other deflection:") :]
    assert "θ₁₂: a fractional order of the damping improves the prediction." in told
    assert "θ₁₂: a fractional order of the damping does not improve the prediction." not in told


def test_stages_are_those_that_all_runs_have(fractional):
    assert stages_with(fractional.runs, current=False) == [1]
    run = fractional.runs[0]
    with pytest.raises(ftlm.DataError, match="no stage of the arm has all of its signals in every run"):
        stages_with([run, run.select(["theta12"])], current=False)
    with pytest.raises(ftlm.DataError, match="give two or more"):
        cross_validate_orders([run])
    with pytest.raises(ftlm.DataError, match="do not have distinct names"):
        cross_validate_orders([run, run])


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["one.csv"], 3, "give two or more"),
        (["one.csv", "one.csv"], 3, "do not have distinct names"),
        (["one.csv", "gone.csv"], 3, "gone.csv"),
        (["one.csv", "one.csv", "-o", "there.html"], 3, "there.html"),
        (["strange.csv", "one.csv"], 3, "no stage of the arm"),
    ],
)
def test_what_cannot_be_done_is_said_before_any_work(fractional, tmp_path, words, code, message):
    (tmp_path / "there.html").write_text("mine")
    fractional.runs[0].to_csv(tmp_path / "one.csv")
    n = np.arange(300)
    ftlm.Run.from_arrays(step=0.01, inputs={"volts": np.sin(n / 7.0)}, outputs={"y": np.cos(n / 9.0)}).to_csv(
        tmp_path / "strange.csv"
    )
    ran = run_command("orders", *words, cwd=tmp_path)
    assert ran.returncode == code, ran.stderr
    assert message in ran.stderr
    assert ran.stdout == ""
    assert not (tmp_path / "orders.html").exists()


def test_angles_that_were_zeroed_at_first_are_noted():
    rng = np.random.default_rng(8)
    moving = rng.standard_normal((2, 600)).cumsum(axis=1) * 1e-3
    zeroed = np.where(np.arange(600) < 100, 0.0, moving[1])
    runs = [
        ftlm.Run.from_arrays(
            step=0.01,
            inputs={"I1": np.diff(moving[0], prepend=1.0)},
            outputs={"theta11": moving[0], "theta12": y},
            name=name,
        )
        for name, y in (("whole", moving[1]), ("zeroed", zeroed))
    ]
    (note,) = dead_channel_notes(runs, (1,))
    assert note.startswith("run zeroed: output theta12 is exactly 0")
    assert "--window" in note or "window=" in note
