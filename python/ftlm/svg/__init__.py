"""SVG charts and HTML pages from plain data, independent of identification results."""
