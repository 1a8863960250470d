"""Products of processed scans: write a folder of products, read it back, and export it.

`ProcessedScan` is the result of one scan: images, patches, quality, verdict and provenance, read from a folder of
products (`read_products`) or just computed. Reports, pages, exports and notebooks render it. `replace_products` is a
context manager: products are written to a temporary folder, which replaces the old one when all are complete.
`image_dataset`, `patch_dataset` and `full_dataset` are xarray datasets; `export` writes NetCDF, MATLAB and CSV files.
"""

from polysight.products.exports import (
    PLANE_DIMENSIONS as PLANE_DIMENSIONS,
    export as export,
    format_ranges as format_ranges,
    full_dataset as full_dataset,
    image_dataset as image_dataset,
    patch_coordinates as patch_coordinates,
    patch_dataset as patch_dataset,
    permittivity_dataset as permittivity_dataset,
    read_netcdf as read_netcdf,
    surface_dataset as surface_dataset,
    write_netcdf as write_netcdf,
)
from polysight.products.folder import (
    LABELS_PICTURE as LABELS_PICTURE,
    check_products_folder as check_products_folder,
    check_results_folder as check_results_folder,
    find_labels as find_labels,
    find_scan_folder as find_scan_folder,
    label_folder as label_folder,
    lock_products as lock_products,
    replace_products as replace_products,
)
from polysight.products.maps import (
    CHANNELS as CHANNELS,
    QUANTITIES as QUANTITIES,
    Limits as Limits,
    MapValues as MapValues,
    PermittivityMap as PermittivityMap,
    map_images as map_images,
    map_permittivity as map_permittivity,
    map_scan as map_scan,
    percentile as percentile,
    signal_opacity as signal_opacity,
)
from polysight.products.processed import (
    FINISHED as FINISHED,
    IMAGE as IMAGE,
    LABELS as LABELS,
    MATERIALS as MATERIALS,
    QUALITY as QUALITY,
    REPORT as REPORT,
    SCAN as SCAN,
    ProcessedScan as ProcessedScan,
    Rows as Rows,
    find_products as find_products,
    raw_dropped as raw_dropped,
    read_products as read_products,
    rx_gains as rx_gains,
    write_image as write_image,
    write_json as write_json,
)
