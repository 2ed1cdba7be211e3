"""The estimator for scikit-learn: its own checks, clones, splits in time, grids of structures."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, KFold, TimeSeriesSplit, cross_val_score
from sklearn.utils.estimator_checks import check_estimator

import ftlm
from ftlm.sklearn import FractionalRegressor

STEP = 0.05
#: Checks of scikit-learn that rows in time cannot pass, and why.
EXPECTED = {
    "check_regressors_train": "rows of its data have no order in time, so nothing that remembers explains half of them",
    "check_regressor_multioutput": "its outputs are copies of one, which an equation of several cannot tell apart",
    "check_methods_sample_order_invariance": "rows are instants: in another order they are another record",
    "check_methods_subset_invariance": "a free run remembers the rows before, so that a part of them begins anew",
}


@pytest.fixture(scope="module")
def record():
    time = np.arange(400) * STEP
    u = np.sign(np.sin(2 * np.pi * time / 5)) + np.sign(np.sin(2 * np.pi * time / 3.1))
    truth = ftlm.Model(ftlm.equation("D^1.5 y = -1.2 y + 2 u"))
    free = truth.simulate(ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": 0 * time}))
    return u[:, None], free["y"] + 0.01 * np.random.default_rng(0).standard_normal(time.size)


def test_scikit_learns_own_checks_pass_but_for_what_time_forbids():
    # A fixed order and one linear solution make the fits of its sixty checks fast.
    estimator = FractionalRegressor(orders={"alpha": 1.0}, method="least-squares")
    results = check_estimator(estimator, expected_failed_checks=EXPECTED, on_skip=None, on_fail=None)
    by_status = {}
    for result in results:
        by_status.setdefault(result["status"], set()).add(result["check_name"])
    assert by_status.get("failed", set()) == set()
    assert by_status["xfail"] == set(EXPECTED)
    assert len(by_status["passed"]) >= 40


def test_the_truth_is_found_and_runs_free(record):
    X, y = record
    fitted = FractionalRegressor("D^alpha y = a y + b u", step=STEP).fit(X, y)
    low, high = fitted.identification_.intervals["alpha"]
    assert low < 1.5 < high
    assert fitted.score(X, y) > 0.999
    assert fitted.n_features_in_ == 1
    assert fitted.predict(X).shape == y.shape
    # The prediction is the model's free run, nothing else.
    run = ftlm.Run.from_arrays(step=STEP, inputs={"u": X[:, 0]}, outputs={"y": 0 * y})
    np.testing.assert_array_equal(fitted.predict(X), fitted.model_.simulate(run, initial={"y": {}})["y"])
    assert fitted.predict(X[:1]).shape == (1,)


def test_what_follows_the_fitted_rows_goes_on_from_them(record):
    X, y = record
    half = len(y) // 2
    going = FractionalRegressor("D^1.5 y = a y + b u", step=STEP, continues=True, method="least-squares")
    going.fit(X[:half], y[:half])
    whole = going.predict(X[half:])
    assert np.sqrt(np.mean((whole - y[half:]) ** 2)) < 0.05
    np.testing.assert_array_equal(going.predict(X[:half]), going.set_params(continues=False).predict(X[:half]))
    anew = going.predict(X[half:])
    assert np.sqrt(np.mean((anew - y[half:]) ** 2)) > 0.1


def test_clone_splits_in_time_and_grids_run_on_it(record):
    X, y = record
    estimator = FractionalRegressor("D^alpha y = a y + b u", step=STEP, continues=True, method="least-squares")
    copy = clone(estimator)
    assert copy.get_params() == estimator.get_params()
    assert not hasattr(copy, "model_")
    orders = [{"alpha": value} for value in (1.0, 1.25, 1.5, 1.75)]
    grid = GridSearchCV(estimator, {"orders": orders}, cv=TimeSeriesSplit(2)).fit(X, y)
    assert grid.best_params_ == {"orders": {"alpha": 1.5}}
    structures = {"structure": ["D y = a y + b u", "D^1.5 y = a y + b u"]}
    chosen = GridSearchCV(estimator, structures, cv=TimeSeriesSplit(2)).fit(X, y)
    assert chosen.best_params_["structure"] == "D^1.5 y = a y + b u"
    scores = cross_val_score(chosen.best_estimator_, X, y, cv=TimeSeriesSplit(3))
    assert np.all(scores > 0.99)


def test_several_outputs_and_a_structure_that_is_made_already(record):
    X, y = record
    structure = ftlm.equation("D^1.5 y = a y + b u; D^1.2 z = c z + d u", coupling="simulated")
    truth = ftlm.Model(ftlm.equation("D^1.5 y = -1.2 y + 2 u; D^1.2 z = -3 z + u", coupling="simulated"))
    run = ftlm.Run.from_arrays(step=STEP, inputs={"u": X[:, 0]}, outputs={"y": 0 * y, "z": 0 * y})
    free = truth.simulate(run)
    both = np.stack([free["y"], free["z"]], axis=1)
    fitted = FractionalRegressor(structure, step=STEP, method="least-squares").fit(X, both)
    assert fitted.predict(X).shape == both.shape
    assert fitted.score(X, both) > 0.999


@pytest.fixture(scope="module")
def frames(record):
    """Frames of two inputs and of two outputs, each in the order of its name in the structure."""
    u = record[0][:, 0]
    v = np.roll(u, 37)
    truth = ftlm.Model(ftlm.equation("D y = -3 y + 5 u - 2 v; D z = -z + u"))
    rest = {"y": 0 * u, "z": 0 * u}
    free = truth.simulate(ftlm.Run.from_arrays(step=STEP, inputs={"u": u, "v": v}, outputs=rest))
    return pd.DataFrame({"u": u, "v": v}), pd.DataFrame({"y": free["y"], "z": free["z"]})


def test_columns_of_a_frame_are_taken_by_name(frames):
    X, y = frames
    options = {"structure": "D y = a y + b u + c v; D z = d z + e u", "step": STEP, "method": "least-squares"}
    plain = FractionalRegressor(**options).fit(X.to_numpy(), y.to_numpy())
    fitted = FractionalRegressor(**options).fit(X[["v", "u"]], y[["z", "y"]])
    assert fitted.feature_names_in_.tolist() == ["v", "u"]
    assert fitted.model_.coefficients == plain.model_.coefficients
    predicted = fitted.predict(X[["v", "u"]])
    np.testing.assert_array_equal(predicted[:, ::-1], plain.predict(X.to_numpy()))
    assert fitted.score(X[["v", "u"]], y[["z", "y"]]) > 0.99
    with pytest.raises(ValueError, match="feature names should match"):
        fitted.predict(X)
    for columns, outputs, words in (
        (
            ["q", "p"],
            ["y", "z"],
            "X has the columns q, p, and the structure has u, v; rename the columns, or pass X.to_",
        ),
        (["u", "v"], ["y", "w"], "y has the columns y, w, and the structure has y, z"),
    ):
        with pytest.raises(ValueError, match=words):
            FractionalRegressor(**options).fit(X.set_axis(columns, axis=1), y.set_axis(outputs, axis=1))
    # One column is no question of order, and "auto" has no names.
    one = FractionalRegressor("D z = d z + e u", step=STEP).fit(X[["u"]].rename(columns={"u": "volt"}), y["z"])
    assert one.model_.coefficients["e"] == pytest.approx(1.0, rel=0.1)
    auto = FractionalRegressor(orders={"alpha": 1.0}, step=STEP, method="least-squares").fit(X[["v", "u"]], y["y"])
    assert auto.model_.coefficients["b0_1"] == pytest.approx(5.0, rel=0.1)


def test_a_gap_in_the_index_of_a_frame_is_refused(frames):
    X, y = frames[0][["u"]], frames[1]["z"]
    going = FractionalRegressor("D z = d z + e u", step=STEP, continues=True, method="least-squares")
    assert np.all(cross_val_score(going, X, y, cv=TimeSeriesSplit(3), error_score="raise") > 0.99)
    with pytest.raises(ftlm.DataError, match="does not increase by one step between the fitted rows and those of X"):
        cross_val_score(going, X, y, cv=TimeSeriesSplit(3, gap=20), error_score="raise")
    with pytest.raises(ftlm.DataError, match=r"after row 133 of X \(1 such gaps in all\)"):
        going.fit(X.drop(range(134, 267)), y.drop(range(134, 267)))
    with pytest.raises(ftlm.DataError, match="give consecutive rows"):
        cross_val_score(going, X, y, cv=KFold(3, shuffle=True), error_score="raise")
    dated = X.set_axis(pd.date_range("2024-01-01", periods=len(X), freq="50ms"))
    going.fit(dated[:200], y[:200])
    assert going.predict(dated[200:]).shape == (200,)
    assert going.predict(dated[:200]).shape == (200,)
    with pytest.raises(ftlm.DataError, match="between the fitted rows"):
        going.predict(dated[220:])


def test_bad_input_is_refused_in_words(record):
    X, y = record
    with pytest.raises(NotFittedError):
        FractionalRegressor().predict(X)
    for options, rows, error, words in (
        ({"structure": "D y = a y + b u + c v"}, X, ValueError, r"X has 1 columns; give those of the structure: u, v"),
        ({"structure": "D y = a y +"}, X, ftlm.ModelError, r"expected"),
        ({"structure": 3}, X, ftlm.ModelError, r"structure is int; give an equation as text, or a structure"),
        ({"step": -1.0}, X, ftlm.DataError, r"step"),
        ({"orders": {"alfa": 1.0}}, X, ftlm.ModelError, r"alfa"),
        ({"method": "output error"}, X, ftlm.ModelError, r"method"),
        ({}, np.where(X > 1, np.nan, X), ValueError, r"NaN"),
        ({}, X[:5], ValueError, r"minimum of 8 is required|inconsistent"),
    ):
        with pytest.raises(error, match=words):
            FractionalRegressor(**options).fit(rows, y)
    fitted = FractionalRegressor("D^1.5 y = a y + b u", step=STEP, method="least-squares").fit(X, y)
    with pytest.raises(ValueError, match=r"expecting 1 features"):
        fitted.predict(np.hstack([X, X]))
