"""The tests themselves: how they are handed out to workers."""

from __future__ import annotations

from types import SimpleNamespace

from tests.support.paths import REPO
from tests.support.suite import FIRST, ROOMS, TOGETHER, ByFile, longest_first


class _Worker:
    """Takes what a worker of pytest-xdist is sent."""

    shutting_down = False

    def __init__(self) -> None:
        self.indices: list[int] = []
        self.gateway = SimpleNamespace(id="gw")

    def send_runtest_some(self, indices: list[int]) -> None:
        self.indices += indices

    def shutdown(self) -> None:
        self.shutting_down = True


def handed_out(tests: list[str], workers: int) -> list[list[str]]:
    """What each worker gets when all are equally fast."""
    option = SimpleNamespace(loadscopereorder=True, tx=["popen"] * workers, numprocesses=workers, px=[])
    scheduler = ByFile(SimpleNamespace(option=option, getvalue=lambda name: getattr(option, name)))  # type: ignore[arg-type]
    started_workers = [_Worker() for _ in range(workers)]
    for worker in started_workers:
        scheduler.add_node(worker)  # type: ignore[arg-type]
        scheduler.add_node_collection(worker, tests)  # type: ignore[arg-type]
    scheduler.schedule()
    done = dict.fromkeys(range(workers), 0)
    while any(done[n] < len(worker.indices) for n, worker in enumerate(started_workers)):
        for n, worker in enumerate(started_workers):
            if done[n] < len(worker.indices):
                scheduler.mark_test_complete(worker, worker.indices[done[n]])  # type: ignore[arg-type]
                done[n] += 1
    return [[tests[i] for i in worker.indices] for worker in started_workers]


def test_a_files_tests_run_in_one_worker_and_each_once():
    tests = [f"tests/a/test_{file}.py::test_law[{n}]" for file in "abcdef" for n in range(5)]
    tests += [f"{file}::test" for file in sorted({*TOGETHER, *TOGETHER.values()})]
    tests += [f"{room}/test_{file}.py::test" for room in ROOMS for file in "ab"]
    got = handed_out(tests, 3)
    assert sorted(test for worker in got for test in worker) == sorted(tests)
    files = [{test.partition("::")[0] for test in worker} for worker in got]
    assert not files[0] & files[1] | files[1] & files[2] | files[2] & files[0]
    assert all(files)
    for file, partner in TOGETHER.items():
        assert any({file, partner} <= worker for worker in files)
    for room in ROOMS:
        assert sum(any(file.startswith(room) for file in worker) for worker in files) == 1


def test_the_longest_files_go_first_and_the_others_stay_in_order():
    ids = ["tests/z.py::b", "tests/z.py::a", f"{FIRST[1]}/test_b.py::x", "tests/a.py::c", f"{FIRST[0]}::y"]
    items = [SimpleNamespace(nodeid=i) for i in ids]
    longest_first(items)  # type: ignore[arg-type]
    assert [i.nodeid for i in items] == [ids[4], ids[2], ids[0], ids[1], ids[3]]


def test_what_is_named_is_there():
    assert [f for f in {*FIRST, *ROOMS, *TOGETHER, *TOGETHER.values()} if not (REPO / f).exists()] == []
