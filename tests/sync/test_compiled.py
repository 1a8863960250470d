"""The compiled loops and their NumPy form give equal results, for every vector width of the processor."""

import _ctypes
import logging
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
from tests.support import arm64

from polysight.sync import build, loops as sync_loops, offsets
from polysight.sync.direct_path import prepare
from polysight.sync.high_pass_filter import Equaliser, HighPass, high_pass
from polysight.sync.offsets import AlignedRow, align_in_numpy, align_pieces, align_row

# Bits of a vector: SSE, AVX2 and AVX-512
WIDTHS = (128, 256, 512)

# Samples in which a chirp is linear, as in the published rig
LINEAR = (0, 192)

# Chirps of `draw_bursts` (five positions of six chirps) that were received: all of them
ALL_VALID = np.ones((5, 6), bool)


@pytest.fixture(scope="module")
def library_file(tmp_path_factory):
    """The library in the folder of the sources if it is up to date; otherwise one that is compiled for this test."""
    with suppress(sync_loops.LoadError):
        sync_loops.Library()
        return build.HERE / build.LIBRARY
    if build.find_compiler() is None:
        pytest.skip("no C compiler: apt install gcc, or pip install ziglang")
    return build.build(tmp_path_factory.mktemp("kernels"))


@pytest.fixture(scope="module", params=[*WIDTHS, pytest.param("ARM64", marks=pytest.mark.slow)])
def loops(library_file, tmp_path_factory, request):
    if request.param == "ARM64":
        if not arm64.is_installed():
            pytest.skip(f"no loops on ARM64: apt install {arm64.PACKAGES}")
        return arm64.EmulatedLibrary(tmp_path_factory.mktemp("arm64"))
    if request.param > sync_loops.Library(library_file).bits:
        pytest.skip(f"this processor has no vectors of {request.param} bits")
    return sync_loops.Library(library_file, request.param)


def draw_bursts(positions=5, chirps=6, samples=256, seed=4):
    """Noisy chirps, each with its own frequency and phase: int16 [position, chirp, sample, 2, rx].

    A chirp has two tones, as of direct path and echo, which are 0.12 rad a sample (3.7 bins of 192) apart.
    """
    rng = np.random.default_rng(seed)
    n = np.arange(samples)[:, None]
    shape = (positions, chirps, 1, 1)
    frequency = 0.2 + 0.02 * rng.standard_normal(shape)
    phase_of_rx = np.exp(1j * np.arange(4))
    tone = np.exp(2j * np.pi * (frequency * n + rng.uniform(size=shape))) * phase_of_rx
    both_tones = tone * (1 + 0.6 * np.exp(0.12j * n))
    noisy = both_tones + 0.2 * rng.standard_normal((positions, chirps, samples, 4))
    return np.rint(1000 * np.stack([noisy.real, noisy.imag], axis=3)).astype(np.int16)


def align(by, words, valid, linear, equaliser=None):
    """Align a row in one piece with the loops `by`."""
    return align_pieces([words], valid, linear, equaliser, by=by)


def assert_equal_rows(result: AlignedRow, expected: AlignedRow):
    """Equal within float32 rounding; phases may wrap."""
    np.testing.assert_array_equal(result.good, expected.good)
    np.testing.assert_array_equal(result.clipped, expected.clipped)
    # Silent chirps have no band, so that its middle is arbitrary.
    has_signal = expected.good.any(axis=1)
    np.testing.assert_allclose(result.centre[has_signal], expected.centre[has_signal], rtol=0, atol=1e-6)
    # The tone of a chirp that matches no other one is arbitrary, too.
    usable = (expected.coherence > 0.1) & has_signal[:, None]
    assert result.halves.dtype == expected.halves.dtype
    largest = max(1.0, float(np.abs(expected.halves).max()))
    np.testing.assert_allclose(result.halves, expected.halves, rtol=0, atol=3e-6 * largest)
    np.testing.assert_allclose(result.frequency[usable], expected.frequency[usable], rtol=0, atol=1e-8)
    for name in ("amplitude", "gain", "coherence"):
        np.testing.assert_allclose(getattr(result, name)[usable], getattr(expected, name)[usable], rtol=0, atol=1e-5)
    phase_error = np.exp(1j * result.phase) - np.exp(1j * expected.phase.astype(np.float64))
    np.testing.assert_allclose(phase_error[usable], 0, atol=1e-5)
    np.testing.assert_allclose(result.error, expected.error, rtol=0, atol=2e-5)


