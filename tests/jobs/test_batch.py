"""Batch processing: scans do not affect each other, finished ones are skipped, and a table ends the output."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.support.products import write_judged_products
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig
from tests.support.scenes import make_scene
from tests.support.store.plain_scan import write_scan

from polysight.cli.main import main
from polysight.jobs import batch
from polysight.process import count_cores
from polysight.products.processed import FINISHED
from polysight.settings import Settings
from polysight.store import ScanFolder, drop
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_simulators.scene import decode_scene, simulate

# Exit status of a batch in which a scan failed
A_SCAN_FAILED = 1
# Program in place of the one that processes a scan: it ends as the name of the scan says. Jobs are plain data, so that
# it does not import the host's program, which takes seconds.
WORKER = """
import json, os, sys, time
from pathlib import Path
import msgpack
job = msgpack.unpackb(sys.stdin.buffer.read())
out = Path(job["products"])
out.mkdir(parents=True, exist_ok=True)
with (out.parent / "runs.txt").open("a") as f:
    f.write(out.name + "\\n")
if out.name == "bad":
    sys.exit("no row is recorded whole\\n  why: it is bad\\n  do: nothing")
if out.name == "killed":
    os.kill(os.getpid(), 9)
if out.name == "slow":
    time.sleep(600)
for name in ("image.npz", "quality.json"):
    (out / name).write_text("{}")
(out / ".finished.json").write_text(json.dumps({"made_with": job["made_with"], "memory_gb": 0.5}))
if out.name == "late":
    os.kill(os.getpid(), 9)
