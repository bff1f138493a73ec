"""Candidates mapped side by side."""

from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
from synthetic_database import synthesize

from corrsfm.errors import DatabaseError
from corrsfm.reconstruction.candidates import Candidate, MapperKind
from corrsfm.reconstruction.pool import CandidatePool
from corrsfm.reconstruction.views import views_of

CANDIDATES = [Candidate(mapper=kind, seed=1) for kind in (MapperKind.GLOBAL, MapperKind.RELAXED)]


def test_the_number_of_processes_changes_no_model(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")
    found = {}
    for num_processes in (1, 2):
        folder = tmp_path / str(num_processes)
        with CandidatePool(tmp_path / "database.db", folder, num_processes=num_processes) as pool:
            found[num_processes] = pool.map(CANDIDATES)
        assert sorted(path.name for path in folder.iterdir()) == sorted(c.name for c in CANDIDATES)
    for one, other in zip(found[1], found[2], strict=True):
        assert one is not None and other is not None
        for view, again in zip(views_of(one).values(), views_of(other).values(), strict=True):
            np.testing.assert_array_equal(view.rotation, again.rotation)
            np.testing.assert_array_equal(view.translation, again.translation)


def test_candidates_are_mapped_all_the_same_when_their_processes_die(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    synthesize(tmp_path / "database.db")
    with CandidatePool(tmp_path / "database.db", tmp_path / "work", num_processes=2) as pool:
        monkeypatch.setattr(pool._executor, "map", _broken)
        models = pool.map(CANDIDATES)
    assert [model.num_reg_images() for model in models if model is not None] == [8, 8]
    assert "one at a time" in caplog.text


def _broken(function, jobs):
    raise BrokenProcessPool("a child died")


@pytest.mark.parametrize("num_processes", [1, 2])
def test_a_missing_database_is_an_error_that_names_it(tmp_path: Path, num_processes: int) -> None:
    missing = tmp_path / "no folder/database.db"
    with (
        CandidatePool(missing, tmp_path / "work", num_processes=num_processes) as pool,
        pytest.raises(DatabaseError, match="no folder/database.db"),
    ):
        pool.map(CANDIDATES)
