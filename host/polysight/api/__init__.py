"""Python interface for notebooks and scripts.

:func:`open_scan` opens recorded data or the products of an earlier run and gives a :class:`Scan`. Its methods `image`,
`patches`, `permittivity`, `permittivity_map`, `probe`, `materials`, `layers`, `surface` return `xarray.Dataset`; `plot`
returns a matplotlib figure. Rows are read and images are formed once, when a result is first asked for, and a scan
writes nothing to disk unless :meth:`Scan.to_netcdf` or :meth:`Scan.label` is called.

`functions.py`: `plan` a scan, `simulate` one, `compare` two, `check` plates of many. `classifier.py`: `train` a library
of labelled scans, and a `Classifier` with scikit-learn's conventions. The functions that need no scan (`backproject`,
`fresnel`, `permittivity_from_ratio`, `multilayer`) are in `polysight` itself. All names here but `Rows` are there, too.
"""

from polysight.api.scan import Scan, open_scan
from polysight.products import Rows, read_netcdf, write_netcdf

__all__ = ["Rows", "Scan", "open_scan", "read_netcdf", "write_netcdf"]
