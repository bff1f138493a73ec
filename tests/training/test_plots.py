"""Pictures of training are drawn, and a run without a log is refused."""

import pytest
import torch
from labelled_scene import make_scene

from corrsfm.errors import InputError
from corrsfm.labelled.compact import write_scenes
from corrsfm.training.plots import plot_distributions, plot_learning_curves
from corrsfm.training.synthetic import draw_both

pytest.importorskip("matplotlib")
PNG = b"\x89PNG"


def test_learning_curves_of_a_run(tmp_path):
    (tmp_path / "log.csv").write_text(
        "step,classification,essential,learning_rate\n"
        + "".join(f"{step},{1 / step},{'' if step < 9 else 0.1},0.001\n" for step in range(1, 30))
    )
    (tmp_path / "validation.csv").write_text("step,auc5,auc10,auc20,baseline_auc5\n10,1,2,3,4\n20,2,3,4,4\n")
    plot_learning_curves(tmp_path, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(PNG)


def test_a_run_without_a_log_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"log\.csv"):
        plot_learning_curves(tmp_path, tmp_path / "curves.png")


def test_a_run_that_logged_nothing_yet_says_so(tmp_path):
    (tmp_path / "recipe.json").write_text("{}")
    with pytest.raises(InputError, match="nothing was logged yet; .*--log-every"):
        plot_learning_curves(tmp_path, tmp_path / "out.png")


def test_page_of_real_and_synthetic_pairs(tmp_path):
    write_scenes(tmp_path / "pairs.h5", [make_scene()])
    real, synthetic = draw_both([tmp_path / "pairs.h5"], 2, num_pairs=4, num_matches=50)
    assert len(real) == len(synthetic) == 2
    # The real pairs of this scene are two thirds right matches at most, whatever the seed.
    assert all(torch.isfinite(batch.distances()[batch.mask]).all() for batch in real)
    plot_distributions(real, synthetic, tmp_path / "page.png")
    assert (tmp_path / "page.png").read_bytes().startswith(PNG)
