"""Reports: one HTML file with tables and charts that opens offline, and the same tables for a terminal."""

from ftlm.fit.recursion import trace_chart
from ftlm.identification.landscape import correlated_orders, output_error_landscape
from ftlm.identification.page import identification_page, settings_table
from ftlm.judge.charts import comparison_charts, error_chart, pulse_times, residual_charts
from ftlm.judge.comparison import errors_table, initial_terms_table
from ftlm.model.charts import bode_charts
from ftlm.model.typesetting import equation_html, parameter_table
from ftlm.paint.figure import Figure
from ftlm.paint.heat import Landscape, heat_map
from ftlm.paint.lines import line_chart
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import Exact, symbol
from ftlm.paper.rows import PaperRow, paper_row, paper_table, paper_table_text
from ftlm.report.model_page import model_page
from ftlm.search.orders import landscape
from ftlm.search.result import search_summary, search_top

__all__ = [
    "Exact", "Figure", "Landscape", "PaperRow", "Section", "Table", "bode_charts", "comparison_charts",
    "correlated_orders", "equation_html", "error_chart", "errors_table", "heat_map", "identification_page",
    "initial_terms_table", "landscape", "line_chart", "model_page", "output_error_landscape", "paper_row",
    "paper_table", "paper_table_text", "parameter_table", "pulse_times", "residual_charts", "search_summary",
    "search_top", "settings_table", "symbol", "trace_chart", "write_page",
]  # fmt: skip
