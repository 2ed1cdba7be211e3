"""Physics of the flexible two-link arm."""
