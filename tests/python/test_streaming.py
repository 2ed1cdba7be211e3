"""Recursion (44) in a stream: equal to the batch closed form after every length, on a record and while recording."""

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.estimation.linear import Streaming

ORDERS = {"alpha1": 2.0, "alpha2": 2.0, "gamma1": 0.95, "beta2": 0.1, "mu2": 0.85}


@pytest.fixture(scope="module")
def run():
    return rig.record(duration=3.0, seed=2)


@pytest.fixture(scope="module")
def stage():
    return ftlm.flexible_link(form="published", stage=1, laws=("orders",), coupling="measured").with_orders(ORDERS)


def samples(stream, run):
    return np.column_stack([run[name] for name in stream.signals])


def batch(run, structure, **options):
    """The closed form on the run's own grid, rows in the order of time."""
    method = ftlm.MultiInnovation(row_basis="time", **options)
    return ftlm.identify(run, structure, method=method, m=run.length - 1).coefficients


@pytest.mark.parametrize(("p", "k0", "allowed"), [(1, 1.0, 1e-9), (3, 1.0, 1e-9), (7, 1.0, 1e-9), (7, 100.0, 1e-9)])
def test_a_stream_ends_at_the_batch_closed_form(run, stage, p, k0, allowed):
    stream = Streaming(stage, step=run.step, max_duration=5.0, innovation_length=p, prior_covariance=k0)
    stream.push(samples(stream, run))
    truth = batch(run, stage, innovation_length=p, prior_covariance=k0)
    assert stream.pulses == run.length - 1
    for name, value in stream.coefficients.items():
        assert value == pytest.approx(truth[name], rel=allowed), name


@pytest.mark.parametrize("p", [1, 7])
def test_the_default_prior_of_a_stream_is_that_of_the_batch(run, stage, p):
    stream = Streaming(stage, step=run.step, max_duration=5.0, innovation_length=p)
    stream.push(samples(stream, run))
    truth = batch(run, stage, innovation_length=p)
    for name, value in stream.coefficients.items():
        assert value == pytest.approx(truth[name], rel=1e-5), name


def test_every_length_of_a_stream_is_the_closed_form_of_that_length(run, stage):
    stream = Streaming(stage, step=run.step, max_duration=5.0, prior_covariance=1.0)
    done = 0
    for rows in (40, 41, 300, 1001):
        stream.push(samples(stream, run)[done:rows])
        done = rows
        part = run.window(0.0, rows * run.step)
        assert part.length == rows
        truth = batch(part, stage, prior_covariance=1.0)
        for name, value in stream.coefficients.items():
            assert value == pytest.approx(truth[name], rel=1e-8), (rows, name)


@pytest.mark.parametrize("order", [0.0, 0.3, 1.0, 1.4, 2.0])
def test_one_integral_of_any_order_is_the_batch_one(order):
    # y = c I^order u with one unknown: the stream's only error is that of the integral.
    equation = ftlm.equation(f"D^{order} y = b u") if order else ftlm.equation("D^0.5 y = b D^0.5 u")
    rng = np.random.default_rng(1)
    u = np.cumsum(rng.standard_normal(3000)) * 0.05
    run = ftlm.Run.from_arrays(step=0.004, inputs={"u": u}, outputs={"y": np.append(0.0, np.cumsum(u[:-1]))})
    stream = Streaming(equation, step=0.004, max_duration=20.0, inputs=["u"], prior_covariance=1e12)
    stream.push(samples(stream, run))
    truth = batch(run, equation, prior_covariance=1e12)
    assert stream.coefficients["b"] == pytest.approx(truth["b"], rel=1e-12)


