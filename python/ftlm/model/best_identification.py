"""Properties and methods by which results of searches and selections refer to the identification of the best model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ftlm.errors import ModelError

if TYPE_CHECKING:
    import os
    from pathlib import Path

    from ftlm.estimation.result import Identification
    from ftlm.utils.validation import Floats


class BestIdentification:
    """Base class of results with a best model, whose identification is the attribute `best`.

    Properties and methods have the same meaning as in :class:`ftlm.Identification`. They raise ModelError if `best` is
    None.
    """

    best: Any

    @property
    def _identification(self) -> Identification:
        if self.best is None:
            raise ModelError(
                "this result has no identification of its best model; call search_orders with the runs and the store, "
                "or identify the structure"
            )
        best: Identification = self.best
        return best

    @property
    def fit(self) -> dict[str, float]:
        """Fit of the simulation on the estimation runs in percent, by output."""
        return self._identification.fit

    #: Alias of :attr:`fit`, whose name states the unit.
    fit_percent = fit

    @property
    def values(self) -> dict[str, float]:
        """Estimates of the parameters of the best model by name."""
        return self._identification.values

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the parameters of the best model by name; {} for methods that give none."""
        return self._identification.standard_errors

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % confidence intervals (low, high) of the parameters of the best model by name."""
        return self._identification.intervals

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows and columns of ``covariance``."""
        return self._identification.names

    @property
    def covariance(self) -> Floats:
        """Covariance matrix of the parameters in ``names``; see :attr:`ftlm.Identification.covariance`."""
        return self._identification.covariance

    def validate(self, runs: Any) -> Any:
        """Compare the best model with other runs; see :meth:`ftlm.Identification.validate`."""
        return self._identification.validate(runs)

    def summary(self) -> str:
        """Return the text that is printed for the result."""
        return str(self)

    def report(self, path: str | os.PathLike[str], *, validation: Any = None, force: bool = False) -> Path:
        """Write an HTML page about the best model; see :meth:`ftlm.Identification.report`."""
        return self._identification.report(path, validation=validation, force=force)
