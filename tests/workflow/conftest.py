from dataclasses import dataclass
from pathlib import Path

import pytest
from workplace import HERE, Workplace


@dataclass
class Undisturbed:
    """A finished run: the place it was made in, now empty again, a copy of it all, and traces."""

    place: Workplace
    finished: Workplace
    traces: Path


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory) -> Undisturbed:
    """One run of everything in ``smallest.yaml``, two jobs at a time."""
    root = tmp_path_factory.mktemp("undisturbed")
    for name in ("run", "traces"):
        (root / name).mkdir()
    place = Workplace(root / "run", HERE / "smallest.yaml")
    place.warm, place.trace = True, root / "traces"
    place.run("all", cores=2)
    place.warm, place.trace = False, None
    finished = place.copy(root / "finished")
    place.empty()
    return Undisturbed(place, finished, root / "traces")
