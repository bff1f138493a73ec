"""SuperPoint's network against its definition, with random weights."""

import torch

from corrsfm.model.superpoint import CELL, NMS_RADIUS, SuperPoint, _local_maxima, _sample


def test_parameters_are_named_as_published() -> None:
    shapes = {name: tuple(value.shape) for name, value in SuperPoint().state_dict().items()}
    layers = [f"conv{level}{half}" for level in "1234" for half in "ab"]
    layers += ["convPa", "convPb", "convDa", "convDb"]
    assert sorted(shapes) == sorted(f"{layer}.{kind}" for layer in layers for kind in ("weight", "bias"))
    assert shapes["conv1a.weight"] == (64, 1, 3, 3) and shapes["conv4b.weight"] == (128, 128, 3, 3)
    assert shapes["convPb.weight"] == (65, 256, 1, 1) and shapes["convDb.weight"] == (256, 256, 1, 1)


def test_class_of_a_cell_is_its_pixel_by_rows() -> None:
    network = SuperPoint().eval()
    with torch.no_grad():
        network.convPb.weight.zero_()
        network.convPb.bias.zero_()
        network.convPb.bias[10] = 20.0  # row 1, column 2 of every cell
        scores, _ = network(torch.rand(1, 1, 24, 16))
    assert scores.shape == (24, 16)
    assert {(int(y) % CELL, int(x) % CELL) for y, x in torch.nonzero(scores > 0.9)} == {(1, 2)}


def test_only_the_strongest_within_the_radius_stays() -> None:
    scores = torch.zeros(30, 30)
    scores[10, 10], scores[10, 10 + NMS_RADIUS], scores[10, 11 + 2 * NMS_RADIUS] = 0.9, 0.8, 0.7
    assert torch.nonzero(_local_maxima(scores) > 0).tolist() == [[10, 10], [10, 11 + 2 * NMS_RADIUS]]


def test_descriptors_are_interpolated_between_centres_of_cells() -> None:
    coarse = torch.nn.functional.normalize(torch.randn(1, 256, 4, 5), dim=1)
    at_centre = torch.tensor([[2 * CELL + 3.5, CELL + 3.5]])
    torch.testing.assert_close(_sample(coarse, at_centre)[0], coarse[0, :, 1, 2], atol=1e-5, rtol=0)
    between = torch.tensor([[3 * CELL - 0.5, CELL + 3.5]])
    expected = torch.nn.functional.normalize(coarse[0, :, 1, 2] + coarse[0, :, 1, 3], dim=0)
    torch.testing.assert_close(_sample(coarse, between)[0], expected, atol=1e-5, rtol=0)


def test_keypoints_stay_inside_of_a_photo_of_any_size() -> None:
    torch.manual_seed(0)
    network = SuperPoint().eval()
    with torch.no_grad():
        keypoints, scores, descriptors = network.detect(torch.rand(1, 1, 45, 83), 500, 0.0)
    assert 0 < len(keypoints) == len(scores) == len(descriptors)
    assert keypoints[:, 0].min() >= 4 and keypoints[:, 0].max() < 79 and keypoints[:, 1].max() < 41
