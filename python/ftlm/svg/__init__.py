"""SVG and HTML drawing, independent of results: charts, tables, pages."""
