"""What can be done with a finished scene.

::

    finished/
    ├── incoming.py     photos that come later: found, read and checked before anything is changed
    ├── arrival.py      which of them are new to the scene, and what an interruption left pending
    ├── grown_lists.py  the list of photos with new ones in it, and the cameras that these get
    ├── grown_models.py the models with new photos in them
    ├── add.py          photos that join the scene and its model, which does not move
    ├── localize.py     poses of photos that do not join
    ├── check.py        what holds the model weakly, and what is missing
    ├── integrity.py    whether every file can be read to its end, and what makes it again
    └── advice.py       what to try next, as commands to paste
"""
