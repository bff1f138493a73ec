"""Models folded by repeated structure: the evidence, and the pairs to leave out.

::

    folds/
    ├── sightings.py   what the photos of a model see of its points
    ├── evidence.py    photos side by side that share too little
    ├── bodies.py      parts that few matches hold together, and how pairs say they lie
    └── unfold.py      pairs to leave out, new models, and the choice among them

The evidence and the group rule were first tried outside this project; `holes`, the rotation vote and the
choice are new here.
"""
