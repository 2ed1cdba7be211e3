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


#: Maximum deviation of a step of a data frame's index from the median step, as a fraction of the median step.
MAX_INDEX_JITTER_FRACTION = 0.02


class FractionalRegressor(_base.MultiOutputMixin, _base.RegressorMixin, _base.BaseEstimator):  # type: ignore[misc, name-defined]
    """scikit-learn estimator of a fractional-order model, whose predictions are simulations.

    Parameters
    ----------
    structure
        Equation as text, structure, or ``"auto"`` for D^alpha y0 = a0 y0 + b0_0 u0 + b0_1 u1 … with one alpha for all
        outputs. The columns of a data frame with several inputs or outputs are assigned to the signals by name. Columns
        of arrays are assigned in the sequence of the signals in the structure. ``"auto"`` uses columns in their
        sequence.
    step
        Sampling interval, the time between rows [s].
    orders
        Values of free orders by name. A number fixes the order, and text such as ``"0.5:1.5:0.05"`` defines its grid;
        see :func:`ftlm.equation`.
    method
        Name of a method, or a method with its options, such as :class:`ftlm.OutputError`; see :func:`ftlm.identify`.
    offset
        Offset as in :func:`ftlm.identify`. It is estimated for the fitted rows and is not part of a prediction.
    continues
        Whether the rows to predict follow the fitted rows without a gap, as those of ``TimeSeriesSplit`` with
        ``gap=0``. The simulation then starts at the first fitted row, with the fitted inputs. If the rows to predict
        are the fitted rows, only these are simulated. If False, every prediction has zero initial conditions. A gap in
        the index of a data frame raises an error. A gap between arrays cannot be detected.
    threads
        Number of threads of a fit; 1 by default, because scikit-learn runs several fits in parallel.

    Attributes
    ----------
    identification_ : Identification
        Result of the identification. Its ``verdict`` states whether the model can be used.
    model_ : Model
        Identified model.
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
        """Identify the model from rows in ascending time, and return the estimator itself.

        Parameters
        ----------
        X
            Inputs, shape (n, inputs), one row per sample. If a data frame has an index of numbers or dates, it must
            increase by equal steps.
        y
            Outputs, shape (n,) or (n, outputs).

        Raises
        ------
        ValueError
            If scikit-learn rejects an array, the number of columns differs from the number of signals in the structure,
            or the names of several columns differ from those of the signals.
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
        for argument, names, count in (("X", inputs, X.shape[1]), ("y", structure.outputs, table.shape[1])):
            if len(names) != count:
                raise ValueError(f"{argument} has {count} columns; give those of the structure: {', '.join(names)}")
        by_name = not isinstance(self.structure, str) or self.structure != "auto"
        self._inputs = _signals_by_column("X", inputs, getattr(self, "feature_names_in_", None) if by_name else None)
        self._outputs = _signals_by_column("y", structure.outputs, columns if by_name else None)
        self._index = _check_index(index)
        run = self._run(X, table, "fit")
        self.identification_ = identify(run, structure, method=self.method, threads=self.threads, offset=self.offset)
        self.model_ = self.identification_.model
        self._fit_inputs, self._is_vector = X.copy(), np.ndim(y) == 1
        return self

    @check_arguments
    def predict(self, X: Any) -> Floats:
        """Simulate the model on n rows of inputs, and return the outputs.

        The shape is (n,) if `y` in :meth:`fit` had one dimension, otherwise (n, outputs). Raise DataError if the index
        of a data frame has a gap.
        """
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
        # A simulation needs at least three samples. Repeating the last row does not change the earlier outputs.
        X = np.concatenate([X, np.repeat(X[-1:], max(3 - rows, 0), axis=0)])
        run = self._run(X, np.zeros((len(X), len(self._outputs))), "predict")
        free = self.model_.simulate(run, initial={o: {} for o in self._outputs})
        out: Floats = np.stack([free[o] for o in self._outputs], axis=1)[rows_before:rows]
        return out[:, 0] if self._is_vector else out

    def _structure(self, inputs: int, outputs: int) -> Structure:
        """Return the structure for the numbers of input and output columns, with the requested orders.

        Raise ModelError for a structure that is neither text nor a Structure.
        """
        if not isinstance(self.structure, (str, Structure)):
            raise ModelError(
                f"structure is {type(self.structure).__name__}; give an equation as text, or a structure, or 'auto'"
            )
        if not isinstance(self.structure, str):
            return self.structure.with_orders(self.orders or {})
        text = self.structure
        if text == "auto":
            text = "; ".join(
                f"D^alpha y{k} = a{k} y{k}" + "".join(f" + b{k}_{j} u{j}" for j in range(inputs))
                for k in range(outputs)
            )
        return equation(text, orders=self.orders)

    def _run(self, X: Floats, y: Floats, name: str) -> Run:
        inputs, outputs = (dict(zip(n, v.T, strict=True)) for n, v in ((self._inputs, X), (self._outputs, y)))
        return Run.from_arrays(step=self.step, inputs=inputs, outputs=outputs, name=name)


def _columns(table: Any) -> list[str] | None:
    """Return the column names of a data frame; None for other objects, or if a name is not text."""
    names = list(getattr(table, "columns", ()))
    return names if names and all(isinstance(name, str) for name in names) else None


def _signals_by_column(argument: str, signals: tuple[str, ...], columns: Sequence[str] | None) -> tuple[str, ...]:
    """Return the name of the signal in each column. Several named columns are matched by name, all others by position.

    Raise ValueError if the column names are not the signal names; `argument` ("X" or "y") is named in the message.
    """
    if columns is None or len(signals) < 2:
        return signals
    names = tuple(map(str, columns))
    if sorted(names) != sorted(signals):
        raise ValueError(
            f"{argument} has the columns {', '.join(names)}, and the structure has {', '.join(signals)}; rename the "
            f"columns, or pass {argument}.to_numpy() in the order of the structure"
        )
    return names


def _index(table: Any) -> Floats | None:
    """Return the index of a data frame as numbers, with dates in ns; None without an index of numbers or dates."""
    index = getattr(table, "index", None)
    kind = getattr(getattr(index, "dtype", None), "kind", "")
    if kind == "M":
        index = np.asarray(index, dtype="datetime64[ns]").astype(np.int64)
    return np.asarray(index, dtype=np.float64) if kind and kind in "iufM" else None


def _check_index(index: Floats | None, fit_rows: int = 0) -> Floats | None:
    """Return the index unchanged; raise DataError unless it increases by equal steps.

    `fit_rows` is the number of fitted rows at the start of the index, for the message.
    """
    steps = np.diff(index) if index is not None else np.zeros(0)
    median_step = float(np.median(steps)) if steps.size else 1.0
    bad = np.flatnonzero(~((steps > 0) & (np.abs(steps - median_step) <= MAX_INDEX_JITTER_FRACTION * median_step)))
    if not bad.size:
        return index
    where = "between the fitted rows and those of X" if fit_rows == bad[0] + 1 else f"after row {bad[0]} of X"
    raise DataError(
        f"the index of X does not increase by one step {where} ({bad.size} such gaps in all), but X must be one "
        "record without gaps; give consecutive rows (gap=0, no shuffling), or reset the index if no row is missing"
    )
