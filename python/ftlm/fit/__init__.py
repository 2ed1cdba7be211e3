"""Estimators: from records to numbers with intervals."""
