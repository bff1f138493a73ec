"""Verified pairs become models, and one of several is chosen.

::

    reconstruction/
    ├── stage.py         files to files
    ├── mapper.py        one run of pycolmap's mappers
    ├── best_model.py    the model of a scene: judged, and chosen where the first does not convince
    ├── choice.py        the policy: how many candidates are tried, and which is taken
    ├── candidates.py    ways of mapping one database; pool.py maps several at a time
    ├── views.py         a model's cameras and poses; epipolar.py and agreement.py compare two
    ├── explained.py     the verified matches that a model explains
    ├── predicted.py     the matches that a model predicts
    ├── mending.py       parts.py puts parts in their place, registration.py registers photos again
    ├── folds/           models folded by repeated structure; unfolding.py maps them without some pairs
    ├── verdict.py       good, doubtful or wrong; record.py keeps why
    ├── calibration.py   implausible focal lengths, and adjusting a model
    ├── lens.py          what a richer lens model would gain; focal_slack.py what other focal lengths cost
    ├── joining.py       several models become one; same_points.py and similarity.py find how they lie
    ├── growth.py        a finished model gets more photos; resection.py finds their poses
    ├── cache.py         the database, for going on with finished models
    └── failure.py       why there is no model
"""
