"""The statistics of a scene."""

import dataclasses
import json
import math

import pytest

from corrsfm.report import MissingReason, SceneReport, format_table, make_report
from corrsfm.types import ModelSummary, PairStatistics


def pair(name0: str, name1: str, putative: int, pruned: int, verified: int) -> PairStatistics:
    return PairStatistics(
        name0=name0, name1=name1, num_putative=putative, num_kept=pruned, num_verified=verified
    )


def model(*names: str, **values) -> ModelSummary:
    defaults = {
        "num_points": 200,
        "num_observations": 700,
        "mean_track_length": 3.5,
        "mean_observations_per_image": 700 / len(names),
        "mean_error_px": 0.625,
        "median_error_px": 0.5,
        "p95_error_px": 1.75,
    }
    return ModelSummary(image_names=names, **(defaults | values))


NAMES = [f"{letter}.jpg" for letter in "abcdefghijklm"]


def report() -> SceneReport:
    """Photos a–c in the model; every other one is missing for a reason of its own."""
    pairs = [
        pair("b.jpg", "c.jpg", 300, 90, 80),
        pair("a.jpg", "b.jpg", 500, 110, 100),
        # d: no pair at all; e: no putative match; f: pruned to nothing
        pair("a.jpg", "e.jpg", 0, 0, 0),
        pair("a.jpg", "f.jpg", 120, 0, 0),
        pair("c.jpg", "f.jpg", 60, 0, 0),
        # g: kept, not verified
        pair("a.jpg", "g.jpg", 130, 9, 0),
        # h–i: in the second model; j–k: a component of their own
        pair("h.jpg", "i.jpg", 200, 40, 30),
        pair("j.jpg", "k.jpg", 200, 20, 18),
        # l: connected, not placed; m: the same by two pairs
        pair("a.jpg", "l.jpg", 200, 30, 16),
        pair("a.jpg", "m.jpg", 200, 30, 20),
        pair("b.jpg", "m.jpg", 200, 30, 25),
    ]
    return make_report(
        scene="desk",
        image_names=reversed(NAMES),
        pairs=pairs,
        models=[model("a.jpg", "b.jpg", "c.jpg"), model("h.jpg", "i.jpg", mean_error_px=math.nan)],
        stage_seconds={"features": 2.5, "models": 1.25},
        configuration={"prune": {"method": "loransac"}},
        versions={"corrsfm": "0.1.0"},
    )


@pytest.mark.parametrize(
    ("name", "reason", "detail"),
    [
        ("d.jpg", MissingReason.NO_PAIR, "it was not matched with any photo"),
        ("e.jpg", MissingReason.NO_MATCH, "no match in 1 pair; it may have no keypoints"),
        ("f.jpg", MissingReason.PRUNED, "no match kept in 2 pairs; most putative ones: 120 with a.jpg"),
        ("g.jpg", MissingReason.NOT_VERIFIED, "none of 1 pair verified; most kept: 9 with a.jpg"),
        (
            "h.jpg",
            MissingReason.OTHER_MODEL,
            "one of 2 photos of model 1; no verified pairs connect them with model 0",
        ),
        (
            "i.jpg",
            MissingReason.OTHER_MODEL,
            "one of 2 photos of model 1; no verified pairs connect them with model 0",
        ),
        ("j.jpg", MissingReason.OTHER_COMPONENT, "verified pairs connect it with 1 other photo only"),
        ("k.jpg", MissingReason.OTHER_COMPONENT, "verified pairs connect it with 1 other photo only"),
        ("l.jpg", MissingReason.NOT_PLACED, "1 verified pair; most matches: 16 with a.jpg"),
        ("m.jpg", MissingReason.NOT_PLACED, "2 verified pairs; most matches: 25 with b.jpg"),
    ],
)
def test_each_missing_photo_has_its_reason(name: str, reason: MissingReason, detail: str) -> None:
    missing = {image.name: image for image in report().missing}
    assert (missing[name].reason, missing[name].detail) == (reason, detail)


@pytest.mark.parametrize(
    ("name", "next_step"),
    [
        ("d.jpg", "match it with more photos: --pairing exhaustive, or a larger --num-retrieved"),
        ("e.jpg", "look at the photo: a dark, blurred or plain one has hardly any keypoints"),
        ("f.jpg", "take a photo between a.jpg and f.jpg, or try --method ratio"),
        ("g.jpg", "take a photo between a.jpg and g.jpg, or try --pairing exhaustive"),
        ("h.jpg", "take photos that show both models, or try --pairing exhaustive"),
        ("j.jpg", "take a photo between j.jpg and the model, or try --pairing exhaustive"),
        ("m.jpg", "take a photo between b.jpg and m.jpg, or try --pairing exhaustive"),
    ],
)
def test_each_missing_photo_has_a_next_step(name: str, next_step: str) -> None:
    assert {image.name: image.next_step for image in report().missing}[name] == next_step


