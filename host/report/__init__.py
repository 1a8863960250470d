"""The report and the product files."""

from polysight.host.products.files import plain, read_image, write_atomically, write_image, write_json
from polysight.host.report.context import ReportContext, context_of
from polysight.host.report.figures import banner_png, figures
from polysight.host.report.report import write_report

__all__ = [
    "ReportContext",
    "banner_png",
    "context_of",
    "figures",
    "plain",
    "read_image",
    "write_atomically",
    "write_image",
    "write_json",
    "write_report",
]