def make_equaliser(rig):
    return Equaliser.from_model(high_pass(rig.chirp), rig.chirp, 4)


def assert_aligned_equally(loops, words, valid, linear, equaliser=None):
    """The loops and NumPy align the row equally."""
    result = align(loops.align, words, valid, linear, equaliser)
    assert_equal_rows(result, align(align_in_numpy, words, valid, linear, equaliser))


@pytest.mark.parametrize("value_of_others", [0, 32767], ids=["silent", "clipped"])
def test_one_usable_chirp_is_the_average_wherever_it_is_in_the_burst(loops, value_of_others):
    burst = draw_bursts(positions=3, chirps=1)
    for by in (loops.align, align_in_numpy):
        expected = align(by, burst, np.ones((3, 1), bool), LINEAR)
        for usable_chirp in range(6):
            words = np.full((3, 6, *burst.shape[2:]), value_of_others, np.int16)
            words[:, usable_chirp] = burst[:, 0]
            result = align(by, words, np.ones((3, 6), bool), LINEAR)
            is_usable = np.arange(6) == np.full((3, 1), usable_chirp)
            np.testing.assert_array_equal(result.good, is_usable)
            np.testing.assert_allclose(result.centre, expected.centre, rtol=0, atol=1e-6)
            np.testing.assert_allclose(result.halves, expected.halves, rtol=0, atol=1e-2)


def test_a_row_in_pieces_is_the_same_row(loops):
    words = draw_bursts(7)
    valid = np.ones((7, 6), bool)
    valid[2:4, 1] = False
    memory = np.empty_like(words[:3])

    def read_pieces():
        """Pieces of three positions, in memory that is overwritten after each: it must not be used longer."""
        for i in range(0, 7, 3):
            memory[: 7 - i] = words[i : i + 3]
            yield memory[: 7 - i]
            memory[:] = 0

    in_pieces = align_pieces(read_pieces(), valid, LINEAR, by=loops.align)
    in_one_piece = align(loops.align, words, valid, LINEAR)
    for values, expected in zip(in_pieces, in_one_piece, strict=True):
        np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("positions", [0, 4, 6])
def test_pieces_with_fewer_or_more_positions_than_the_row_are_refused(loops, positions):
    """The row has five."""
    for by in (loops.align, align_in_numpy):
        with pytest.raises(ValueError, match="position"):
            align_pieces([draw_bursts(1)] * positions, ALL_VALID, LINEAR, by=by)


@pytest.mark.parametrize("linear", [(0, 192), (8, 204), (3, 243), (10, 90), (4, 44)])
@pytest.mark.parametrize("filtered", [True, False])
def test_loops_agree_for_any_linear_part(loops, rig, linear, filtered):
    """Beginnings and lengths that are whole blocks of four samples, and others."""
    equaliser = make_equaliser(rig) if filtered else None
    assert_aligned_equally(loops, draw_bursts(), ALL_VALID, linear, equaliser)


@pytest.mark.parametrize(("samples", "linear"), [(255, (0, 192)), (193, (1, 193)), (198, (5, 181)), (37, (0, 36))])
def test_loops_agree_for_any_number_of_samples(loops, rig, samples, linear):
    """The samples here do not fill whole vectors or blocks."""
    words = draw_bursts(samples=samples)
    assert_aligned_equally(loops, words, ALL_VALID, linear, make_equaliser(rig))


@pytest.mark.parametrize("chirps", [1, 2, 3, 16, 19, 40])
def test_loops_agree_for_any_number_of_chirps(loops, rig, chirps):
    """Sixteen are transformed together; a single one has no reference."""
    words = draw_bursts(positions=3, chirps=chirps)
    assert_aligned_equally(loops, words, np.ones((3, chirps), bool), LINEAR, make_equaliser(rig))


