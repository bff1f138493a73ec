"""Measuring: methods on labelled pairs, filters on planes, reconstructions against known cameras.

::

    evaluation/
    ├── metrics.py           the measures themselves, plain numpy
    ├── records.py           result files
    ├── tables.py            tables of documents, rendered from result files
    ├── benchmark.py         speed and memory of the network
    ├── two_view/            labelled pairs: which matches are kept, and the pose or homography they lead to
    │   ├── filters.py          filters of putative matches under one interface
    │   ├── neighbourhood.py    filters from libraries: GMS, AdaLAM
    │   ├── estimators.py       estimators of the relative pose under one interface
    │   ├── methods.py          a filter and an estimator, named together
    │   ├── pose.py             methods on files of labelled pairs
    │   └── homography.py       filters on folders in the layout of HPatches
    └── scenes/              whole reconstructions
        ├── score.py            one reconstruction against known cameras
        ├── evidence.py         what models explain and predict, counted alike for all
        ├── sharing.py          workspaces that start from the same files
        ├── seeds.py            one scene under several seeds: median and worst
        ├── compare.py          one scene under several prune methods, side by side
        └── page.py             the HTML page of a comparison
"""
