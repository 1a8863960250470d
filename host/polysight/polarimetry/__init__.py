"""Polarimetry: from the H and V images to reflection and permittivity.

`calibrate` divides the images by a metal region in the scene, a `PlaneReference` by a metal plate from another scan.
`correct_leakage` removes cross-polar leakage; `estimate_leakage_from_images` finds it in images of metal at two
orientations. `incidence_choice` gives the incidence angle of each pixel. `fresnel` and `multilayer` compute the
reflection of a material, `permittivity_from_ratio` the permittivity from a polarisation ratio (Eq. 2 and 3 of the
POLySIGHT paper).
"""

from polysight.polarimetry.calibrate import (
    Leakage as Leakage,
    PlaneReference as PlaneReference,
    calibrate as calibrate,
    correct_leakage as correct_leakage,
    divide_by_metal as divide_by_metal,
    estimate_leakage_from_images as estimate_leakage_from_images,
    inverse_spread as inverse_spread,
    measure_metal_gains as measure_metal_gains,
    plane_reference as plane_reference,
    ratio as ratio,
    remove_leakage as remove_leakage,
    smooth as smooth,
    with_ratio as with_ratio,
)
from polysight.polarimetry.fresnel import (
    Incidence as Incidence,
    IncidenceChoice as IncidenceChoice,
    brewster_angle_rad as brewster_angle_rad,
    fresnel as fresnel,
    incidence_choice as incidence_choice,
    incidence_on_planes as incidence_on_planes,
    multilayer as multilayer,
    permittivity_from_ratio as permittivity_from_ratio,
    ratio_from_permittivity as ratio_from_permittivity,
    specular_incidence_rad as specular_incidence_rad,
)
