"""Imaging: range gate and reduction, three imagers of one contract, illumination, channel images."""

from polysight.host.imaging.direct import backproject, project
from polysight.host.imaging.geometry import ImageGrid, image_grid
from polysight.host.imaging.images import ChannelImages, ImageBuilder, SubBandImages
from polysight.host.imaging.resolution import imaging_facts

__all__ = [
    "ChannelImages",
    "ImageBuilder",
    "ImageGrid",
    "SubBandImages",
    "backproject",
    "image_grid",
    "imaging_facts",
    "project",
]