def test_a_term_of_higher_order_than_the_output_is_streamed():
    """Link 1 of the arm in Lagrange's form, as identify takes it: the truth comes out of a noise-free run."""
    structure = ftlm.flexible_link(stage=1, laws=("orders",), coupling="measured", parameters="effective")
    structure = structure.with_orders({n: v for n, v in ORDERS.items() if n in structure.order_names})
    run = rig.record(duration=5.0, parameters="linear", input="prbs", seed=5)
    stream = Streaming(structure, step=run.step, max_duration=6.0, prior_covariance=1e10)
    stream.push(samples(stream, run))
    found, batched = stream.coefficients, batch(run, structure, prior_covariance=1e10)
    for name in ("a1", "b1", "g1", "a2", "b2"):
        assert found[name] == pytest.approx(structure.nominal_values.get(name, -1.0), rel=0.01), name
        assert found[name] == pytest.approx(batched[name], rel=0.01), name


def test_fixed_coefficients_are_kept(run, stage):
    fixed = stage.equation("theta11").with_coefficients({"b1": -62.956})
    stream = Streaming(fixed, step=run.step, max_duration=5.0, prior_covariance=1.0)
    stream.push(samples(stream, run))
    truth = batch(run, fixed, prior_covariance=1.0)
    assert set(stream.coefficients) == {"a1", "d1", "g1"}
    for name, value in stream.coefficients.items():
        assert value == pytest.approx(truth[name], rel=1e-8)


def test_a_record_is_identified_while_it_is_made(tmp_path, stage):
    stream = Streaming(stage, step=0.002, max_duration=5.0, prior_covariance=1e8)
    seen = []
    run = rig.record(
        duration=2.0,
        parameters="linear",
        out=tmp_path / "run.csv",
        live=stream,
        progress=lambda *_: seen.append(stream.pulses),
    )
    assert seen[0] == 499
    assert seen[-1] == 1000
    settings = ftlm.load(tmp_path / "run.csv").metadata["live"]
    assert settings["coefficients"] == stream.coefficients
    assert settings["trouble"] is None
    truth = batch(run, stage, prior_covariance=1e8)
    assert stream.coefficients["a1"] == pytest.approx(truth["a1"], rel=1e-6)
    assert stream.coefficients["a1"] == pytest.approx(628.89, rel=0.02)


def test_an_estimate_that_fails_does_not_stop_the_run(stage):
    stream = Streaming(stage, step=0.002, max_duration=0.5)
    run = rig.record(duration=2.0, live=stream)
    assert run.length == 1001
    assert "pulses in the stream" in run.metadata["live"]["trouble"]


@pytest.mark.parametrize(
    ("structure", "options", "words"),
    [
        (ftlm.flexible_link(form="published", stage=1), {}, "are free; a stream needs numbers"),
        (ftlm.equation("D^1.5 y = b u", initial="caputo"), {}, "not supported in a stream"),
        (ftlm.equation("D^2.5 y = b u"), {}, "outside [0, 2]"),
        (
            ftlm.equation("D^1.5 y = b u"),
            {"innovation_length": 0},
            "innovation_length = 0 is not a whole number from 1",
        ),
        (ftlm.equation("D^1.5 y = b u"), {"prior_covariance": 0.0}, "prior covariance"),
    ],
)
def test_what_a_stream_cannot_do_is_refused(structure, options, words):
    with pytest.raises(ftlm.ModelError) as refused:
        Streaming(structure, step=0.002, max_duration=5.0, inputs=["u", "I1"], **options)
    assert words in str(refused.value)


def test_a_sample_that_is_not_finite_and_a_signal_that_is_not_there_are_refused(stage, tmp_path):
    stream = Streaming(stage, step=0.002, max_duration=5.0)
    with pytest.raises(ftlm.DataError, match="not finite"):
        stream.push(np.full((1, len(stream.signals)), np.nan))
    other = Streaming(ftlm.equation("D^1.5 y = b u"), step=0.002, max_duration=5.0, inputs=["u"])
    with pytest.raises(ftlm.ModelError, match="which a rig does not record"):
        rig.record(duration=1.0, live=other, out=tmp_path / "x.csv")
    assert list(tmp_path.iterdir()) == []
