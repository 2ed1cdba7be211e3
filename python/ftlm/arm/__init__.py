"""Physics of the flexible two-link arm: structures, models and energies."""