"""

# Lines in place of the sleep: the first time the program kills the worker that has started it.
KILLS_ITS_WORKER = """
    told = out.parent / "killed"
    if not told.exists():
        told.write_text("")
        os.kill(os.getppid(), 9)
        os.read(int(os.environ["POLYSIGHT_PARENT_ALIVE"]), 1)
        sys.exit("the worker is gone")"""


@pytest.fixture
def worker(tmp_path, monkeypatch):
    """WORKER is the program that processes a scan."""
    file = tmp_path / "worker.py"
    file.write_text(WORKER)
    monkeypatch.setattr(batch, "WORKER_COMMAND", (sys.executable, str(file)))


def make_scans(folder, *names):
    """Make folders of published data, with nothing but their settings; return their paths."""
    for name in names:
        (folder / name).mkdir(parents=True)
        (folder / name / "data_collection_cfg.json").write_text('{"total_x": 5, "total_y": 4}')
    return [folder / n for n in names]


def make_job(data, out, **options):
    """Return the job of one scan with these settings."""
    text = {key: str(value) if isinstance(value, Path) else value for key, value in options.items()}
    (job,) = batch.make_jobs([(data, Settings(**text))], out)
    return job


def make_jobs(folder, *names):
    """Return the jobs of the scans in a folder, which must have these names."""
    scans_found = batch.find_scans([folder])
    assert sorted(p.name for p in scans_found) == sorted(names)
    return batch.make_jobs([(data, Settings()) for data in scans_found], folder.parent / "out")


def read_runs(folder):
    """Return the names of the scans that WORKER was started for."""
    return sorted((folder / "out" / "runs.txt").read_text().split())


@pytest.mark.usefixtures("worker")
def test_a_failing_scan_stops_no_other_and_a_second_run_processes_unfinished_scans_only(tmp_path, capsys):
    names = ("a", "bad", "c", "killed")
    make_scans(tmp_path / "in", *names)
    first = batch.process_many(make_jobs(tmp_path / "in", *names), tmp_path / "out", 2)
    assert {o.name: o.status for o in first} == {"a": "done", "bad": "failed", "c": "done", "killed": "failed"}
    assert [o.name for o in first] == list(names)
    messages = {o.name: o.message for o in first}
    assert messages["bad"] == "no row is recorded whole"
    assert "signal 9" in messages["killed"]
    assert first[0].memory_gb == 0.5
    assert read_runs(tmp_path) == sorted(names)
    summary = json.loads((tmp_path / "out" / "processed.json").read_text())
    assert [s["status"] for s in summary["scans"]] == ["done", "failed", "done", "failed"]

    second_run = batch.process_many(make_jobs(tmp_path / "in", *names), tmp_path / "out", 2)
    assert [o.status for o in second_run] == ["skipped", "failed", "skipped", "failed"]
    assert read_runs(tmp_path) == sorted([*names, "bad", "killed"])
    assert "2 finished before, 2 to process" in capsys.readouterr().err


@pytest.mark.usefixtures("worker")
def test_a_program_that_was_killed_after_its_last_file_has_finished_its_scan(tmp_path):
    """The last file, `.finished.json`, marks a scan as finished."""
    make_scans(tmp_path / "in", "late")
    (job,) = make_jobs(tmp_path / "in", "late")
    assert batch.run_scan(job).status == "done"


@pytest.mark.usefixtures("worker")
def test_a_changed_option_library_rig_or_scan_is_processed_again(tmp_path):
    (folder,) = make_scans(tmp_path / "in", "a")
    library = tmp_path / "library.npz"
    rig = tmp_path / "rig.toml"
    library.write_bytes(b"1")
    rig.write_text("1")

    def job(config=rig, **changes):
        options = {"library": library, "config": config, **changes}
        return make_job(folder, tmp_path / "out", **options)

    assert not batch.is_finished(job())
    batch.process_many([job()], tmp_path / "out", 1)
    assert batch.is_finished(job())
    for change in ({"metal_box_mm": (0.0, 0.0, 1.0, 1.0)}, {"library": None}, {"config": None}):
        assert not batch.is_finished(job(**change)), change
    (folder / "RH").mkdir()
    for path in (library, rig, folder / "RH" / "0_0.bin"):
        earlier_content = path.read_bytes() if path.exists() else b""
        path.write_bytes(b"2")
        assert not batch.is_finished(job()), path
        path.write_bytes(earlier_content)
    (folder / "RH" / "0_0.bin").unlink()
    assert batch.is_finished(job())
    (tmp_path / "out" / "a" / "image.npz").unlink()
    assert not batch.is_finished(job())
    batch.process_many([job()], tmp_path / "out", 1, again=True)
    (tmp_path / "out" / "a" / FINISHED).write_text("[1]")
    assert not batch.is_finished(job())


@pytest.mark.usefixtures("worker")
def test_a_scan_is_processed_again_only_after_a_change_of_its_data(tmp_path):
    """Notes, programs of the page, exports and labels are not data; manifest, rows, calibration and truth are."""
    folder = write_scan(tmp_path / "in" / "scan")
    sample_file = folder / "samples" / "RH.npy"
    batch.process_many(make_jobs(tmp_path / "in", "scan"), tmp_path / "out", 1)

    def is_finished():
        (job,) = make_jobs(tmp_path / "in", "scan")
        return batch.is_finished(job)

    no_data = ("operator.json", "program/process.log", "export/image.nc", "labels.json", "control/request.json")
    for name in (*no_data, "products/report.html", "samples/RH.npy", "raw/RH/0004.part"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("new")
        assert is_finished(), name
    for name in ("manifest.jsonl", "raw/RH/0000.bin", "raw/RV/0001.idx", "truth.json"):
        file = folder / name
        file.parent.mkdir(exist_ok=True)
        earlier_content = file.read_bytes() if file.exists() else None
        times = file.stat().st_mtime_ns if file.exists() else 0
        with file.open("a") as appended:
            appended.write("\n")
        assert not is_finished(), name
        if earlier_content is None:
            file.unlink()
        else:
            file.write_bytes(earlier_content)
            os.utime(file, ns=(times, times))
        assert is_finished(), name
    drop(ScanFolder.load(folder), read_raw_digests(folder), tmp_path / "out" / "scan")
    batch.process_many(make_jobs(tmp_path / "in", "scan"), tmp_path / "out", 1)
    assert is_finished()
    # Without raw data the samples are the data.
    sample_file.write_text("other samples")
    assert not is_finished()


def read_raw_digests(folder):
    """Return the digests of the committed rows, by board and row."""
    committed = ScanFolder.load(folder).committed_rows()
    return {name: {row: take.boards[name].crc32 for row, take in committed.items()} for name in ("RH", "RV")}


@pytest.mark.usefixtures("worker")
def test_when_a_batch_ends_early_its_programs_end_too(tmp_path):
    make_scans(tmp_path / "in", "slow", "slow2")
    todo = make_jobs(tmp_path / "in", "slow", "slow2")
    results = batch.run_here(todo, 2)
    # WORKER sleeps for "slow" only.
    first = next(results)
    assert (first.name, first.status) == ("slow2", "done")
    # Ends the program of the other scan and waits for it. Without an end it would sleep for 600 s.
    results.close()
    assert not batch.is_finished(todo[0])


def test_scans_are_found_in_folders_and_two_of_one_name_are_refused(tmp_path):
    scans_found = make_scans(tmp_path / "unsynced", "s1", "s2")
    (tmp_path / "unsynced" / "notes").mkdir()
    raw = tmp_path / "raw" / "s1"
    raw.mkdir(parents=True)
    (raw / "RH_synced.npy").touch()
    assert batch.find_scans([tmp_path / "unsynced"]) == scans_found
    assert batch.find_scans([raw, scans_found[1]]) == [raw, scans_found[1]]
    assert batch.find_scans([tmp_path / "nowhere"]) == [tmp_path / "nowhere"]
    products = write_judged_products(tmp_path / "products", "good")
    assert batch.find_scans([products]) == [products]
    with expect_refusal(ErrorCode.NAME_TAKEN, "s1"):
        batch.make_jobs([(scans_found[0], Settings()), (raw, Settings())], tmp_path / "out")


def test_as_many_scans_are_processed_together_as_cores_and_memory_allow():
    # docs/how-to/authors-data.md has these figures: 0.4 GB, and 6 kB for each position.
    assert batch.memory_bytes(1_000_000) == pytest.approx(0.4e9 + 6e3 * 1_000_000)
    needed_bytes = batch.memory_bytes(70_000)
    assert batch.fit_scans(70_000, cores=8, free_bytes=100 * needed_bytes) == 8
    assert batch.fit_scans(70_000, cores=8, free_bytes=3 * needed_bytes) == 2
    assert batch.fit_scans(70_000, cores=8, free_bytes=0) == 1
    assert batch.free_memory_bytes() > 0
    assert count_cores() >= 1


def test_the_table_names_every_scan_and_counts(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "quality.json").write_text('{"boards": {"RH": {"positions": 200, "positions_masked": 3}}}')
    (tmp_path / "a" / "materials.json").write_text('{"segments": [{"label": 1}, {"label": 2}]}')
    text = batch.format_table(
        [
            batch.Outcome("a", "done", seconds=61.0, memory_gb=0.54),
            batch.Outcome("b", "failed", seconds=2.0, memory_gb=0.0, message="broken"),
        ],
        tmp_path,
    )
    head, a, b, end = text.splitlines()
    assert head.split() == ["scan", "result", "seconds", "memory", "masked", "patches"]
    assert a.split() == ["a", "done", "61", "0.5", "GB", "1.5", "%", "2"]
    assert b.split() == ["b", "failed", "2", "broken"]
    assert "2 scans: 1 done, 1 failed" in end


@pytest.mark.usefixtures("worker")
def test_a_wrong_folder_fails_and_the_exit_status_shows_it(tmp_path, capsys):
    make_scans(tmp_path / "in", "a", "bad")
    command = ["process", str(tmp_path / "in" / "a"), str(tmp_path / "in" / "bad"), "--out", str(tmp_path / "out")]
    assert main([*command, "--jobs", "1"]) == A_SCAN_FAILED
    assert "2 scans: 1 done, 1 failed" in capsys.readouterr().out
    # A single scan is processed by this program, and its error is not that of a batch.
    single = ["process", str(tmp_path / "in" / "a")]
    assert main([*single, "--out", str(tmp_path / "one")]) != 0
    assert "out/one" not in capsys.readouterr().out
    (tmp_path / "file").touch()
    both = [*single, str(tmp_path / "in" / "bad")]
    assert main([*both, "--out", str(tmp_path / "file")]) == ConfigError.exit_status


def test_without_dask_the_command_that_installs_it_is_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "dask", None)
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    make_scans(tmp_path / "in", "a")
    command = ["process", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--dask", "tcp://127.0.0.1:1"]
    assert main(command) == ConfigError.exit_status
    assert "pip install distributed" in capsys.readouterr().err


@pytest.mark.usefixtures("worker")
def test_a_dask_cluster_does_the_same(tmp_path):
    distributed = pytest.importorskip("distributed", reason="the host's extra `dask` is not installed")
    make_scans(tmp_path / "in", "a", "bad", "c")
    todo = make_jobs(tmp_path / "in", "a", "bad", "c")
    # Threads of this process replace the workers; each still starts its own programs.
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0", protocol="tcp"
    ) as cluster:
        outcomes = batch.process_many(todo, tmp_path / "out", 1, dask=cluster.scheduler_address)
    assert [o.status for o in outcomes] == ["done", "failed", "done"]
    assert all(batch.is_finished(j) == (j.name != "bad") for j in todo)
    with expect_refusal(ErrorCode.NO_ANSWER):
        list(batch.run_on_dask(todo, "tcp://127.0.0.1:9", timeout="1s"))


@pytest.mark.usefixtures("worker")
def test_a_scan_that_is_marked_as_finished_is_done_and_not_processed_again(tmp_path):
    """If a Dask worker is killed after it has finished a scan, the scan is sent to another worker."""
    make_scans(tmp_path / "in", "a")
    (job,) = make_jobs(tmp_path / "in", "a")
    assert [batch.run_scan(job).status for _ in range(3)] == ["done"] * 3
    assert (tmp_path / "out" / "runs.txt").read_text() == "a\n"
    second_run = batch.process_many([job], tmp_path / "out", 1, again=True)
    assert [o.status for o in second_run] == ["done"]
    assert (tmp_path / "out" / "runs.txt").read_text() == "a\na\n"


# Program that starts the program of a job, which writes its process id and sleeps.
STARTER = """
import sys
from pathlib import Path
from polysight.jobs import batch
child = "from polysight.jobs import batch; import os, sys, time;" \
    "batch.exit_with_parent(os.environ[batch.PARENT_PIPE_VARIABLE]);" \
    "open(sys.argv[1], 'w').write(str(os.getpid())); time.sleep(600)"
