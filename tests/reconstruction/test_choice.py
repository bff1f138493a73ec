"""How many models are tried, and which is taken."""

import dataclasses
from collections.abc import Sequence

import pytest
from scene_of_points import bend, make_scene

from corrsfm.reconstruction.choice import Choice, ChoicePolicy, Tried, choose_model, good_enough
from corrsfm.reconstruction.explained import explain
from corrsfm.reconstruction.predicted import NeighbourTables, predict
from corrsfm.reconstruction.views import View

SCENE = make_scene(4, 40)
RIGHT = SCENE.views
BENT = {**RIGHT, "3.jpg": bend(RIGHT["3.jpg"], 9.0)}
BENT_OTHERWISE = {**RIGHT, "0.jpg": bend(RIGHT["0.jpg"], -8.0)}
TABLES = NeighbourTables(SCENE.descriptors.__getitem__)
POLICY = ChoicePolicy(round_size=2, min_models=3)


def tried(name: str, views: dict[str, View], seconds: float = 1.0) -> Tried:
    explained = explain(views, SCENE.keypoints, SCENE.verified())
    return Tried(name=name, way=name, views=views, explained=explained, seconds=seconds)


def count(views: dict[str, View]) -> int:
    return sum(map(len, predict(views, SCENE.keypoints, TABLES, SCENE.all_pairs()).values()))


def choose(first: Tried, bank: Sequence[Tried | None], policy: ChoicePolicy = POLICY) -> Choice:
    return choose_model(
        first, bank, num_photos=4, map_round=lambda round_: round_, count_predicted=count, policy=policy
    )


def test_a_good_first_model_needs_no_second_and_no_counting() -> None:
    first = tried("first", RIGHT)
    assert good_enough(first, 4, POLICY)
    choice = choose_model(first, [None], num_photos=4, policy=POLICY, map_round=None, count_predicted=None)
    assert choice.chosen is first and choice.tried == (first,)
    assert choice.support is None
    assert choice.chosen.num_predicted is None


def test_a_first_model_that_misses_a_photo_is_not_good_enough() -> None:
    assert not good_enough(dataclasses.replace(tried("first", RIGHT), views={}), 4, POLICY)
    assert not good_enough(tried("first", RIGHT), 5, POLICY)


def test_a_first_model_of_open_focal_length_is_not_good_enough() -> None:
    assert not good_enough(dataclasses.replace(tried("first", RIGHT), is_open=True), 4, POLICY)


@pytest.mark.parametrize(("num_predicted", "chosen"), [(1020, "first"), (1100, "separate")])
def test_a_model_with_more_cameras_must_predict_clearly_more(num_predicted: int, chosen: str) -> None:
    separate = dataclasses.replace(tried("separate", BENT_OTHERWISE), has_more_cameras=True)
    choice = choose_model(
        tried("first", BENT),
        [separate],
        num_photos=4,
        map_round=lambda round_: round_,
        count_predicted=lambda views: num_predicted if views is separate.views else 1000,
        policy=POLICY,
    )
    assert choice.chosen.name == chosen


def test_a_first_model_with_a_misplaced_photo_is_not_good_enough() -> None:
    right, bent = tried("first", RIGHT), tried("first", BENT)
    assert good_enough(right, 4, POLICY)
    assert bent.explained.misplaced == ("3.jpg",)
    # Even if it explained as much as the right one.
    pairs = [
        pair
        if "3.jpg" in (pair.name0, pair.name1)
        else dataclasses.replace(pair, num_verified=10**5, num_explained=10**5)
        for pair in bent.explained.pairs
    ]
    loud = dataclasses.replace(bent, explained=dataclasses.replace(bent.explained, pairs=tuple(pairs)))
    assert loud.explained.is_enough(loud.explained_share)
    assert not good_enough(loud, 4, POLICY)


def test_less_needs_to_be_explained_where_no_pair_contradicts_the_model() -> None:
    explained = tried("first", RIGHT).explained
    shared = [dataclasses.replace(pair, num_verified=100, num_explained=88) for pair in explained.pairs]
    agreeing = dataclasses.replace(explained, pairs=tuple(shared))
    assert agreeing.share == 0.88 and agreeing.is_enough(agreeing.share)
    against = dataclasses.replace(shared[0], num_verified=10, num_explained=1)
    objecting = dataclasses.replace(explained, pairs=(against, *shared[1:]))
    assert objecting.contradicted and not objecting.is_enough(objecting.share)


