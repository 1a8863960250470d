"""The report of a processed scan, and its figures and tables.

`write_report` writes the page of a :class:`polysight.products.ProcessedScan`; `write_sync_report` reports the residual
errors of synchronisation. The other names are for single figures of commands and papers.
"""

from polysight.report.figures import draw_channel, draw_focus_figure, draw_overview, label_figure, surface_figure
from polysight.report.report import write_report
from polysight.report.style import INK, MUTED, PALETTE, STAMP_COLOUR, encode_png, figure_label, font_families
from polysight.report.sync_report import QUANTITIES, SyncReport, write_sync_report
