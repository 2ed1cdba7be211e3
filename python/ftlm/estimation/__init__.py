"""From runs to a model: estimators called, results judged and reported."""
