"""Measuring: methods on labelled pairs, filters on planes, reconstructions against known cameras.

::

    evaluation/
    ├── metrics.py        the measures themselves, plain numpy
    ├── filters.py        filters of putative matches under one interface
    ├── estimators.py     estimators of the relative pose under one interface
    ├── methods.py        a filter and an estimator, named together
    ├── two_view.py       methods on labelled pairs
    ├── homography.py     filters on folders in the layout of HPatches
    ├── scene.py          a reconstruction against known cameras
    ├── compare.py        whole reconstructions under several prune methods, side by side
    ├── compare_page.py   their HTML page
    ├── records.py        result files
    └── tables.py         tables of documents, rendered from result files
"""