def test_false_pairs_do_not_count_against_a_model_that_explains_the_others() -> None:
    explained = tried("first", RIGHT).explained
    others = [dataclasses.replace(pair, num_verified=100, num_explained=97) for pair in explained.pairs[1:]]
    for num_false, num_explained, enough in ((60, 97, True), (60, 94, False), (80, 97, False)):
        false = dataclasses.replace(explained.pairs[0], num_verified=num_false, num_explained=0)
        pairs = (false, *(dataclasses.replace(pair, num_explained=num_explained) for pair in others))
        model = dataclasses.replace(
            tried("first", RIGHT), explained=dataclasses.replace(explained, pairs=pairs)
        )
        assert model.explained_share < 0.94 and not model.explained.misplaced
        assert good_enough(model, 4, POLICY) is enough


def test_the_right_model_is_chosen_among_bent_ones_and_confirmed_by_another_right_one() -> None:
    bank = [
        tried("b", BENT_OTHERWISE),
        tried("c", RIGHT),
        tried("d", BENT),
        tried("e", RIGHT),
        tried("f", BENT),
    ]
    choice = choose(tried("a", BENT), bank)
    assert choice.chosen.name == "c"
    assert choice.reason == "another way of mapping gave the same model"
    assert [model.name for model in choice.tried] == ["a", "b", "c", "d", "e"]  # whole rounds
    assert choice.support == 1.0
    assert choice.chosen.num_predicted == 6 * 40


def test_a_wrong_model_found_twice_is_not_confirmed() -> None:
    bank = [tried("b", BENT), tried("c", BENT), tried("d", BENT), tried("e", RIGHT)]
    choice = choose(tried("a", BENT), bank)
    assert choice.chosen.name == "e"
    assert choice.reason == "all candidates have been tried"


def test_another_seed_of_the_same_mapper_confirms_nothing() -> None:
    bank = [tried("c", RIGHT), tried("b", BENT_OTHERWISE), dataclasses.replace(tried("e", RIGHT), way="c")]
    choice = choose(tried("a", BENT), bank)
    assert choice.chosen.name == "c"
    assert choice.reason == "all candidates have been tried"
    assert choice.support == 0.0


def test_bent_models_that_differ_do_not_confirm_each_other() -> None:
    choice = choose(tried("a", BENT), [tried("b", BENT_OTHERWISE), tried("c", RIGHT)])
    assert choice.chosen.name == "c"
    assert choice.reason == "all candidates have been tried"
    assert choice.support == 0.0


def test_the_best_of_each_round_is_mended_once() -> None:
    asked: list[str] = []

    def mend(model: Tried) -> Tried | None:
        asked.append(model.name)
        return tried("a mended", RIGHT) if model.name == "a" else None

    bank = [tried("b", BENT_OTHERWISE), tried("c", BENT), tried("d", BENT), None]
    choice = choose_model(
        tried("a", BENT), bank, num_photos=4, map_round=lambda round_: round_, count_predicted=count,
        policy=POLICY, mend=mend,
    )  # fmt: skip
    assert choice.chosen.name == "a mended"
    assert asked == ["a", "a mended"]
    assert [model.name for model in choice.tried][:3] == ["a", "a mended", "b"]


@pytest.mark.parametrize(("first", "mended", "chosen"), [(BENT, RIGHT, "m"), (RIGHT, BENT, "a")])
def test_a_first_model_and_what_mending_made_of_it_are_compared_first(
    first: dict[str, View], mended: dict[str, View], chosen: str
) -> None:
    choice = choose_model(
        tried("a", first), [None], num_photos=4, map_round=lambda _: pytest.fail("mapped a candidate"),
        count_predicted=count, policy=POLICY, mended=tried("m", mended),
    )  # fmt: skip
    assert choice.chosen.name == chosen and choice.support is None
    assert [model.name for model in choice.tried] == ["a", "m"]
    assert choice.reason == f"the first model{', mended,' if chosen == 'm' else ''} is good enough"


@pytest.mark.parametrize("is_put_together", [True, False])
def test_a_candidate_that_was_put_together_again_needs_no_confirmation(is_put_together: bool) -> None:
    def mend(model: Tried) -> Tried | None:
        put = dataclasses.replace(tried("m", RIGHT), is_put_together=is_put_together)
        return put if model.name == "b" else None

    bank = [tried("b", BENT_OTHERWISE), None, tried("c", BENT), None]
    choice = choose_model(
        dataclasses.replace(tried("a", BENT), views={}), bank, num_photos=4, count_predicted=count,
        map_round=lambda round_: round_, policy=POLICY, mend=mend,
    )  # fmt: skip
    assert choice.chosen.name == "m"
    assert choice.support == (None if is_put_together else 0.0)
    assert len(choice.tried) == (3 if is_put_together else 4)
    assert ("mended, is good enough" in choice.reason) == is_put_together


