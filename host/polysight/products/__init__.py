"""Products of processed scans: write a folder of products, read it back, and export it.

`ProcessedScan` is the result of one scan: images, patches, quality, verdict and provenance, read from a folder of
products (`read_products`) or just computed. Reports, pages, exports and notebooks render it. `making_products` is a
context manager: products are written to a temporary folder, which replaces the old one when all are complete.
`image_dataset`, `patch_dataset` and `full_dataset` are xarray datasets; `export` writes NetCDF, MATLAB and CSV files.
"""

from polysight.products.exports import (
    PLANE,
    export,
    full_dataset,
    image_dataset,
    patch_coordinates,
    patch_dataset,
    permittivity_dataset,
    ranges_text,
    read_netcdf,
    surface_dataset,
    write_netcdf,
)
from polysight.products.folder import (
    LABELS_PICTURE,
    check_products_folder,
    find_labels,
    find_scan_folder,
    label_folder,
    making_products,
    products_locked,
)
from polysight.products.maps import (
    CHANNELS,
    QUANTITIES,
    Limits,
    MapValues,
    map_images,
    map_scan,
    percentile,
    signal_opacity,
)
from polysight.products.permittivity_map import PermittivityMap, map_permittivity
from polysight.products.processed import (
    FINISHED,
    IMAGE,
    LABELS,
    MATERIALS,
    QUALITY,
    REPORT,
    SCAN,
    ProcessedScan,
    Rows,
    find_products,
    raw_dropped,
    read_products,
    rx_gains,
    write_image,
    write_json,
)

__all__ = [
    "CHANNELS",
    "FINISHED",
    "IMAGE",
    "LABELS",
    "LABELS_PICTURE",
    "MATERIALS",
    "PLANE",
    "QUALITY",
    "QUANTITIES",
    "REPORT",
    "SCAN",
    "Limits",
    "MapValues",
    "PermittivityMap",
    "ProcessedScan",
    "Rows",
    "check_products_folder",
    "export",
    "find_labels",
    "find_products",
    "find_scan_folder",
    "full_dataset",
    "image_dataset",
    "label_folder",
    "making_products",
    "map_images",
    "map_permittivity",
    "map_scan",
    "patch_coordinates",
    "patch_dataset",
    "percentile",
    "permittivity_dataset",
    "products_locked",
    "ranges_text",
    "raw_dropped",
    "read_netcdf",
    "read_products",
    "rx_gains",
    "signal_opacity",
    "surface_dataset",
    "write_image",
    "write_json",
    "write_netcdf",
]