def test_where_all_pairs_were_matched_features_are_what_there_can_be_more_of() -> None:
    pairs = [pair("a", "b", 99, 99, 99), pair("a", "c", 99, 20, 0), pair("b", "c", 99, 30, 0)]
    made = make_report(scene="", image_names="abc", pairs=pairs, models=[model("a", "b")])
    assert made.missing[0].next_step == "take a photo between b and c, or try a larger --max-features"


def test_the_next_photo_joins_the_model_rather_than_another_missing_photo() -> None:
    pairs = [pair("a", "b", 99, 99, 99), pair("a", "c", 99, 5, 0), pair("c", "d", 99, 30, 0)]
    made = make_report(scene="", image_names="abcd", pairs=pairs, models=[model("a", "b")])
    assert [photo.next_step.split(",")[0] for photo in made.missing] == [
        "take a photo between a and c",
        "take a photo between c and d",
    ]


def test_without_a_model_the_verdict_says_what_most_photos_lack() -> None:
    pairs = [pair("a", "b", 50, 10, 0), pair("a", "c", 50, 0, 0), pair("b", "c", 50, 0, 0)]
    made = make_report(scene="", image_names="abc", pairs=pairs, models=[])
    assert made.verdict == (
        "no model: 2 of 3 photos: too few verified matches; take a photo between a and b, or try a larger "
        "--max-features"
    )
    assert format_table(made).splitlines()[1] == f"verdict     {made.verdict}"
    assert made.to_dict()["summary"]["verdict"] is None
    unmapped = make_report(
        scene="", image_names="ab", pairs=[pair("a", "b", 9, 9, 9)], models=[], mapped=False
    )
    assert unmapped.verdict == "no model: 2 of 2 photos: not mapped yet; run corrsfm reconstruct"


def test_every_photo_is_either_registered_or_missing_with_each_reason_shown() -> None:
    names = [image.name for image in report().missing]
    assert names == NAMES[3:]
    others = {MissingReason.LEFT_OUT, MissingReason.NOT_MAPPED}
    assert {image.reason for image in report().missing} == set(MissingReason) - others


def test_a_photo_that_was_left_out_is_not_said_to_lack_keypoints() -> None:
    made = make_report(scene="", image_names="ab", pairs=[pair("a", "b", 0, 0, 0)], models=[], left_out={"b"})
    reasons = {image.name: (image.reason, image.detail) for image in made.missing}
    assert reasons["a"][0] is MissingReason.NO_MATCH
    assert reasons["b"] == ("unreadable, left out", "it cannot be read")
    assert made.missing[1].next_step == "replace the file and run again"


def test_the_mapper_is_not_blamed_before_it_ran() -> None:
    pairs = [pair("a", "b", 50, 20, 18), pair("a", "c", 50, 0, 0), pair("x", "y", 50, 20, 16)]
    made = make_report(scene="", image_names="abcxy", pairs=pairs, models=[], mapped=False)
    assert {image.name: image.reason for image in made.missing} == {
        **dict.fromkeys("abxy", MissingReason.NOT_MAPPED),
        "c": MissingReason.PRUNED,
    }
    assert made.missing[0].detail == "1 verified pair; most matches: 18 with b"


def test_a_model_of_photos_that_pairs_connect_with_the_first_is_told_from_one_of_others() -> None:
    pairs = [pair("a", "b", 99, 99, 99), pair("b", "c", 99, 99, 99), pair("c", "d", 99, 99, 99)]
    models = [model("a", "b"), model("c", "d")]
    made = make_report(scene="", image_names="abcd", pairs=pairs, models=models)
    assert {image.detail for image in made.missing} == {
        "one of 2 photos of model 1; verified pairs connect them with model 0"
    }


def test_counts_are_exact() -> None:
    made = report()
    assert made.num_registered == 3
    assert made.registered_percent == pytest.approx(300 / 13)
    assert (made.num_verified_pairs, made.num_empty_pairs) == (7, 3)
    assert made.num_matches == (2110, 359, 289)
    assert made.components == (
        ("a.jpg", "b.jpg", "c.jpg", "l.jpg", "m.jpg"),
        ("h.jpg", "i.jpg"),
        ("j.jpg", "k.jpg"),
    )
    assert [(p.name0, p.name1) for p in made.pairs] == sorted((p.name0, p.name1) for p in made.pairs)


def test_component_of_the_first_model_counts_as_the_main_one() -> None:
    pairs = [pair("a", "b", 99, 99, 99), pair("b", "c", 99, 99, 99), pair("x", "y", 99, 99, 99)]
    made = make_report(scene="", image_names="abcxy", pairs=pairs, models=[model("x", "y")])
    assert {image.name: image.reason for image in made.missing} == dict.fromkeys(
        "abc", MissingReason.OTHER_COMPONENT
    )


