"""The catalogue of the literature: its values, its sources, and which names are of one material."""

import math
from collections import Counter

import pytest
from tests.support.refusals import expect_refusal

from polysight import materials
from polysight.cli.main import main
from polysight_shared.errors import ErrorCode
from polysight_shared.tables import read_toml

# Permittivity of the vacuum (CODATA 2018).
VACUUM_F_PER_M = 8.8541878128e-12

# ITU-R P.2040-4, Table 3. With f in GHz, eps' = a f^b and the conductivity is c f^d S/m: a, b, c, d, and the lowest and
# highest frequency in GHz.
ITU = {
    "concrete": (5.24, 0, 0.0462, 0.7822, 1, 100),
    "brick": (4.15, 0, 0.0006, 1.5712, 110, 330),
    "plasterboard": (2.73, 0, 0.0085, 0.9395, 1, 100),
    "wood": (1.99, 0, 0.0047, 1.0718, 0.001, 100),
    "window glass": (6.31, 0, 0.0036, 1.3394, 0.1, 100),
    "clear acrylic": (2.58, 0, 0.0001, 1.6524, 110, 330),
    "ceiling board": (1.48, 0, 0.0011, 1.0750, 1, 100),
    "chipboard": (2.58, 0, 0.0217, 0.7800, 1, 100),
    "plywood": (1.94, 0, 0.0067, 0.9982, 110, 330),
    "marble": (7.074, 0, 0.0055, 0.9262, 1, 60),
    "floorboard": (3.66, 0, 0.0044, 1.3515, 50, 100),
    "vinyl tile": (3.62, 0, 0.0051, 0.8422, 1, 40),
    "carpet tile": (2.08, 0, 0.0009, 0.8200, 1, 40),
    "asphalt concrete": (4.83, 0, 0.0108, 1.3969, 1, 40),
}


def look_up(name: str) -> tuple[complex, float]:
    """Return permittivity and frequency in GHz of a material of the catalogue."""
    material = materials.find_material(name)
    assert material is not None, name
    return material.permittivity, material.frequency_hz / 1e9


def compute_debye_water(water_c: float, ghz: float) -> complex:
    """Return the permittivity of water by ITU-R P.527-6, as in Liebe, Hufford, Manabe (1991).

    Two relaxations, each with its frequency: the permittivity falls from its static value to a middle one, and from
    that to the one at high frequencies.
    """
    inverse_temperature = 300 / (water_c + 273.15) - 1
    static_eps = 77.66 + 103.3 * inverse_temperature
    middle_eps = 0.0671 * static_eps
    high_eps = 3.52 - 7.52 * inverse_temperature
    slow_ghz = 20.20 - 146.4 * inverse_temperature + 316 * inverse_temperature**2
    fast_ghz = 39.8 * slow_ghz
    slow_part = (static_eps - middle_eps) / (1 + 1j * ghz / slow_ghz)
    fast_part = (middle_eps - high_eps) / (1 + 1j * ghz / fast_ghz)
    return slow_part + fast_part + high_eps


def test_values_are_of_passive_dielectrics_at_millimetre_waves():
    # Vacuum has eps' = 1, the densest material of the catalogue 13. Millimetre waves end at 300 GHz. `spread` is the
    # relative standard deviation of eps' and of eps'' between specimens; the largest is 1.5.
    for material in materials.load_catalogue():
        assert 1 < material.permittivity.real < 20, material
        assert material.permittivity.imag <= 0, material
        assert 10e9 <= material.frequency_hz <= 300e9, material
        assert all(0 < spread < 2 for spread in material.spread), material


def test_no_name_or_alias_is_of_two_materials():
    names = Counter(materials.normalise_name(name) for m in materials.load_catalogue() for name in (m.name, *m.aliases))
    assert [name for name, count in names.items() if count > 1] == []
    for material in materials.load_catalogue():
        for name in (material.name, *material.aliases):
            assert materials.find_material(name) is material


def test_every_source_is_used_and_every_value_has_one():
    listed = read_toml(materials.CATALOGUE)["sources"]
    assert {source.key for m in materials.load_catalogue() for source in m.sources} == set(listed)
    assert all(material.sources for material in materials.load_catalogue())
    # Author, title and year take more than 40 characters: a source is more than a key word.
    assert all(len(text) > 40 for text in listed.values())


