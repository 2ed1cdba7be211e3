"""Drawing that knows no result: text, axes, lines, heat maps, tables, pages."""