def test_loops_agree_for_absent_silent_saturated_and_foreign_chirps(loops, rig):
    words = draw_bursts(positions=7, chirps=8)
    valid = np.ones((7, 8), bool)
    # Three chirps and a whole position are absent.
    valid[0, :3] = False
    valid[1] = False
    # A silent chirp, and two with a sample at the end of the range
    words[2, 4] = 0
    words[3, 2, 100, 1, 3] = 32767
    words[3, 5, 7, 0, 0] = -32768
    # Chirp 0 is usually the reference. This one matches no other chirp, so that another reference is tried.
    rng = np.random.default_rng(3)
    words[4, 0] = rng.integers(-1000, 1000, words[4, 0].shape)
    # More foreign chirps than others; and a silent position
    words[5, :5] = rng.integers(-1000, 1000, words[5, :5].shape)
    words[6] = 0
    aligned = align(loops.align, words, valid, LINEAR, make_equaliser(rig))
    assert_equal_rows(aligned, align(align_in_numpy, words, valid, LINEAR, make_equaliser(rig)))
    assert not aligned.good[1].any()
    assert not aligned.good[6].any()
    assert not aligned.good[3, [2, 5]].any()
    assert not aligned.good[4, 0]
    for values in aligned:
        assert np.isfinite(values).all()


@pytest.mark.parametrize("mode", ["complex1x", "complex2x"])
def test_loops_agree_for_any_filter(loops, mode):
    words = draw_bursts()
    for corners_hz in [(), (175e3,), (700e3, 1400e3), (350e3, 700e3, 2800e3)]:
        equaliser = Equaliser(
            model=HighPass(corners_hz),
            sample_rate_hz=10e6,
            signed=mode == "complex2x",
            spacing=4,
            reach=3 / 192,
        )
        assert_aligned_equally(loops, words, ALL_VALID, LINEAR, equaliser)


def test_loops_agree_for_words_in_another_order_in_memory(loops):
    words = draw_bursts()[:, :, :, ::-1]
    assert not words.flags.c_contiguous
    assert_aligned_equally(loops, words, ALL_VALID, LINEAR)


def test_loops_agree_for_any_number_of_positions_and_none(loops):
    for positions in (0, 1, 17):
        words = draw_bursts(positions=positions)
        valid = np.ones((positions, 6), bool)
        result = align(loops.align, words, valid, LINEAR)
        assert result.halves.shape == (positions, 2, 4, 48)
        if positions:
            assert_equal_rows(result, align(align_in_numpy, words, valid, LINEAR))


def test_loops_agree_on_the_direct_path(loops, rig, paths, noise, counts):
    """In a row with echoes stronger than the direct path, so that the second peak is the direct path at some positions.

    Position 7 has only noise, position 11 is missing.
    """
    board = rig.receivers[0]
    rng = np.random.default_rng(5)
    ideal, _ = paths(board, positions=37, echo=1.5, rng=rng)
    ideal[7] = 0
    phase_of_chirps = np.exp(2j * np.pi * rng.uniform(size=(37, 4, 1, 1)))
    frames = (ideal + noise(ideal.shape, power_db=-20, rng=rng))[:, None] * phase_of_chirps
    words = counts(frames.transpose(2, 0, 1, 3))
    valid = np.ones((37, 4), bool)
    valid[11] = False
    aligned = align(align_in_numpy, words, valid, rig.chirp.linear_samples, make_equaliser(rig))
    path = prepare(rig, board)
    expected = offsets.reference(aligned, path, rig.chirp, sync_loops.NumpyLoops)
    result = offsets.reference(aligned, path, rig.chirp, loops)
    np.testing.assert_array_equal(result.found, expected.found)
    # The law is tested at most positions, but not at 7 and 11.
    assert 30 < result.found.sum() <= 37 - 2
    is_found = result.found
    largest = np.abs(expected.samples).max()
    np.testing.assert_allclose(result.samples, expected.samples, rtol=0, atol=1e-5 * largest)
    np.testing.assert_allclose(result.noise, expected.noise, rtol=1e-5)
    np.testing.assert_allclose(result.frequency[is_found], expected.frequency[is_found], rtol=0, atol=1e-7)
    np.testing.assert_allclose(result.amplitude[is_found], expected.amplitude[is_found], rtol=1e-5)
    # The drift is a small difference of phases: their rounding changes it by 7e-5 (measured).
    assert result.drift == pytest.approx(expected.drift, rel=1e-3, abs=1e-10)


