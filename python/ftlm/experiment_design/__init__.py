"""Experiment design: optimal inputs for the identification of parameters."""
