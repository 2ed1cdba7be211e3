"""Charts of results: matplotlib figures, for papers, and SVG charts, for reports.

Every function for matplotlib figures accepts axes as ``ax=``. Functions for SVG charts have the prefix ``svg_``.
"""

from ftlm.estimation.cost_surface import correlated_orders
from ftlm.estimation.cost_surface import output_error_landscape as svg_output_error_landscape
from ftlm.estimation.linear import trace_chart as svg_trace_chart
from ftlm.order_search.search import landscape as svg_landscape
from ftlm.plot.comparison_charts import compared_bars as svg_compared_bars
from ftlm.plot.comparison_charts import comparison_charts as svg_comparison_charts
from ftlm.plot.comparison_charts import error_chart as svg_error_chart
from ftlm.plot.comparison_charts import input_charts as svg_input_charts
from ftlm.plot.comparison_charts import residual_charts as svg_residual_charts
from ftlm.plot.comparison_charts import residual_series as svg_residual_series
from ftlm.plot.matplotlib_figures import (
    bode,
    correlation,
    design,
    fit,
    impulse,
    landscape,
    models,
    nyquist,
    poles,
    residual_series,
    residuals,
    response,
    run,
    step,
)
from ftlm.plot.model_charts import bode_charts as svg_bode_charts
from ftlm.plot.model_charts import pole_charts as svg_pole_charts
from ftlm.plot.model_charts import response_charts as svg_response_charts
from ftlm.svg.charts import BarChart, CorrelationMap, PlaneChart
from ftlm.svg.charts import histogram as svg_histogram
from ftlm.svg.line_chart import LineChart

__all__ = [
    "BarChart",
    "CorrelationMap",
    "LineChart",
    "PlaneChart",
    "bode",
    "correlated_orders",
    "correlation",
    "design",
    "fit",
    "impulse",
    "landscape",
    "models",
    "nyquist",
    "poles",
    "residual_series",
    "residuals",
    "response",
    "run",
    "step",
    "svg_bode_charts",
    "svg_compared_bars",
    "svg_comparison_charts",
    "svg_error_chart",
    "svg_histogram",
    "svg_input_charts",
    "svg_landscape",
    "svg_output_error_landscape",
    "svg_pole_charts",
    "svg_residual_charts",
    "svg_residual_series",
    "svg_response_charts",
    "svg_trace_chart",
]
