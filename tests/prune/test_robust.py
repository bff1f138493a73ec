import numpy as np
from two_view_pairs import make_pair

from corrsfm.geometry import essential_from_pose
from corrsfm.prune.robust import msac_scores, sampson_errors_px
from corrsfm.types import TwoViewModel


def test_models_of_different_kinds_are_compared_in_pixels():
    labelled = make_pair(seed=1, num=100, inlier_ratio=1.0, noise_px=1.0)
    pair = labelled.as_correspondences()
    inverse = np.linalg.inv(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    essential = TwoViewModel(
        kind="essential", matrix=essential_from_pose(labelled.rotation, labelled.translation)
    )
    fundamental = TwoViewModel(kind="fundamental", matrix=inverse.T @ essential.matrix @ inverse)
    np.testing.assert_allclose(
        sampson_errors_px(fundamental, pair), sampson_errors_px(essential, pair), rtol=1e-3, atol=1e-3
    )


def test_msac_scores_fall_from_one_to_zero_at_the_threshold():
    np.testing.assert_allclose(
        msac_scores(np.array([0.0, 2.0, 4.0, 9.0, np.inf]), 4.0), [1.0, 0.75, 0.0, 0.0, 0.0]
    )
