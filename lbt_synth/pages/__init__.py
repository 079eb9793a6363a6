"""Pages that people read: what is on them, and the files that they become."""

from lbt_synth.pages.blocks import Cell, Listing, Notice, Page, Paragraph, Section, Table
from lbt_synth.pages.charts import Area, Axis, Bars, Chart, Curve, Map, Panel, Rule, Span
from lbt_synth.pages.html import page_html
from lbt_synth.pages.pdf import page_pdf

__all__ = [
    "Area",
    "Axis",
    "Bars",
    "Cell",
    "Chart",
    "Curve",
    "Listing",
    "Map",
    "Notice",
    "Page",
    "Panel",
    "Paragraph",
    "Rule",
    "Section",
    "Span",
    "Table",
    "page_html",
    "page_pdf",
]