def test_of_two_bent_models_others_are_tried() -> None:
    choice = choose_model(
        tried("a", BENT), [tried("c", RIGHT)], num_photos=4, map_round=lambda round_: round_,
        count_predicted=count, policy=POLICY, mended=tried("m", BENT_OTHERWISE),
        others=[tried("u", BENT), None],
    )  # fmt: skip
    assert choice.chosen.name == "c" and choice.num_failed == 1
    assert [model.name for model in choice.tried] == ["a", "m", "u", "c"]


def test_mending_that_gives_nothing_is_not_repeated() -> None:
    asked: list[str] = []
    choice = choose_model(
        tried("a", BENT), [None] * 6, num_photos=4, map_round=lambda round_: round_, count_predicted=count,
        policy=POLICY, mend=lambda model: asked.append(model.name),
    )  # fmt: skip
    assert (asked, choice.chosen.name) == (["a"], "a")


def test_of_equal_models_the_first_stays() -> None:
    choice = choose(tried("a", BENT), [tried("b", BENT), tried("c", BENT)])
    assert choice.chosen.name == "a"


def test_a_model_with_more_photos_wins_among_equal_counts() -> None:
    choice = choose_model(
        tried("a", {name: RIGHT[name] for name in ("0.jpg", "1.jpg")}), [tried("b", RIGHT)],
        num_photos=4, map_round=lambda round_: round_, count_predicted=lambda views: 0, policy=POLICY,
    )  # fmt: skip
    assert choice.chosen.name == "b"


def test_trying_ends_when_the_best_has_stood_long_enough() -> None:
    bank = [None, tried("b", RIGHT)] + [None] * 9
    choice = choose(tried("a", BENT), bank, dataclasses.replace(POLICY, patience=4))
    assert choice.reason == "the best stood for 4 candidates"
    assert choice.num_failed == 5
    assert [model.name for model in choice.tried] == ["a", "b"]


def test_the_budget_of_models_counts_the_first_one() -> None:
    asked: list[int] = []

    def map_round(round_: Sequence[Tried]) -> Sequence[Tried]:
        asked.append(len(round_))
        return round_

    bank = [tried("b", BENT_OTHERWISE)] * 8
    choose_model(
        tried("a", BENT), bank, num_photos=4, map_round=map_round, count_predicted=count,
        policy=dataclasses.replace(POLICY, max_models=6, min_models=99),
    )  # fmt: skip
    assert asked == [2, 2, 1]


def test_the_budget_of_time_is_a_multiple_of_the_first_mapping() -> None:
    bank = [tried("b", BENT_OTHERWISE, seconds=6.0)] * 8
    choice = choose(tried("a", BENT, seconds=2.0), bank, dataclasses.replace(POLICY, max_time_factor=5.0))
    assert choice.reason == "the candidates took 5 times as long as the first model"
    assert len(choice.tried) == 3


def test_a_choice_knows_whether_more_could_have_been_tried() -> None:
    bank = [tried("b", BENT_OTHERWISE)] * 4
    for max_models, could in ((4, True), (5, False), (9, False)):
        policy = dataclasses.replace(POLICY, max_models=max_models, min_models=99)
        assert choose(tried("a", BENT), bank, policy).could_try_more is could
    patient = dataclasses.replace(POLICY, max_models=4, patience=1)
    assert not choose(tried("a", BENT), bank, patient).could_try_more


@pytest.mark.parametrize("bank", [[], [tried("b", RIGHT)]])
def test_without_a_budget_the_first_model_is_taken(bank: list[Tried]) -> None:
    choice = choose(tried("a", BENT), bank, dataclasses.replace(POLICY, max_models=1))
    assert (choice.chosen.name, choice.reason) == ("a", "no other candidate was to be tried")


def test_a_first_model_without_photos_is_replaced() -> None:
    choice = choose(tried("a", {}), [tried("b", RIGHT)])
    assert choice.chosen.name == "b"


def test_candidates_that_all_fail_leave_the_first_model() -> None:
    choice = choose(tried("a", BENT), [None, None, None])
    assert (choice.chosen.name, choice.num_failed, choice.support) == ("a", 3, 0.0)
