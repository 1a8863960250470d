"""Polarimetry: from the H and V images to reflection and permittivity.

`calibrate` divides the images by a metal region in the scene, a `PlaneReference` by a metal plate from another scan.
`correct_leakage` removes cross-polar leakage; `leakage_from_images` estimates it from metal at two orientations.
`incidence_choice` gives the incidence angle of each pixel. `fresnel` and `multilayer` compute the reflection of a
material, `permittivity_from_ratio` the permittivity from a polarisation ratio (Eq. 2 and 3 of the paper).
"""

from polysight.polarimetry.calibrate import (
    Leakage,
    PlaneReference,
    calibrate,
    correct_leakage,
    divide_by_metal,
    inverse_spread,
    leakage_from_images,
    metal_gains,
    plane_reference,
    ratio,
    remove_leakage,
    smooth,
    with_ratio,
)
from polysight.polarimetry.fresnel import (
    Incidence,
    IncidenceChoice,
    brewster_angle_rad,
    fresnel,
    incidence_choice,
    multilayer,
    permittivity_from_ratio,
    ratio_from_permittivity,
    specular_incidence_rad,
)

__all__ = [
    "Incidence",
    "IncidenceChoice",
    "Leakage",
    "PlaneReference",
    "brewster_angle_rad",
    "calibrate",
    "correct_leakage",
    "divide_by_metal",
    "fresnel",
    "incidence_choice",
    "inverse_spread",
    "leakage_from_images",
    "metal_gains",
    "multilayer",
    "permittivity_from_ratio",
    "plane_reference",
    "ratio",
    "ratio_from_permittivity",
    "remove_leakage",
    "smooth",
    "specular_incidence_rad",
    "with_ratio",
]