def test_scene_without_a_model_is_reported() -> None:
    made = make_report(scene="", image_names="abc", pairs=[pair("a", "b", 50, 20, 18)], models=[])
    assert (made.num_registered, made.registered_percent) == (0, 0.0)
    assert [image.reason for image in made.missing] == [
        MissingReason.NOT_PLACED,
        MissingReason.NOT_PLACED,
        MissingReason.NO_PAIR,
    ]
    assert "models      none" in format_table(made)


def test_report_survives_json() -> None:
    made = report()
    read = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert math.isnan(made.models[1].mean_error_px) and read["models"][1]["mean_error_px"] is None
    assert list(read)[2:] == ["verdict", *(entry.name for entry in dataclasses.fields(made))]
    for written, model in zip(read["models"], made.models, strict=True):
        kept = {name: value for name, value in written.items() if value is not None}
        assert ModelSummary(**dataclasses.asdict(model) | kept | {"image_names": model.image_names}) == model
        assert tuple(written["image_names"]) == model.image_names
    for written, pair in zip(read["pairs"], made.pairs, strict=True):
        assert written == dataclasses.asdict(pair) | {"num_pruned": pair.num_kept}
    assert [MissingReason(image["reason"]) for image in read["missing"]] == [
        image.reason for image in made.missing
    ]


def test_json_keeps_the_old_name_of_kept_matches_for_a_version() -> None:
    values = report().to_dict()
    kept = sum(pair.num_kept for pair in report().pairs)
    assert values["summary"]["num_kept_matches"] == values["summary"]["num_pruned_matches"] == kept > 0


def test_json_begins_with_a_summary() -> None:
    values = report().to_dict()
    assert list(values)[:2] == ["format_version", "summary"]
    assert values["summary"]["model_sizes"] == [3, 2]
    assert (values["summary"]["num_registered"], values["summary"]["num_in_models"]) == (3, 5)
    assert values["summary"]["num_points"] == 200
    assert values["summary"]["seconds"] == 3.75


def test_json_names_its_format() -> None:
    assert report().to_dict()["format_version"] == 1


def test_table_is_aligned_and_complete() -> None:
    assert format_table(report()) == "\n".join(
        [
            "scene               desk",
            "photos              3 of 13 registered (23.1 %), 5 in all models",
            "models              2, with 3, 2 photos",
            "points              200",
            "observations        700, 233.3 a photo",
            "track length        3.50 photos a point",
            "reprojection error  0.50 px median, 0.62 mean, 1.75 95th percentile",
            "pairs               11 matched, 7 verified, 3 pruned to nothing",
            "matches             2,110 putative → 359 kept (17.0 %) → 289 verified (13.7 %)",
            "view graph          3 components of 5, 2, 2 photos, 4 without a verified pair",
            "seconds             3.8: features 2.5, models 1.2",
            "",
            "not registered",
            "  d.jpg  no pair                    it was not matched with any photo",
            "         next: match it with more photos: --pairing exhaustive, or a larger --num-retrieved",
            "  e.jpg  no putative match          no match in 1 pair; it may have no keypoints",
            "         next: look at the photo: a dark, blurred or plain one has hardly any keypoints",
            "  f.jpg  pruned to nothing          "
            "no match kept in 2 pairs; most putative ones: 120 with a.jpg",
            "         next: take a photo between a.jpg and f.jpg, or try --method ratio",
            "  g.jpg  too few verified matches   none of 1 pair verified; most kept: 9 with a.jpg",
            "         next: take a photo between a.jpg and g.jpg, or try --pairing exhaustive",
            *(
                line
                for name in ("h.jpg", "i.jpg")
                for line in (
                    f"  {name}  in another model           "
                    "one of 2 photos of model 1; no verified pairs connect them with model 0",
                    "         next: take photos that show both models, or try --pairing exhaustive",
                )
            ),
            *(
                line
                for name in ("j.jpg", "k.jpg")
                for line in (
                    f"  {name}  in another component       verified pairs connect it with 1 other photo only",
                    f"         next: take a photo between {name} and the model, or try --pairing exhaustive",
                )
            ),
            "  l.jpg  mapper could not place it  1 verified pair; most matches: 16 with a.jpg",
            "         next: take a photo between a.jpg and l.jpg, or try --pairing exhaustive",
            "  m.jpg  mapper could not place it  2 verified pairs; most matches: 25 with b.jpg",
            "         next: take a photo between b.jpg and m.jpg, or try --pairing exhaustive",
        ]
    )


def test_table_shows_twenty_missing_photos_at_most() -> None:
    made = make_report(scene="", image_names=[f"{i:03d}" for i in range(50)], pairs=[], models=[])
    lines = format_table(made).splitlines()
    assert lines[-1] == "  … and 30 more, see report.json"
    assert sum("no pair  " in line for line in lines) == 20
