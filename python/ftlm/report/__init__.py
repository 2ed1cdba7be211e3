"""Reports: one HTML file with tables and charts that opens offline."""

from ftlm.report.html_report import identification_page, model_page
from ftlm.svg.html_page import Section, Table, write_page

__all__ = ["Section", "Table", "identification_page", "model_page", "write_page"]
