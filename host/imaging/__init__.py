"""Imaging: range gate and reduction, three imagers of one contract, illumination, channel images."""

from host.imaging.direct import backproject, project
from host.imaging.grid import ImageGrid, image_grid
from host.imaging.images import ChannelImages, ImageBuilder

__all__ = ["ChannelImages", "ImageBuilder", "ImageGrid", "backproject", "image_grid", "project"]
