from polysight.host.report.tables import imaging_table, quality_tables

BOARD = {
    "masked_positions": 12,
    "rows_without_data": 0,
    "loss_db": 0.0437,
    "frequencies": 10,
    "point_width_mm": [7.512, 5.1],
    "point_limit_mm": [5.4, 3.6],
    "point_paper_mm": [2.8, None],
}


def test_the_imaging_table_has_a_column_for_each_board_and_says_what_is_unknown():
    table = imaging_table({"RH": BOARD, "RV": {"masked_positions": 70000}, "notices": ["RV: imaging by direct sum"]})
    assert table["head"] == ["Board", "RH", "RV"]
    cells = {row["cells"][0]: row["cells"][1:] for row in table["rows"]}
    assert cells["Positions masked"] == ["12", "70000"]
    assert cells["Point response at half power, x × y (mm)"] == ["7.51 × 5.1", "–"]
    assert cells["The paper's r λ / L, x × y (mm)"] == ["2.8 × –", "–"]
    assert "direct sum" in table["caption"]


def test_it_is_part_of_the_quality_tables_and_absent_without_data():
    tables = quality_tables({"imaging": {"RH": BOARD}})
    assert any("Imaging" in t["caption"] for t in tables)
    assert imaging_table(None) is None
    assert imaging_table({}) is None
