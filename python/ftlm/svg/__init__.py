"""SVG charts and HTML pages from plain data; this package does not use identification results."""
