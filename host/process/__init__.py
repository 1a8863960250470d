"""What one scan goes through between its rows and its products.

`ProcessRequest` is what was asked, as plain data; `Options` the same with its files read. `Quality` collects figures
while rows are processed; `save_images` and `save_materials` write the products.
"""

from polysight.host.process.judge import error_budget, judge, recording_verdict
from polysight.host.process.quality import Quality
from polysight.host.process.request import DrawnBoxes, Options, ProcessRequest
from polysight.host.process.save import (
    Findings,
    Products,
    coverage_lines,
    materials_content,
    save_images,
    save_materials,
)

__all__ = [
    "DrawnBoxes",
    "Findings",
    "Options",
    "ProcessRequest",
    "Products",
    "Quality",
    "coverage_lines",
    "error_budget",
    "judge",
    "materials_content",
    "recording_verdict",
    "save_images",
    "save_materials",
]
