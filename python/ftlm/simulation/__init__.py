"""Simulation of fractional-order models."""
