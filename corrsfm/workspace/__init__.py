"""A workspace: the folder of files through which the stages of one scene talk.

::

    workspace/
    ├── folder.py     the folder: begun, held, read, converted
    ├── layout.py     where every file lies
    ├── ledger.py     which stages finished, and what their files held
    ├── manifest.py   workspace.json
    ├── lease.py      which process holds it
    ├── entries.py    that nothing in it is a link or a pipe
    ├── lists.py      images.txt, images.json, pairs.txt
    ├── items.py      features and matches as they are stored
    ├── rows.py       the tables of their SQLite files, and checksums
    ├── reader.py     reading such a file, and what its errors mean
    ├── store.py      writing it, each item safe at once
    ├── mending.py    what can be saved of a damaged one
    ├── stores.py     the stores of a workspace
    ├── conversion.py those of earlier versions, in HDF5
    ├── hloc.py       hloc's keys and its half pixel
    ├── shards.py     items made by the workers of a cluster
    ├── models.py     the models, also where they were changed since
    ├── resume.py     what a stage keeps and what it makes again
    ├── heard.py      listening to what one thread warns of
    ├── warned.py     what each stage warned of
    └── commands.py   the command that makes a stage again
"""

from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.manifest import StageRecord

__all__ = ["StageRecord", "Workspace"]
