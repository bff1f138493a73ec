"""Why mapping made no model, from the graph of verified pairs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pycolmap

__all__ = ["PairGraph", "read_pair_graph", "why_no_model"]


@dataclass(frozen=True)
class PairGraph:
    """Counts of the pairs of a database; the dicts map COLMAP's pair ids to numbers above zero."""

    names: dict[int, str]
    num_recorded: int
    num_matches: dict[int, int]
    num_inliers: dict[int, int]


def read_pair_graph(database: Path) -> PairGraph:
    with pycolmap.Database.open(database) as tables:
        inliers = zip(*tables.read_two_view_geometry_num_inliers(), strict=True)
        return PairGraph(
            names={image.image_id: image.name for image in tables.read_all_images()},
            num_recorded=tables.num_matched_image_pairs(),
            num_matches=dict(zip(*tables.read_num_matches(), strict=True)),
            num_inliers={pair: num for pair, num in inliers if num > 0},
        )


def why_no_model(graph: PairGraph, cut_off: str = "") -> str:
    """The reason for an empty result, from the graph of verified pairs unless mapping was cut off."""

    def best(counts: dict[int, int]) -> str:
        pair = max(counts, key=lambda pair: (counts[pair], -pair))
        name0, name1 = sorted(graph.names[image] for image in pycolmap.pair_id_to_image_pair(pair))
        return f"{name0} – {name1} with {counts[pair]} match{'' if counts[pair] == 1 else 'es'}"

    nothing = "no model could be made: "
    if len(graph.names) < 2:
        return f"{nothing}at least 2 photos are needed, the number of photos is {len(graph.names)}"
    if not graph.num_recorded:
        return f"{nothing}no pair of photos was matched; choose another --pairing"
    if not graph.num_matches:
        return (
            f"{nothing}all {graph.num_recorded} pairs were pruned to nothing; "
            "try more lenient pruning, such as --method ratio --max-ratio 0.9, or photos that overlap more"
        )
    if not graph.num_inliers:
        return (
            f"{nothing}none of the {graph.num_recorded} pairs passed the verification; the best is "
            f"{best(graph.num_matches)}; try photos that overlap more, more features or a lower "
            "--min-num-inliers"
        )
    if cut_off:
        return f"{nothing}{cut_off}; allow more time"
    return (
        f"{nothing}{len(graph.num_inliers)} of {graph.num_recorded} pairs are verified, the best is "
        f"{best(graph.num_inliers)}, but no two photos make a good start: their matches are too few "
        "or the camera hardly moved between them; try photos from places further apart, more features or "
        "--mapper global"
    )
