"""FractionalRegressor: scikit-learn estimator of fractional-order models."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.methods import EstimationMethod
from ftlm.structure.order import Values
from ftlm.structure.parser import equation
from ftlm.structure.structure import Structure
from ftlm.utils.validation import Floats, as_array

try:
    _base, _validation = (importlib.import_module(f"sklearn.{part}") for part in ("base", "utils.validation"))
except ImportError:
    raise ModelError("scikit-learn is not installed; pip install 'ftlm[sklearn]'") from None


class FractionalRegressor(_base.MultiOutputMixin, _base.RegressorMixin, _base.BaseEstimator):  # type: ignore[misc, name-defined]
    """scikit-learn estimator of a fractional-order model; a prediction is a simulation.

    Parameters
    ----------
    structure
        An equation in words, a structure, or ``"auto"``: D^alpha y0 = a0 y0 + b0_0 u0 + b0_1 u1 …, one alpha for all
        outputs. Inputs are the columns of X in the order in which they appear in it, outputs those of y.
    step
        Time between rows [s].
    orders
        Free orders by name: a number fixes one, ``"0.5:1.5:0.05"`` is its lattice; see :func:`ftlm.equation`.
    method
        Name of a method, or a method with its options, such as :class:`ftlm.OutputError`; see :func:`ftlm.identify`.
    offset
        As of :func:`ftlm.identify`; it belongs to the fitted rows and is no part of a prediction.
    continues
        Rows that are predicted follow the fitted ones without a gap, as those of ``TimeSeriesSplit`` do: the free run
        goes through the fitted inputs first. Rows that are the fitted ones themselves are predicted from their start.
        If not, every prediction starts from rest.
    threads
        Threads of a fit; one, for scikit-learn runs several fits at once.

    Attributes
    ----------
    identification_ : Identification
        What was found; its ``verdict()`` says whether to trust it.
    model_ : Model
        The model.
    n_features_in_ : int
        Inputs.
    """

    def __init__(
        self,
        structure: str | Structure = "auto",
        *,
        step: float = 1.0,
        orders: Mapping[str, Values] | None = None,
        method: str | EstimationMethod = "output-error",
        offset: Literal["none", "constant", "ramp", "auto"] | None = None,
        continues: bool = False,
        threads: int = 1,
    ) -> None:
        self.structure = structure
        self.step = step
        self.orders = orders
        self.method = method
        self.offset = offset
        self.continues = continues
        self.threads = threads

    def fit(self, X: Any, y: Any) -> FractionalRegressor:
        """Identify the structure from rows ordered in time.

        Parameters
        ----------
        X
            Inputs, shape (n, inputs), a row an instant.
        y
            Outputs, shape (n,) or (n, outputs).

        Raises
        ------
        ValueError
            What scikit-learn refuses of arrays; numbers of columns that are not those of the structure.
        DataError, ModelError, ConvergenceError
            See :func:`ftlm.identify`.
        """
        for name, values in (("X", X), ("y", y)):
            as_array(name, values)
        X, y = _validation.validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64, ensure_min_samples=8
        )
        table = np.asarray(y, dtype=np.float64).reshape(len(y), -1)
        wanted = self._structure(X.shape[1], table.shape[1])
        self._inputs = tuple(s for s in wanted.signals if s not in wanted.outputs)
        for what, names, count in (("X", self._inputs, X.shape[1]), ("y", wanted.outputs, table.shape[1])):
            if len(names) != count:
                raise ValueError(f"{what} has {count} columns, and the structure has {len(names)}: {', '.join(names)}")
        run = self._run(X, table, wanted.outputs, "fit")
        self.identification_ = identify(run, wanted, method=self.method, threads=self.threads, offset=self.offset)
        self.model_ = self.identification_.model
        self._fitted, self._flat = X.copy(), np.ndim(y) == 1
        return self

    def predict(self, X: Any) -> Floats:
        """Simulate rows of inputs; returns shape (n,) or (n, outputs), as y had."""
        _validation.check_is_fitted(self)
        as_array("X", X)
        X = _validation.validate_data(self, X, reset=False, dtype=np.float64)
        before = 0
        if self.continues and not np.array_equal(X, self._fitted):
            before = len(self._fitted)
            X = np.concatenate([self._fitted, X])
        rows, outputs = len(X), self.model_.outputs
        # A free run needs a few instants; what is held beyond the last row changes nothing before it.
        X = np.concatenate([X, np.repeat(X[-1:], max(3 - rows, 0), axis=0)])
        run = self._run(X, np.zeros((len(X), len(outputs))), outputs, "predict")
        free = self.model_.simulate(run, initial={o: {} for o in outputs})
        out: Floats = np.stack([free[o] for o in outputs], axis=1)[before:rows]
        return out[:, 0] if self._flat else out

    def _structure(self, inputs: int, outputs: int) -> Structure:
        """Return the structure with the requested orders."""
        if not isinstance(self.structure, (str, Structure)):
            raise ModelError(
                f"structure is {type(self.structure).__name__}; give an equation in words or a structure, or 'auto'"
            )
        if not isinstance(self.structure, str):
            return self.structure.with_orders(self.orders or {})
        words = self.structure
        if words == "auto":
            words = "; ".join(
                f"D^alpha y{k} = a{k} y{k}" + "".join(f" + b{k}_{j} u{j}" for j in range(inputs))
                for k in range(outputs)
            )
        return equation(words, orders=self.orders)

    def _run(self, X: Floats, y: Floats, outputs: tuple[str, ...], name: str) -> Run:
        columns = dict(zip(self._inputs, X.T, strict=True))
        return Run.from_arrays(step=self.step, inputs=columns, outputs=dict(zip(outputs, y.T, strict=True)), name=name)
