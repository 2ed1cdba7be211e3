"""Estimation of fractional-order models from measured data."""
