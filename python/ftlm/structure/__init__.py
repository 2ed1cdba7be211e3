"""Structures: orders, equations, input nonlinearities, sensor filters and their language."""
