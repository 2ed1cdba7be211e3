"""HTML reports with tables and charts. Each report is a single file, which can be opened offline."""

from ftlm.report.html_report import identification_page, model_page
from ftlm.svg.html_page import Section, Table, write_page

__all__ = ["Section", "Table", "identification_page", "model_page", "write_page"]
