"""A workspace: the folder of files through which the stages of one scene talk.

::

    workspace/
    ├── folder.py     paths, the lock, which stages are finished
    ├── lists.py      images.txt, images.json, pairs.txt
    ├── hloc.py       the HDF5 layout of features and matches
    ├── store.py      items in an HDF5 file, written whole
    ├── journal.py    items finished since, each safe at once
    ├── resume.py     what a stage keeps and what it makes again
    ├── warned.py     what each stage warned of
    └── commands.py   the command that makes a stage again
"""

from corrsfm.workspace.folder import StageRecord, Workspace

__all__ = ["StageRecord", "Workspace"]
