"""Methods of estimation: a name and its object are one, bad options are refused where they are written."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import pytest
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.estimation.fit import Fit
from ftlm.estimation.methods import METHODS_BY_NAME, OrderSearchMethod, method_with_options
from ftlm.order_search.options import SearchSettings

pytestmark = pytest.mark.usefixtures("no_extension_tests")

FREE = "D^alpha y = a D^0.6 y + c y + b u"
FIXED = "D^1.6 y = a D^0.6 y + c y + b u"
GRID = ftlm.order_grid(increment=0.1, alpha=(1.4, 1.8))
#: A value of each option that no method takes, and what its error says.
BAD_VALUES = {
    "loss": ("cubes", "loss = 'cubes' is not known; use 'squares' or 'huber'"),
    "intervals": ("likelihood", "intervals = 'likelihood' is not known"),
    "start": (3.0, "start is float; give an identification, a model, or values by name"),
    "reference": (3, "reference is int; give the name of a signal of the runs"),
    "noise": ("arma", "noise = 'arma' is not known; use 'white' or 'ar'"),
    "order_grid": ({"alpha": 1}, "is dict, not"),
    "criterion": ("error", "criterion = 'error' is not known"),
    "norm": ("l0", "norm = 'l0' is not known; use 'l1' or 'l2'"),
    "top": (0, "top = 0 is outside [1, 100000]"),
    "store": (3, "store is int; give the path of a file"),
    "executor": (object(), "is not an executor of concurrent.futures"),
    "innovation_length": (0, "innovation_length = 0 is not a whole number of at least 1; give one"),
    "prior_covariance": (-1, "prior_covariance = -1 is not positive; a large one is a weak prior"),
    "row_basis": ("columns", "row_basis = 'columns' is not known"),
    "seeds": ("12", "seeds = '12': give 1 to 1000 whole numbers"),
    "evaluations": (100, "evaluations = 100 is less than two generations of 200"),
    "population": (4, "population = 4 is out of range; give an integer from 8"),
    "bounds": ({"a": (1.0, 0.0)}, "bounds of a = (1.0, 0.0) are not an interval"),
    "priors": ({"a": (1.0, 0.0)}, "prior of a = (1.0, 0.0) is not a finite mean and a positive standard deviation"),
}


@pytest.fixture(scope="module")
def noisy(small_run, with_noise):
    return with_noise(small_run, 0.01, 1)


@pytest.mark.parametrize("name", METHODS_BY_NAME)
def test_a_name_stands_for_the_defaults(name, noisy):
    if name == "genetic":
        pytest.importorskip("pygad")
    method = METHODS_BY_NAME[name]()
    by_name, by_object = (
        ftlm.identify(noisy, ftlm.equation(FREE), method=m, m=128, threads=1).to_dict() for m in (name, method)
    )
    assert by_name == by_object
    assert by_name["method"] == method.name == name


def test_every_method_is_public_and_is_made_by_keywords_alone():
    for kind in METHODS_BY_NAME.values():
        assert getattr(ftlm, kind.__name__) is kind
        assert kind.__name__ in ftlm.__all__
        assert kind() == kind()
        with pytest.raises(TypeError):
            kind("auto")
        with pytest.raises(AttributeError):
            kind().name = "other"


def test_defaults_of_a_search_are_those_of_search_orders(noisy):
    for name in ("least-squares", "multi-innovation", "instrumental-variables"):
        assert METHODS_BY_NAME[name]().settings() == SearchSettings(coefficients=name)
        found = ftlm.identify(noisy, ftlm.equation(FREE), method=METHODS_BY_NAME[name](order_grid=GRID), m=128)
        alone = ftlm.search_orders(noisy, ftlm.equation(FREE), GRID, coefficients=name, m=128)
        # The verdict is that of the identification.
        assert found.searches["y"].to_dict() == {
            k: v for k, v in alone.to_dict().items() if k not in ("verdict", "findings")
        }


def test_each_option_has_a_bad_value():
    assert {f.name for kind in METHODS_BY_NAME.values() for f in fields(kind)} == set(BAD_VALUES)


@pytest.mark.parametrize(
    ("name", "option"), [(name, f.name) for name, kind in METHODS_BY_NAME.items() for f in fields(kind)]
)
def test_a_bad_value_is_refused_where_it_is_written(name, option):
    value, message = BAD_VALUES[option]
    with pytest.raises(ftlm.ModelError) as refused:
        METHODS_BY_NAME[name](**{option: value})
    assert message in str(refused.value)


def test_profile_likelihood_has_no_reference():
    with pytest.raises(ftlm.ModelError, match="intervals='profile' needs a cost that has its minimum at the estimate"):
        ftlm.OutputError(intervals="profile", reference="r")


def test_what_is_no_method_is_refused(noisy):
    structure = ftlm.equation(FIXED)
    with pytest.raises(
        ftlm.ModelError, match=r"^method is the class OutputError; pass an object, method=OutputError\(\)"
    ):
        ftlm.identify(noisy, structure, method=ftlm.OutputError)
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.identify(noisy, structure, method="magic")
    assert all(repr(name) in str(refused.value) for name in METHODS_BY_NAME)
    for wrong in (None, 3, ["output-error"]):
        with pytest.raises(ftlm.ModelError, match=r"^method is .*, or an object such as ftlm\.OutputError"):
            ftlm.identify(noisy, structure, method=wrong)
    for call in (ftlm.identify, ftlm.identify_many, ftlm.consistency):
        with pytest.raises(TypeError, match="unexpected keyword argument 'loss'"):
            call(noisy, structure, loss="huber")
    with pytest.raises(TypeError, match="unexpected keyword argument 'loss'"):
        ftlm.LeastSquares(loss="huber")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("order_grid", ftlm.OrderGrid()),
        ("criterion", "equation-error"),
        ("norm", "l2"),
        ("top", 3),
        ("store", "s.ftlm"),
    ],
)
def test_options_of_a_search_need_a_free_order(option, value, noisy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for kind in OrderSearchMethod.__subclasses__():
        method = kind(**{option: value})
        with pytest.raises(ftlm.ModelError, match=f"^{option}= is not used: it is for order searches, and every order"):
            ftlm.identify(noisy, ftlm.equation(FIXED), method=method)
        ftlm.identify(noisy, ftlm.equation(FIXED), method=kind(), m=64)
    assert list(tmp_path.iterdir()) == []


def test_an_order_grid_names_free_orders(noisy):
    for kind in (*OrderSearchMethod.__subclasses__(), ftlm.GeneticAlgorithm):
        with pytest.raises(ftlm.ModelError, match="'beta' of order_grid= is not a free order; free are"):
            ftlm.identify(noisy, ftlm.equation(FREE), method=kind(order_grid=ftlm.order_grid(beta=0.1)))


def test_settings_of_multi_innovation_are_refused_with_other_coefficients(noisy):
    for option, value in (("innovation_length", 3), ("prior_covariance", 2.0), ("row_basis", "time")):
        with pytest.raises(ftlm.ModelError, match=f"^{option}= is not used by coefficients='least-squares'; leave it"):
            ftlm.search_orders(noisy, ftlm.equation(FREE), GRID, coefficients="least-squares", **{option: value})
    with pytest.raises(ftlm.ModelError, match="pruning = 1 is neither True nor False"):
        ftlm.search_orders(noisy, ftlm.equation(FREE), GRID, pruning=1)


class Halved:
    """Least squares whose coefficients count half."""

    name = "halved"

    def __init__(self):
        self.asked = []

    def fit(self, runs, structure, *, m, threads, progress):
        self.asked.append((structure.offset, m, threads))
        fit = ftlm.LeastSquares().fit(runs, structure, m=m, threads=threads, progress=progress)
        half = {name: value / 2 for name, value in fit.model.coefficients.items()}
        model = replace(fit.model, structure=fit.task.structure.with_coefficients(half))
        return replace(fit, method=self.name, model=model)


def test_an_estimator_of_ones_own(noisy):
    own = Halved()
    found = ftlm.identify(noisy, ftlm.equation(FIXED), method=own, m=100, threads=1)
    whole = ftlm.identify(noisy, ftlm.equation(FIXED), method="least-squares", m=100)
    assert found.method == "halved"
    assert found.coefficients == {n: v / 2 for n, v in whole.coefficients.items()}
    assert own.asked == [("none", 100, 1)]
    assert "halved" in found.details()
    # Offsets are decided by identify, from two fits at most.
    assert ftlm.identify(noisy, ftlm.equation(FIXED), method=own, offset="auto").settings["offset_test"]
    assert {offset for offset, _, _ in own.asked[1:]} <= {"none", "constant"}
    assert [item.result.method for item in ftlm.identify_many([noisy, noisy], ftlm.equation(FIXED), method=own)] == [
        "halved",
        "halved",
    ]


def test_a_fit_is_a_fit(noisy):
    own = Halved()
    own.fit = lambda *_, **__: None
    with pytest.raises(ftlm.ModelError, match="the method 'halved' fitted a NoneType; return a Fit"):
        ftlm.identify(noisy, ftlm.equation(FIXED), method=own)
    fit = ftlm.LeastSquares().fit([noisy], ftlm.equation(FIXED), m=64)
    assert isinstance(fit, Fit)
    assert (
        fit.model.coefficients == ftlm.identify(noisy, ftlm.equation(FIXED), method="least-squares", m=64).coefficients
    )


def test_many_runs_have_neither_a_store_nor_two_executors(noisy, tmp_path):
    structure = ftlm.equation(FREE)
    with pytest.raises(ftlm.ModelError, match="a store keeps one identification"):
        ftlm.identify_many([noisy], structure, method=ftlm.LeastSquares(store=tmp_path / "s.ftlm"))
    with ThreadPoolExecutor(1) as pool:
        with pytest.raises(ftlm.ModelError, match="the method has an executor besides executor="):
            ftlm.identify_many([noisy], structure, method=ftlm.LeastSquares(executor=pool), executor=pool)
        with pytest.raises(ftlm.ModelError, match="method = 'magic' is not known"):
            ftlm.identify_many([noisy], structure, method="magic", executor=pool)
    with pytest.raises(ftlm.ModelError, match="start= applies to a single identification"):
        ftlm.consistency(noisy, structure, method=ftlm.OutputError(start={"a": 1.0}))
    with pytest.raises(ftlm.ModelError, match="offset='auto' may need two searches"):
        ftlm.identify(noisy, structure, method=ftlm.LeastSquares(store=tmp_path / "s.ftlm"), offset="auto")


def test_a_genetic_algorithm_of_a_reproduction_has_no_order_grid():
    for method in (ftlm.GeneticAlgorithm(order_grid=GRID), ftlm.GeneticAlgorithm(norm="l2")):
        with pytest.raises(ftlm.ModelError, match="the order grid and the norm are those of the comparison"):
            ftlm.reproduce(genetic=method)


def test_options_by_name():
    assert method_with_options("least-squares", {"top": 3}) == ftlm.LeastSquares(top=3)
    with pytest.raises(ftlm.ModelError) as refused:
        method_with_options("output-error", {"norm": "l1", "top": 20, "loss": "huber"})
    assert str(refused.value) == (
        "norm= is not used by method='output-error', nor 1 other given here; leave it out, or use "
        "method='instrumental-variables' or method='multi-innovation' or method='least-squares' or method='genetic'"
    )


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("output-error", ["--norm", "l1"]),
        ("output-error", ["--seeds", "0"]),
        ("least-squares", ["--loss", "squares"]),
        ("least-squares", ["--reference", "r"]),
        ("genetic", ["--store", "s.ftlm"]),
        ("genetic", ["--criterion", "output-error"]),
    ],
)
def test_a_command_refuses_an_option_that_its_method_does_not_have(method, words, noisy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    noisy.to_csv(tmp_path / "run.csv")
    asked = ["identify", "run.csv", "--structure", FREE, "--method", method, *words]
    done = CliRunner().invoke(app, asked, env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert done.exit_code == 2, done.output
    assert f"{words[0]} is not used by --method {method}; leave it out, or use --method" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]
