"""Structures: orders, equations, input non-linearities, sensor filters and their language."""