batch.WORKER_COMMAND = (sys.executable, "-c", child, sys.argv[2])
batch.run_scan(batch.make_jobs([(Path(sys.argv[1]), batch.Settings())], Path(sys.argv[1] + "-out"))[0])
"""


def test_the_program_of_a_killed_worker_ends_with_it(tmp_path):
    make_scans(tmp_path / "in", "a")
    pid_file = tmp_path / "pid"
    starter = subprocess.Popen([sys.executable, "-c", STARTER, str(tmp_path / "in" / "a"), str(pid_file)])
    try:
        while not (pid_file.exists() and pid_file.read_text()):
            assert starter.poll() is None
            time.sleep(0.1)
        child = Path("/proc") / pid_file.read_text()
        assert child.exists()
    finally:
        starter.kill()
        starter.wait()
    # The child has ended, or is a zombie (Z) that no process has waited for.
    while child.exists() and "State:\tZ" not in (child / "status").read_text():
        time.sleep(0.1)


@pytest.mark.slow
def test_a_killed_dask_worker_loses_no_scan(tmp_path):
    """One of two workers is killed while it processes; its nanny starts another one, and every scan is done."""
    distributed = pytest.importorskip("distributed", reason="the host's extra `dask` is not installed")
    import dask

    (tmp_path / "worker.py").write_text(WORKER.replace("time.sleep(600)", KILLS_ITS_WORKER))
    preload = tmp_path / "preload.py"
    preload.write_text(
        "from polysight.jobs import batch\n"
        f"batch.WORKER_COMMAND = ({sys.executable!r}, {str(tmp_path / 'worker.py')!r})\n"
    )
    names = ("a", "b", "slow", "c")
    make_scans(tmp_path / "in", *names)
    todo = make_jobs(tmp_path / "in", *names)
    with (
        dask.config.set({"distributed.worker.preload": [str(preload)]}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", protocol="tcp"
        ) as cluster,
    ):
        outcomes = batch.process_many(todo, tmp_path / "out", 1, dask=cluster.scheduler_address)
    assert {o.name: o.status for o in outcomes} == dict.fromkeys(names, "done")
    assert (tmp_path / "out" / "runs.txt").read_text().split().count("slow") == 2


def test_the_real_program_processes_a_simulated_scan_and_refuses_a_damaged_one(tmp_path, capsys):
    """The second run skips the finished one."""
    plate = {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [60.0, 60.0], "metal": True}
    scene = make_scene(plate, name="plate", columns=13, rows=15, image={"columns": 30, "rows": 30, "pixel_mm": 4.0})
    simulate(load_published_rig(), decode_scene(scene, "t"), tmp_path, layout="authors")
    broken = tmp_path / "unsynced" / "broken"
    broken.mkdir()
    (broken / "data_collection_cfg.json").write_text("{")
    command = ["process", str(tmp_path / "unsynced"), "--out", str(tmp_path / "out")]
    assert main(command) == A_SCAN_FAILED
    output = capsys.readouterr().out
    assert "broken  failed" in output
    assert "not JSON" in output
    assert "plate   done" in output
    assert (tmp_path / "out" / "plate" / "report.html").exists()
    mark = json.loads((tmp_path / "out" / "plate" / FINISHED).read_text())
    assert {"versions", "products", "options", "data"} == set(mark["made_with"])
    # The digest of the rig file, SHA-256 in hexadecimal.
    assert len(mark["made_with"]["options"]["config"]) == 64
    (broken / "data_collection_cfg.json").unlink()
    assert main(command) == 0
    assert "1 skipped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "positions"),
    [('{"total_x": 5, "total_y": 7}', 35), ('{"total_x": 5}', 70_000), ("[", 70_000), (None, 70_000)],
)
def test_positions_are_those_of_the_settings_or_of_the_published_grid(content, positions, tmp_path):
    """The number of positions decides how many scans are processed together.

    Faults of the settings are reported by the scan's program.
    """
    if content is not None:
        (tmp_path / "data_collection_cfg.json").write_text(content)
    assert batch._count_positions(tmp_path) == positions
