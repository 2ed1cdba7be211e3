"""Physics of the flexible two-link arm: structures of its equations, models and energies."""