@pytest.mark.parametrize("name", ITU)
def test_building_materials_follow_the_recommendation(name):
    a, b, c, d, lowest_ghz, highest_ghz = ITU[name]
    eps, ghz = look_up(name)
    assert lowest_ghz <= ghz <= highest_ghz
    loss = c * ghz**d / (2 * math.pi * VACUUM_F_PER_M * ghz * 1e9)
    # The catalogue's numbers are rounded to three digits.
    assert eps == pytest.approx(a * ghz**b - 1j * loss, rel=3e-3)


@pytest.mark.parametrize("celsius", [0, 5, 20, 37])
def test_water_is_the_double_debye_formula(celsius):
    eps, ghz = look_up(f"water at {celsius} degrees")
    # The catalogue's numbers are rounded to three digits.
    assert eps == pytest.approx(compute_debye_water(celsius, ghz), rel=3e-3)


def test_aliases_and_generic_names_are_of_one_material_and_two_of_its_kinds_are_not():
    assert materials.is_same_material("Acrylic (3 mm)", "PMMA")
    assert materials.is_same_material("PCB", "FR4")
    assert materials.is_same_material("glass fibre", "fr-4")
    assert materials.is_same_material("rubber", "RUBBER")
    assert materials.is_same_material("water", "water at 37 degrees")
    assert materials.is_same_material("glass", "borosilicate glass")
    assert materials.is_same_material("wood", "plywood")
    assert not materials.is_same_material("plywood", "chipboard")
    assert not materials.is_same_material("copper", "PTFE")
    assert not materials.is_same_material("own mixture 7", "own mixture 8")


def test_whether_two_names_are_of_one_material_does_not_depend_on_their_order():
    names = ["wood", "plywood", "PMMA", "acrylic", "glass", "Pyrex", "water", "copper", "cardboard (rough)"]
    for first_name in names:
        assert materials.is_same_material(first_name, first_name)
        for second_name in names:
            assert materials.is_same_material(first_name, second_name) == materials.is_same_material(
                second_name, first_name
            )


def test_a_material_without_a_spread_has_the_default_of_its_kind(tmp_path):
    line = 'real = 2.0, loss = 0.1, ghz = 77, source = ["Own"], kind = "felt"'
    text = f'materials = [{{ name = "a", {line} }}, {{ name = "b", spread = [0.01, 0.2], {line} }}]\n'
    path = tmp_path / "catalogue.toml"
    path.write_text(text + '[sources]\nOwn = "Own"\n[kinds]\nfelt = { generic = ["textile"], spread = [0.1, 0.5] }\n')
    default, own_spread = materials.read_catalogue(path)
    assert default.spread_is_default
    assert default.spread == (0.1, 0.5)
    assert not own_spread.spread_is_default
    assert own_spread.spread == (0.01, 0.2)


def test_a_missing_or_damaged_catalogue_and_an_unlisted_kind_or_source_are_refused(tmp_path):
    path = tmp_path / "catalogue.toml"
    with expect_refusal(ErrorCode.FILE_MISSING, path):
        materials.read_catalogue(path)
    path.write_text("materials = [")
    with expect_refusal(ErrorCode.FILE_DAMAGED, path):
        materials.read_catalogue(path)
    line = '{ name = "a", real = 2.0, loss = 0.1, ghz = 77, source = ["Nobody"], kind = "felt" }'
    path.write_text(f"materials = [{line}]\n[sources]\n[kinds]\n")
    with expect_refusal(ErrorCode.KEY_MISSING, path, "felt"):
        materials.read_catalogue(path)
    path.write_text(f"materials = [{line}]\n[sources]\n[kinds]\nfelt = {{ generic = [], spread = [0.1, 0.5] }}\n")
    with expect_refusal(ErrorCode.KEY_MISSING, path, "Nobody"):
        materials.read_catalogue(path)


@pytest.mark.parametrize("arguments", [[], ["--catalogue", "scans/one"]])
def test_the_command_takes_scans_or_the_catalogue(arguments, capsys):
    assert main(["materials", *arguments]) != 0
    assert "--catalogue" in capsys.readouterr().err
