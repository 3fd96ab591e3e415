"""Drawings of charts, ladder diagrams and function block diagrams as SVG."""
