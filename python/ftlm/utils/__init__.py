"""Helper functions of all packages: argument checks, statistics, linear algebra, files, resources, formatting."""
