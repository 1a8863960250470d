"""Python interface for notebooks and scripts.

:func:`open_scan` opens recorded data or the products of an earlier run and gives a :class:`Scan`. Its methods `image`,
`patches`, `permittivity`, `permittivity_map`, `probe`, `materials`, `layers`, `surface` return `xarray.Dataset`; `plot`
returns a matplotlib figure. Rows are read and images are formed once, when a result is first requested. A scan writes
nothing to disk unless :meth:`Scan.to_netcdf` or :meth:`Scan.label` is called.

`functions.py` has `plan` and `simulate` for one scan, `compare` for two, and `check` for the check plates of many.
`classifier.py` has `train`, which makes a library of labelled scans, and a `Classifier` with scikit-learn's
conventions. The package `polysight` itself has functions that need no scan (`backproject`, `fresnel`,
`permittivity_from_ratio`, `multilayer`), and also all names of this package except `Rows`.
"""

from polysight.api.scan import Scan, open_scan
from polysight.products import Rows, read_netcdf, write_netcdf

__all__ = ["Rows", "Scan", "open_scan", "read_netcdf", "write_netcdf"]
