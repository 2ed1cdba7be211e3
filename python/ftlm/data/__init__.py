"""Records: orders, equations, structures, runs."""
