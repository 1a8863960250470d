"""What one scan goes through between its rows and its products.

`ProcessRequest` is what was asked, as plain data; `Options` the same with its files read. `Quality` collects figures
while rows are processed, `KeptSamples` their reduced samples; `save_images` and `save_materials` write the products.
"""

from polysight.host.process.judge import error_budget, judge, recording_verdict
from polysight.host.process.quality import Quality
from polysight.host.process.request import DrawnBoxes, Options, ProcessRequest
from polysight.host.process.rows import cores, each_row, of_each
from polysight.host.process.samples import Choices, KeptSamples
from polysight.host.process.save import (
    Findings,
    Products,
    Tell,
    coverage_lines,
    materials_content,
    quality_content,
    save_images,
    save_materials,
    untold,
)

__all__ = [
    "Choices",
    "DrawnBoxes",
    "Findings",
    "KeptSamples",
    "Options",
    "ProcessRequest",
    "Products",
    "Quality",
    "Tell",
    "cores",
    "coverage_lines",
    "each_row",
    "error_budget",
    "judge",
    "materials_content",
    "of_each",
    "quality_content",
    "recording_verdict",
    "save_images",
    "save_materials",
    "untold",
]
