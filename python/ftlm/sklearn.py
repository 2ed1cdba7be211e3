"""scikit-learn estimator of fractional-order models."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.methods import EstimationMethod
from ftlm.structure.order import Values
from ftlm.structure.parser import equation
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.validation import Floats, as_array

try:
    _base, _validation = (importlib.import_module(f"sklearn.{part}") for part in ("base", "utils.validation"))
except ImportError:
    raise ModelError("scikit-learn is not installed; pip install 'ftlm[sklearn]'") from None


#: Maximum deviation of a step of a data frame's index from the median step, relative to it.
MAX_INDEX_JITTER_SHARE = 0.02


class FractionalRegressor(_base.MultiOutputMixin, _base.RegressorMixin, _base.BaseEstimator):  # type: ignore[misc, name-defined]
    """scikit-learn estimator of a fractional-order model, whose predictions are simulations.

    Parameters
    ----------
    structure
        Equation as text, structure, or ``"auto"`` for D^alpha y0 = a0 y0 + b0_0 u0 + b0_1 u1 … with one alpha for all
        outputs. Columns of several inputs or outputs are selected by name from a data frame, otherwise in the sequence
        in which the signals appear in the structure. ``"auto"`` uses columns in their sequence.
    step
        Time between rows [s].
    orders
        Values of free orders by name: a number fixes the order, ``"0.5:1.5:0.05"`` is its grid; see
        :func:`ftlm.equation`.
    method
        Name of a method, or a method with its options, such as :class:`ftlm.OutputError`; see :func:`ftlm.identify`.
    offset
        Offset as in :func:`ftlm.identify`. It is estimated for the fitted rows and is not part of a prediction.
    continues
        Whether predicted rows follow the fitted ones without a gap, as those of ``TimeSeriesSplit`` without ``gap`` do.
        The simulation then begins with the fitted inputs. The fitted rows themselves are predicted from their start. If
        False, every prediction starts from rest. A gap in the index of a data frame raises an error. Arrays have no
        index, so ``gap`` must be 0 with them.
    threads
        Number of threads of a fit; one by default, because scikit-learn runs several fits in parallel.

    Attributes
    ----------
    identification_ : Identification
        Identification, whose ``verdict`` states whether the model can be trusted.
    model_ : Model
        The model.
    n_features_in_ : int
        Number of inputs.
    """

    @check_arguments
    def __init__(
        self,
        structure: str | Structure = "auto",
        *,
        step: float = 1.0,
        orders: Mapping[str, Values] | None = None,
        method: str | EstimationMethod = "output-error",
        offset: Literal["none", "level", "constant", "ramp", "auto"] | None = None,
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

    @check_arguments
    def fit(self, X: Any, y: Any) -> FractionalRegressor:
        """Identify the structure from rows ordered in time.

        Parameters
        ----------
        X
            Inputs, shape (n, inputs), one row per sample. The index of a data frame, of numbers or dates, must increase
            by the step.
        y
            Outputs, shape (n,) or (n, outputs).

        Raises
        ------
        ValueError
            If scikit-learn rejects an array, the number of columns differs from that of the structure, or the names of
            several columns do.
        DataError, ModelError, ConvergenceError
            See :func:`ftlm.identify`.
        """
        for name, values in (("X", X), ("y", y)):
            as_array(name, values)
        index, columns = _index(X), _columns(y)
        X, y = _validation.validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64, ensure_min_samples=8
        )
        table = np.asarray(y, dtype=np.float64).reshape(len(y), -1)
        structure = self._structure(X.shape[1], table.shape[1])
        inputs = tuple(s for s in structure.signals if s not in structure.outputs)
        for what, names, count in (("X", inputs, X.shape[1]), ("y", structure.outputs, table.shape[1])):
            if len(names) != count:
                raise ValueError(f"{what} has {count} columns; give those of the structure: {', '.join(names)}")
        by_name = not isinstance(self.structure, str) or self.structure != "auto"
        self._inputs = _in_order("X", inputs, getattr(self, "feature_names_in_", None) if by_name else None)
        self._outputs = _in_order("y", structure.outputs, columns if by_name else None)
        self._index = _check_index(index)
        run = self._run(X, table, "fit")
        self.identification_ = identify(run, structure, method=self.method, threads=self.threads, offset=self.offset)
        self.model_ = self.identification_.model
        self._fit_inputs, self._flat = X.copy(), np.ndim(y) == 1
        return self

    @check_arguments
    def predict(self, X: Any) -> Floats:
        """Simulate n rows of inputs; return outputs of shape (n,) or (n, outputs), the same shape as y in ``fit``."""
        _validation.check_is_fitted(self)
        as_array("X", X)
        index = _check_index(_index(X))
        X = _validation.validate_data(self, X, reset=False, dtype=np.float64)
        rows_before = 0
        if self.continues and not np.array_equal(X, self._fit_inputs):
            if index is not None and self._index is not None:
                _check_index(np.concatenate([self._index, index]), len(self._fit_inputs))
            rows_before = len(self._fit_inputs)
            X = np.concatenate([self._fit_inputs, X])
        rows = len(X)
        # A simulation needs a few instants; what is held beyond the last row changes nothing before it.
        X = np.concatenate([X, np.repeat(X[-1:], max(3 - rows, 0), axis=0)])
        run = self._run(X, np.zeros((len(X), len(self._outputs))), "predict")
        free = self.model_.simulate(run, initial={o: {} for o in self._outputs})
        out: Floats = np.stack([free[o] for o in self._outputs], axis=1)[rows_before:rows]
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

    def _run(self, X: Floats, y: Floats, name: str) -> Run:
        inputs, outputs = (dict(zip(n, v.T, strict=True)) for n, v in ((self._inputs, X), (self._outputs, y)))
        return Run.from_arrays(step=self.step, inputs=inputs, outputs=outputs, name=name)


def _columns(table: Any) -> list[str] | None:
    """Return the names of a data frame's columns; None for anything else."""
    names = list(getattr(table, "columns", ()))
    return names if names and all(isinstance(name, str) for name in names) else None


