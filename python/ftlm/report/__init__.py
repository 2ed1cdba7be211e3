"""Reports: one HTML file with tables and charts that opens offline, and the same tables for a terminal."""

from ftlm.fit.recursion import trace_chart
from ftlm.identification.landscape import correlated_orders, output_error_landscape
from ftlm.identification.page import identification_page, settings_table
from ftlm.judge.charts import (
    compared_bars,
    comparison_charts,
    error_chart,
    input_charts,
    pulse_times,
    residual_charts,
    residual_series,
)
from ftlm.judge.comparison import errors_table, initial_terms_table
from ftlm.model.charts import bode_charts, pole_charts, response_charts
from ftlm.model.typesetting import equation_html, parameter_table
from ftlm.paint.bars import bar_chart, histogram
from ftlm.paint.figure import Figure
from ftlm.paint.heat import Landscape, heat_map
from ftlm.paint.lines import line_chart
from ftlm.paint.matrix import correlation_map
from ftlm.paint.page import Section, write_page
from ftlm.paint.plane import plane_chart
from ftlm.paint.table import Table
from ftlm.paint.text import Exact, symbol
from ftlm.paper.rows import PaperRow, paper_row, paper_table, paper_table_text
from ftlm.report.model_page import model_page
from ftlm.search.orders import landscape
from ftlm.search.result import search_summary, search_top

__all__ = [
    "Exact", "Figure", "Landscape", "PaperRow", "Section", "Table", "bar_chart", "bode_charts", "compared_bars",
    "comparison_charts", "correlated_orders", "correlation_map", "equation_html", "error_chart", "errors_table",
    "heat_map", "histogram", "identification_page", "initial_terms_table", "input_charts", "landscape",
    "line_chart", "model_page", "output_error_landscape", "paper_row", "paper_table", "paper_table_text",
    "parameter_table", "plane_chart", "pole_charts", "pulse_times", "residual_charts", "residual_series",
    "response_charts", "search_summary", "search_top", "settings_table", "symbol", "trace_chart", "write_page",
]  # fmt: skip
