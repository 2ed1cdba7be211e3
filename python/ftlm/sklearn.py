"""An estimator for scikit-learn."""

from ftlm.identification.regressor import FractionalRegressor

__all__ = ["FractionalRegressor"]
