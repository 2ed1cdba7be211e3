"""Structure selection: candidates, cross-validation, ranking and choice."""
