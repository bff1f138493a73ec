"""Training the network: from photo scenes to a checkpoint.

::

    training/
    ├── config.py        options and recipes
    ├── prepare.py       photo scenes with cameras → files of labelled pairs
    ├── dataset.py       real pairs → batches on the device, augmented
    ├── statistics.py    side information of real pairs, measured and drawn from
    ├── synthetic.py     synthetic pairs without limit
    ├── losses.py        the paper's hybrid loss
    ├── schedule.py      the learning rate over a run
    ├── loop.py          the run
    ├── journal.py       its recipe and logs
    ├── checkpoint.py    its state, for resuming
    ├── validation.py    how well the network filters pairs that it has not seen
    └── plots.py         learning curves; real beside synthetic pairs
"""
