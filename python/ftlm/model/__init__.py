"""Models, their parameters and their files."""
