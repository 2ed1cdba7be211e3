"""Reports: one HTML file with tables and charts that opens offline, and the same tables for a terminal."""

from ftlm.report.figures import Figure, comparison_charts, error_chart, line_chart, pulse_times, trace_chart
from ftlm.report.page import Section, identification_page, write_page
from ftlm.report.tables import (
    Exact,
    PaperRow,
    Table,
    equation_html,
    errors_table,
    initial_terms_table,
    paper_row,
    paper_table,
    paper_table_text,
    parameter_table,
    search_summary,
    search_top,
    settings_table,
    symbol,
)

__all__ = [
    "Exact",
    "Figure",
    "PaperRow",
    "Section",
    "Table",
    "comparison_charts",
    "equation_html",
    "error_chart",
    "errors_table",
    "identification_page",
    "initial_terms_table",
    "line_chart",
    "paper_row",
    "paper_table",
    "paper_table_text",
    "parameter_table",
    "pulse_times",
    "search_summary",
    "search_top",
    "settings_table",
    "symbol",
    "trace_chart",
    "write_page",
]
