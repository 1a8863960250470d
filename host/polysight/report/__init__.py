"""The report of a processed scan, its figures and tables, and exports for other programs.

`context_of` collects the content of a report, `write_report` writes the page; `write_sync_report` reports the residual
errors of synchronisation; `export` writes HDF5, MATLAB, NetCDF, Zarr, PNG and CSV from saved products; `write_cphd`
writes a scan's phase history for other SAR processors.
"""

from polysight.report.context import ReportContext, classifier_sentence, context_of
from polysight.report.cphd import Channel as CphdChannel
from polysight.report.cphd import PhaseHistory, write_cphd
from polysight.report.exports import export, export_folder
from polysight.report.figures import draw_channel, draw_overview, figures, focus_figure, label_figure
from polysight.report.report import write_report
from polysight.report.style import INK, MUTED, PALETTE, STAMP, extent_mm, figure_label, font_families, png
from polysight.report.sync_report import QUANTITIES, SyncReport, write_sync_report

__all__ = [
    "INK",
    "MUTED",
    "PALETTE",
    "QUANTITIES",
    "STAMP",
    "CphdChannel",
    "PhaseHistory",
    "ReportContext",
    "SyncReport",
    "classifier_sentence",
    "context_of",
    "draw_channel",
    "draw_overview",
    "export",
    "export_folder",
    "extent_mm",
    "figure_label",
    "figures",
    "focus_figure",
    "font_families",
    "label_figure",
    "png",
    "write_cphd",
    "write_report",
    "write_sync_report",
]