@pytest.mark.parametrize("size", [16, 64, 256])
def test_loops_agree_on_peaks_and_medians_of_any_spectrum(loops, size):
    """Random numbers instead of a signal; one position is silent."""
    rng = np.random.default_rng(size)
    halves = (rng.standard_normal((35, 2, 4, 16)) + 1j * rng.standard_normal((35, 2, 4, 16))).astype(np.complex64)
    halves[3] = 0
    weights = (rng.standard_normal((4, 16)) + 1j * rng.standard_normal((4, 16))).astype(np.complex64)
    estimator = (rng.standard_normal((3, 64)) + 1j * rng.standard_normal((3, 64))).astype(np.complex64)
    arguments = {
        "size": size,
        "object_bins": (3, 9),
        "comparable": 0.35,
        "steering": np.ones((4, 16), np.complex64),
        "estimator": estimator,
        "steps": 0,
    }
    result = loops.find(halves, weights, **arguments)
    expected = sync_loops.NumpyLoops.find(halves, weights, **arguments)
    np.testing.assert_array_equal(result.peaks, expected.peaks)
    np.testing.assert_array_equal(result.frequency, expected.peaks[0])
    np.testing.assert_allclose(result.median, expected.median, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(result.estimate, expected.estimate, rtol=1e-4, atol=1e-3)


def test_three_receivers_are_aligned_in_numpy():
    words = draw_bursts()[..., :3]
    assert align_row(words, ALL_VALID, LINEAR).good.all()


def test_the_compiled_loops_are_used_if_available(library_file, monkeypatch):
    library = sync_loops.Library(library_file)
    monkeypatch.setattr(sync_loops, "load_library", lambda: library)
    # Calling the form in NumPy would fail.
    monkeypatch.setattr("polysight.sync.offsets.align_in_numpy", None)
    assert align_row(draw_bursts(), ALL_VALID, LINEAR).good.all()


@pytest.fixture
def fresh_library():
    """The library is loaded once per process: it is forgotten before and after the test."""
    sync_loops._load.cache_clear()
    yield
    sync_loops._load.cache_clear()


@pytest.mark.usefixtures("fresh_library")
@pytest.mark.parametrize("broken", ["absent", "of other sources", "no library", "truncated", "foreign", "a pipe"])
def test_without_compiled_loops_there_is_one_warning(library_file, tmp_path, monkeypatch, caplog, broken):
    file = tmp_path / build.LIBRARY
    if broken == "of other sources":
        shutil.copyfile(library_file, file)
        monkeypatch.setattr(build, "source_digest", lambda: "another")
    elif broken == "no library":
        file.write_text("text", encoding="utf-8")
    elif broken == "truncated":
        file.write_bytes(library_file.read_bytes()[:30000])
    elif broken == "foreign":
        # A library without our functions
        shutil.copyfile(_ctypes.__file__, file)
    elif broken == "a pipe":
        os.mkfifo(file)
    library_class = sync_loops.Library
    monkeypatch.setattr(sync_loops, "Library", lambda: library_class(file))
    with caplog.at_level(logging.WARNING), ThreadPoolExecutor(3) as pool:
        # Three threads load it at the same time.
        for row in pool.map(lambda _: align_row(draw_bursts(), ALL_VALID, LINEAR), range(3)):
            assert row.good.all()
    (record,) = caplog.records
    assert "python -m polysight.sync.build" in record.getMessage()


def test_the_build_command_does_not_import_itself_twice():
    """`python -m polysight.sync.build` would warn if importing the package imported this module."""
    # The exit status is 1 if the module was imported.
    code = "import sys, polysight.sync; sys.exit('polysight.sync.build' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_failing_compiler_is_an_error_with_its_command(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "false")
    with pytest.raises(build.BuildError, match="false"):
        build.build(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_system_s_compiler_is_preferred_unless_cc_names_another(monkeypatch, tmp_path):
    (tmp_path / "cc").write_text("#!/bin/sh\n", encoding="utf-8")
    (tmp_path / "cc").chmod(0o755)
    assert build.find_compiler({"PATH": str(tmp_path)}) == [str(tmp_path / "cc")]
    assert build.find_compiler({"PATH": str(tmp_path), "CC": "ccache gcc"}) == ["ccache", "gcc"]
    # Without a compiler in the path, and without ziglang
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert build.find_compiler({"PATH": str(tmp_path / "nothing")}) is None