def _in_order(what: str, signals: tuple[str, ...], columns: Sequence[str] | None) -> tuple[str, ...]:
    """Return the signal of each column, by name for several named columns, otherwise by position."""
    if columns is None or len(signals) < 2:
        return signals
    names = tuple(map(str, columns))
    if sorted(names) != sorted(signals):
        raise ValueError(
            f"{what} has the columns {', '.join(names)}, and the structure has {', '.join(signals)}; rename the "
            f"columns, or pass {what}.to_numpy() in the order of the structure"
        )
    return names


def _index(table: Any) -> Floats | None:
    """Return the index of a data frame as numbers; None without an index of numbers or dates."""
    index = getattr(table, "index", None)
    kind = getattr(getattr(index, "dtype", None), "kind", "")
    if kind == "M":
        index = np.asarray(index, dtype="datetime64[ns]").astype(np.int64)
    return np.asarray(index, dtype=np.float64) if kind and kind in "iufM" else None


def _check_index(index: Floats | None, fit_rows: int = 0) -> Floats | None:
    """Return the index of rows; raise DataError if it does not increase by one step."""
    steps = np.diff(index) if index is not None else np.zeros(0)
    usual = float(np.median(steps)) if steps.size else 1.0
    bad = np.flatnonzero(~((steps > 0) & (np.abs(steps - usual) <= MAX_INDEX_JITTER_SHARE * usual)))
    if not bad.size:
        return index
    where = "between the fitted rows and those of X" if fit_rows == bad[0] + 1 else f"after row {bad[0]} of X"
    raise DataError(
        f"the index of X does not increase by one step {where} ({bad.size} such gaps in all), but X must be one "
        "record without gaps; give consecutive rows (gap=0, no shuffling), or reset the index if no row is missing"
    )
