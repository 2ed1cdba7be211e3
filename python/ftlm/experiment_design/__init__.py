"""Experiment design: inputs with which the parameters of a model are identified most precisely."""
