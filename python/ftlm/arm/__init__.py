"""The two-link arm's physics."""
