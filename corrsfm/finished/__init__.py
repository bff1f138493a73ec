"""What can be done with a finished scene.

::

    finished/
    ├── incoming.py     photos that come later: found, read and checked before anything is changed
    ├── add.py          photos that join the scene and its model, which does not move
    ├── localize.py     poses of photos that do not join
    └── check.py        what holds the model weakly, and what to try next
"""
