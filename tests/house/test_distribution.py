"""The lists by which tests/support/suite.py distributes test files to workers."""

from tests.support.paths import REPO
from tests.support.suite import FOLDERS_OF_ONE_WORKER, LONGEST, WORKER_OF_FILE


def test_every_listed_file_and_folder_exists():
    listed = {*LONGEST, *FOLDERS_OF_ONE_WORKER, *WORKER_OF_FILE, *WORKER_OF_FILE.values()}
    missing = [path for path in listed if not (REPO / path).exists()]
    assert missing == []
