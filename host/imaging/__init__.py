"""Imaging: range gate and reduction, three imagers of one contract, illumination, channel images."""

from polysight.host.imaging.direct import backproject, project
from polysight.host.imaging.geometry import ImageGrid, image_grid
from polysight.host.imaging.images import ChannelImages, ImageBuilder

__all__ = ["ChannelImages", "ImageBuilder", "ImageGrid", "backproject", "image_grid", "project"]
