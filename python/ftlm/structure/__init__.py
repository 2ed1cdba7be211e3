"""Structures: orders, equations, input non-linearities and sensor filters, and the syntax of equation texts."""
