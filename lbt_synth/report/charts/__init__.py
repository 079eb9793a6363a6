"""Figures described once, drawn by matplotlib for files and by Bokeh for pages."""
